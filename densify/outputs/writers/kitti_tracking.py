# SPDX-License-Identifier: MIT
"""Writes a street as a KITTI tracking sequence, which `densify.readers.kitti.tracking` opens::

OUT/training/{velodyne/0000/000000.bin, image_02/0000/000000.png, calib/0000.txt, oxts/0000.txt}
OUT/training/label_02/0000.txt  boxes of what image_02 shows, as `drawn_boxes` draws them
OUT/training/truth/  as in `densify.readers.truth_files`
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.outputs.writers.boxes import drawn_boxes
from densify.outputs.writers.excerpt import Excerpt, check_cameras_fit, new_folder, put
from densify.outputs.writers.kitti_raw import (
    T_LEVEL_IMU,
    check_azimuth_tells_time,
    numbers,
    oxts_line,
    projections,
    velodyne_bytes,
)
from densify.readers.kitti.calibration import NOMINAL_PERIOD_NS
from densify.street.cameras import CAMERAS, T_RECTIFIED_LIDAR, T_level_lidar

CAMERA_NAMES = ("image_02",)
"""Those of the street that the format has room for."""

_SEQUENCE = "0000"
_NEAREST_M = 0.5  # of corners before the camera


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for the camera image_02, for a sensor
    whose points' times follow from their azimuth, and for sweeps of 10 Hz without gaps."""
    street = excerpt.street
    check_cameras_fit(excerpt, "KITTI tracking", CAMERA_NAMES)
    check_azimuth_tells_time(street, "KITTI tracking")
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    if np.any(np.diff(stamps_ns) != NOMINAL_PERIOD_NS):
        raise InputError(
            f"{street.name}: frames {list(excerpt.frames)[:5]} cannot be written as KITTI "
            f"tracking, which has no stamps; choose hz=10 and frames that follow each other"
        )
    T_level = T_level_lidar(street.simulator.tilt_deg)
    with new_folder(out / "training", overwrite) as folder:
        for number, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            data = velodyne_bytes(returns.points, returns.intensity)
            put(folder / "velodyne" / _SEQUENCE / f"{number:06d}.bin", data)
            for name in excerpt.cameras:
                image = folder / name / _SEQUENCE / f"{number:06d}.png"
                put(image, excerpt.encoded_image(name, frame))
        calibration = [
            *projections("P{}"),
            f"R_rect {numbers(np.eye(3))}\n",
            f"Tr_velo_cam {numbers((T_RECTIFIED_LIDAR @ T_level)[:3])}\n",
            f"Tr_imu_velo {numbers((poses.inverse(T_level) @ T_LEVEL_IMU)[:3])}\n",
        ]
        put(folder / "calib" / f"{_SEQUENCE}.txt", "".join(calibration).encode())
        records = [oxts_line(street, frame, excerpt.frames[0]) for frame in excerpt.frames]
        put(folder / "oxts" / f"{_SEQUENCE}.txt", "".join(records).encode())
        lines = [line for n, f in enumerate(excerpt.frames) for line in _labels(excerpt, f, n)]
        put(folder / "label_02" / f"{_SEQUENCE}.txt", "".join(lines).encode())
        excerpt.write_truth(folder / "truth", stamps_ns)
    return out / "training"


def _labels(excerpt: Excerpt, frame: int, number: int) -> Iterator[str]:
    """Lines of the boxes that the camera sees, each where the scanner met it."""
    camera, drawn = CAMERAS["image_02"], drawn_boxes(excerpt, frame)
    T_rect_level = T_RECTIFIED_LIDAR @ T_level_lidar(excerpt.street.simulator.tilt_deg)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for instance, T_world_box, size_m, T_world_lidar in zip(
        drawn.instance,
        drawn.T_world_box,
        drawn.size_m,
        excerpt.T_world_ego(drawn.met_ns) if len(drawn.instance) else [],
        strict=True,
    ):
        T_rect_box = T_rect_level @ poses.inverse(T_world_lidar) @ T_world_box
        shift = camera.T_cam_lidar @ poses.inverse(T_RECTIFIED_LIDAR)
        seen = _rectangle(camera, poses.transform(shift @ T_rect_box, corners * size_m))
        if seen is None:
            continue
        length_m, width_m, height_m = size_m
        front, (x, y, z) = T_rect_box[:3, 0], T_rect_box[:3, 3]
        turn = float(np.arctan2(-front[2], front[0]))
        place = [height_m, width_m, length_m, x, y + height_m / 2, z, turn]
        values = numbers(np.array([turn - np.arctan2(x, z), *seen, *place]))
        yield f"{number} {instance} Car 0 0 {values}\n"


def _rectangle(camera: Camera, corners_cam: Float) -> tuple[float, float, float, float] | None:
    """Left, top, right, bottom in the image of the corners before the camera; None if beside it."""
    ahead = corners_cam[corners_cam[:, 2] > _NEAREST_M]
    if not len(ahead):
        return None
    uv = (ahead / ahead[:, 2:]) @ camera.K[:2].T
    last = np.array([camera.width_px - 1, camera.height_px - 1])
    low, high = np.clip(uv.min(axis=0), 0, last), np.clip(uv.max(axis=0), 0, last)
    return (*low, *high) if (high > low).all() else None
