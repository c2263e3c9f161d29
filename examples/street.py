# SPDX-License-Identifier: MIT
"""Densify one moment of the built-in street and compare it with the exact truth.

python examples/street.py [OUT.npy]
"""

import sys

import numpy as np

import densify

sequence = densify.open_sequence("street")
result = densify.run(sequence, key=120, window=2, cameras=["image_02"], config="fast")

depth = result.depth["image_02"]
truth_m = sequence.truth.depth_m("image_02", 120)
both = (depth.depth_m > 0) & (truth_m > 0)
error_m = np.abs(depth.depth_m - truth_m)[both]

print(f"{len(result.cloud):,} points, {result.cloud.moving.sum():,} of them on moving objects")
print(f"depth in {np.mean(depth.depth_m > 0):.1%} of the pixels")
print(f"median error {np.median(error_m):.3f} m")
if len(sys.argv) > 1:
    np.save(sys.argv[1], depth.depth_m)
