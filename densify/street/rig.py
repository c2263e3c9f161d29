# SPDX-License-Identifier: MIT
"""The vehicle's cameras: their lenses, how they sit, and when they expose."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float
from densify.street.lidar import T_ego_lidar

# how KITTI's cameras sit: axes turned, a little off true, below and before the scanner
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_TILT = Rotation.from_rotvec([0.008, -0.012, 0.007]).as_matrix()
T_RECTIFIED_LIDAR = np.eye(4)
T_RECTIFIED_LIDAR[:3, :3] = _TILT @ _AXES
T_RECTIFIED_LIDAR[:3, 3] = [-0.004, -0.076, -0.272]
FOCAL_PX, CENTRE_PX = 721.5, (609.5, 172.75)
# metres to the right of the rectified origin
_LEFT, _RIGHT = -0.06, 0.48
T_FISHEYE_LIDAR = np.array(  # on the left of the roof, looking to the left
    [[1.0, 0.0, 0.0, 0.3], [0.0, 0.0, -1.0, -0.2], [0.0, 1.0, 0.0, -0.6], [0.0, 0.0, 0.0, 1.0]]
)


class Shutter(NamedTuple):
    """delay_ns: of the first image after frame 0's reference time. period_ns: from image to image,
    None for one with each sweep."""

    delay_ns: int
    period_ns: int | None = None


def _pinhole(name: str, right_m: float, share: float = 1.0, row_time_s: float = 0.0) -> Camera:
    """share: of KITTI's resolution."""
    T_cam_lidar = T_RECTIFIED_LIDAR.copy()
    T_cam_lidar[0, 3] -= right_m
    f, (u, v) = FOCAL_PX * share, ((c + 0.5) * share - 0.5 for c in CENTRE_PX)
    if share == 1.0:
        u, v = CENTRE_PX
    K = np.array([[f, 0, u], [0, f, v], [0, 0, 1.0]])
    size_px = round(1242 * share), round(375 * share)
    return Camera(name, *size_px, K, T_cam_lidar, row_time_s=row_time_s)


_FISHEYE = Camera(
    name="fisheye",
    width_px=400,
    height_px=400,
    K=np.array([[124.0, 0, 199.5], [0, 124.0, 199.5], [0, 0, 1.0]]),
    T_cam_lidar=T_FISHEYE_LIDAR,
    distortion=(-0.02, 0.003, -0.001, 0.0001),
    model="fisheye",
    max_angle_deg=95.0,
)

CAMERAS = {
    c.name: c
    for c in (
        _pinhole("image_02", _LEFT),
        _pinhole("image_03", _RIGHT),
        _pinhole("fast", _LEFT, 1 / 3),
        _pinhole("rolling", _LEFT, 1 / 2, 100e-6),
        _FISHEYE,
    )
}
"""The cameras, beside a level mount."""

SHUTTERS = {
    "image_02": Shutter(0),
    "image_03": Shutter(15_000_000),
    "fast": Shutter(7_000_000, 33_333_333),
    "rolling": Shutter(20_000_000, 100_000_000),
    "fisheye": Shutter(-20_000_000, 100_000_000),
}

USUAL = ("image_02", "image_03")
"""Those that are there unless others are asked for."""


def T_level_lidar(tilt_deg: float) -> Float:
    """(4,4) from the lidar frame of a tilted mount to that of a level one."""
    return inverse(T_ego_lidar()) @ T_ego_lidar(tilt_deg)


def cameras_beside(tilt_deg: float, names: tuple[str, ...] = USUAL) -> dict[str, Camera]:
    """The cameras, which stay where they are on the vehicle, in the lidar frame of a tilted
    mount."""
    T = T_level_lidar(tilt_deg)
    return {n: replace(CAMERAS[n], T_cam_lidar=CAMERAS[n].T_cam_lidar @ T) for n in names}
