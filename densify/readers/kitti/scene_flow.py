# SPDX-License-Identifier: MIT
"""KITTI's scene flow 2015 (Menze and Geiger, "Object Scene Flow for Autonomous Vehicles", CVPR
2015), as downloaded, with its calibration in the same folder::

    ROOT/training/disp_occ_0/000000_10.png    uint16, 256 x the disparity, 0 none
    ROOT/training/disp_occ_1/000000_10.png    at the second moment, of the first image's pixels
    ROOT/training/flow_occ/000000_10.png      uint16 u, v, valid; pixels = (u - 2^15) / 64
    ROOT/training/calib_cam_to_cam/000000.txt P_rect_02 and P_rect_03

Each pixel with all three is a point at two moments: where it is, and where it comes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float
from densify.readers.decoded_files import read_image
from densify.readers.kitti.calibration import Calibration

_PER_PX, _FLOW_PER_PX, _FLOW_ZERO = 256.0, 64.0, 2**15
_IMAGES = ("disp_occ_0", "disp_occ_1", "flow_occ")
_LEFT, _RIGHT = "P_rect_02", "P_rect_03"
GROUND_M = 1.4
"""Below the camera, which rides 1.65 m above the road: points below that at both moments are the
road (Gu et al., "HPLFlowNet", CVPR 2019)."""


class TwoMoments(NamedTuple):
    """The same n points at two moments. here, there: (n,3) metres, the left camera's axes (x right,
    y down, z forward) at the first and the second image: motion of the vehicle included. is_white:
    (n,) whether the first image's pixel is a white square, the pixels being a chessboard."""

    here: Float
    there: Float
    is_white: Bool

    def above_ground(self) -> Bool:
        """(n,), see `GROUND_M`."""
        above: Bool = np.minimum(self.here[:, 1], self.there[:, 1]) < GROUND_M
        return above


def training_folder(folder: Path) -> Path | None:
    """Where the images are: the folder, or its ``training``; None if this is no such set."""
    places = (folder, folder / "training")
    return next((p for p in places if (p / _IMAGES[0]).is_dir()), None)


def image_names(training: Path) -> list[str]:
    """The pairs that have a disparity: ``000000_10`` and so on. Raises InputError for none."""
    names = sorted(path.stem for path in (training / _IMAGES[0]).glob("*_10.png"))
    if not names:
        raise InputError(f"{training / _IMAGES[0]}: no images such as 000000_10.png")
    return names


def read_moments(training: Path, name: str) -> TwoMoments:
    """Lift one pair. Raises InputError for a file that is missing or of another form."""
    first, second, flow = (_image(training / kind / f"{name}.png") for kind in _IMAGES)
    path = training / "calib_cam_to_cam" / f"{name.partition('_')[0]}.txt"
    calibration = Calibration.read(path)
    cameras = [calibration.rectified_camera(k, k, (1, 1), np.eye(4)) for k in (_LEFT, _RIGHT)]
    baseline_m = cameras[0].T_cam_lidar[0, 3] - cameras[1].T_cam_lidar[0, 3]
    if baseline_m <= 0:
        raise InputError(
            f"{path}: the cameras of {_LEFT} and {_RIGHT} stand {baseline_m:g} m apart, expected "
            f"above 0"
        )
    K = cameras[0].K
    for kind, image in zip(_IMAGES[1:], (second, flow), strict=True):
        if image.shape[:2] != first.shape[:2]:
            raise InputError(
                f"{training / kind / name}.png: {image.shape[1]} x {image.shape[0]} pixels, "
                f"expected {first.shape[1]} x {first.shape[0]} as in {_IMAGES[0]}"
            )
    # Images come with blue first: valid, v, u.
    known = (first > 0) & (second > 0) & (flow[..., 0] > 0)
    v, u = np.nonzero(known)
    at_px = np.stack([u, v], axis=1).astype(np.float64)
    moved_px = (flow[known][:, [2, 1]].astype(np.float64) - _FLOW_ZERO) / _FLOW_PER_PX

    def lifted(px: Float, disparity: Float) -> Float:
        depth_m = K[0, 0] * baseline_m * _PER_PX / disparity
        across = (px - K[:2, 2]) / K[[0, 1], [0, 1]]
        return np.column_stack([across * depth_m[:, None], depth_m])

    return TwoMoments(
        lifted(at_px, first[known].astype(np.float64)),
        lifted(at_px + moved_px, second[known].astype(np.float64)),
        (u + v) % 2 == 0,
    )


def _image(path: Path) -> np.ndarray:
    image = read_image(path, as_stored=True)
    channels = 3 if path.parent.name == _IMAGES[2] else 1
    got = image.shape[2] if image.ndim == 3 else 1
    if image.dtype != np.uint16 or got != channels:
        raise InputError(
            f"{path}: got {got} channels of {image.dtype}, expected {channels} of uint16, as KITTI "
            f"writes them"
        )
    return image
