# SPDX-License-Identifier: MIT
"""Boxes of KITTI tracking, ``label_02/0000.txt``: a line for each object and frame.

``frame track type truncated occluded alpha left top right bottom height width length x y z
rotation_y [score]``. x y z is the middle of the box's bottom in the rectified camera 0 (x right,
y down, z forward), rotation_y its turn about y, 0 where the front is along x. Boxes are drawn where
the object stands in the sweep as it was measured, so each belongs to the time at which the scanner
faced it. Only what image_02 shows is labelled; ``DontCare`` lines are rectangles of the image in
which there may be objects without a box (Geiger, Lenz, Urtasun, CVPR 2012; devkit_tracking).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry.types import Float, Int
from densify.readers.file_sequence import checked_boxes, upright_poses
from densify.readers.kitti.calibration import parse_numbers

T_CAM_UPRIGHT = np.array(  # x right, y forward, z up
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_NUM_WORDS = (17, 18)
_LEFT_OUT = "DontCare"


@dataclass(frozen=True)
class LabelFile:
    """path: for messages. frame: (n,) int64 of the lines, track: (n,) int64, left_out: (n,) bool.
    numbers: (n,14) from ``truncated`` to ``rotation_y``."""

    path: Path
    frame: Int
    track: Int
    left_out: NDArray[np.bool_]
    numbers: Float

    @staticmethod
    def read(path: Path) -> LabelFile | None:
        """None if there is no such file. Raises InputError for a line that is malformed."""
        if not path.is_file():
            return None
        rows, left_out = [], []
        for number, line in enumerate(read_text(path).splitlines(), 1):
            words = line.split()
            where = f"{path}: line {number}"
            if not words:
                continue
            if len(words) not in _NUM_WORDS:
                raise InputError(
                    f"{where}: got {len(words)} words, expected 17 (frame track type ... "
                    f"rotation_y), and a score at will"
                )
            rows.append(parse_numbers(" ".join([*words[:2], *words[3:17]]), where, 16))
            left_out.append(words[2] == _LEFT_OUT)
            frame, track = rows[-1][:2]
            if frame % 1 or track % 1 or not (0 <= frame < 1 << 31 and -2 < track < 1 << 31):
                raise InputError(
                    f"{where}: got frame {words[0]} and track {words[1]}, expected whole numbers"
                )
        table = np.reshape(rows, (-1, 16))
        whole = table[:, :2].astype(np.int64)
        return LabelFile(path, whole[:, 0], whole[:, 1], np.array(left_out, bool), table[:, 2:])

    def boxes(self, frame: int) -> tuple[NDArray[np.str_], Float, Float]:
        """Tracks (K,), T_cam_box (K,4,4) in the rectified camera 0, and size_m (K,3) of a frame."""
        rows = (self.frame == frame) & ~self.left_out
        height_m, width_m, length_m = self.numbers[rows, 7:10].T
        right, down, forward = self.numbers[rows, 10:13].T
        centre_m = np.column_stack([right, forward, height_m / 2 - down])
        T_cam_box = T_CAM_UPRIGHT @ upright_poses(centre_m, -self.numbers[rows, 13])
        found = checked_boxes(
            self.track[rows].astype(np.str_),
            T_cam_box,
            np.column_stack([length_m, width_m, height_m]),
            f"{self.path}: frame {frame}",
        )
        return found.track, found.T_lidar_box, found.size_m

    def left_out_px(self, frame: int) -> Float:
        """(R,4) left, top, right, bottom."""
        return self.numbers[(self.frame == frame) & self.left_out, 3:7]
