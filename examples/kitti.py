# SPDX-License-Identifier: MIT
"""Densify one frame of a KITTI raw drive and show what scene flow does to moving objects.

python examples/kitti.py .../2011_09_26/2011_09_26_drive_0013_sync [KEY]
"""

import sys

import densify

if len(sys.argv) < 2:
    sys.exit(__doc__)
sequence = densify.open_sequence(sys.argv[1])
key = int(sys.argv[2]) if len(sys.argv) > 2 else sequence.frames[len(sequence.frames) // 2]
result = densify.run(sequence, key=key, window=2, cameras=["image_02"])

moved = result.cloud.points[result.cloud.moving]
distance_m = result.cloud.displaced[result.cloud.moving]
print(f"key {key}: sweeps {result.frames[0]} to {result.frames[-1]}, {len(result.cloud):,} points")
print(f"{len(moved):,} points moved to where they are at the key's moment")
if len(moved):
    print(f"by up to {distance_m.max():.1f} m")
