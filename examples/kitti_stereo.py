# SPDX-License-Identifier: MIT
"""Score a key of a KITTI raw drive against the stereo benchmark's disparity (KITTI 2015).

python examples/kitti_stereo.py DRIVE KEY DISPARITY.png OBJECTS.png

DISPARITY: uint16, 256 x disparity in px, 0 none (disp_occ_0). OBJECTS: 0 where nothing moves
(obj_map). Frame 10 of drive 2011_09_26_drive_0013 is frame 000018 of the benchmark's training set.
"""

import sys

import cv2
import numpy as np

import densify
from densify.scores.metrics import depth_scores

BASELINE_M = 0.532725  # of image_02 and image_03 of the drives of 2011_09_26

if len(sys.argv) != 5:
    sys.exit(__doc__)
drive, key, *files = sys.argv[1:]
disparity_px, objects = (cv2.imread(file, cv2.IMREAD_UNCHANGED) for file in files)

sequence = densify.open_sequence(drive)
camera = sequence.cameras["image_02"]
true_m = np.zeros(disparity_px.shape, np.float32)
known = disparity_px > 0
true_m[known] = camera.focal_px * BASELINE_M * 256 / disparity_px[known]

results = densify.compare(sequence, int(key), cameras=["image_02"], methods=["none", "icp", "flow"])
for method, result in results.items():
    scores = depth_scores(result.depth["image_02"], true_m, objects > 0, camera)
    for product in ("measured", "filled"):
        for part, score in scores[product].items():
            outliers, coverage = score["outliers"], score["coverage"]
            name = f"{method}, {product}, {part}"
            print(f"{name:24} outliers {outliers:6.2%}, coverage {coverage:.3f}")
