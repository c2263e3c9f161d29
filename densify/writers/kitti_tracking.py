# SPDX-License-Identifier: MIT
"""Writes a street as a KITTI tracking sequence, which `densify.readers.kitti.tracking` opens::

OUT/training/{velodyne/0000/000000.bin, image_02/0000/000000.png, calib/0000.txt, oxts/0000.txt}
OUT/training/truth/  as in `densify.readers.truth_files`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.errors import InputError
from densify.geometry import poses
from densify.readers.kitti.files import NOMINAL_PERIOD_NS
from densify.street.rig import T_RECTIFIED_LIDAR, T_level_lidar
from densify.types import Progress
from densify.writers.excerpt import Excerpt, check_cameras_fit, new_folder, put
from densify.writers.kitti_raw import (
    T_LEVEL_IMU,
    check_azimuth_tells_time,
    numbers,
    oxts_line,
    projections,
    velodyne_bytes,
)

_SEQUENCE = "0000"


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool, progress: Progress | None) -> Path:
    """See `densify.writers.TreeWriter`. The format has room for the camera image_02, for a sensor
    whose points' times follow from their azimuth, and for sweeps of 10 Hz without gaps."""
    street = excerpt.street
    check_cameras_fit(excerpt, "KITTI tracking", ("image_02",))
    check_azimuth_tells_time(street, "KITTI tracking")
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    if np.any(np.diff(stamps_ns) != NOMINAL_PERIOD_NS):
        raise InputError(
            f"{street.name}: frames {list(excerpt.frames)[:5]} cannot be written as KITTI "
            f"tracking, which has no stamps; choose hz=10 and frames that follow each other"
        )
    T_level = T_level_lidar(street.simulator.tilt_deg)
    with new_folder(out / "training", overwrite) as folder:
        for number, frame in enumerate(excerpt.frames):
            if progress:
                progress("simulate", number, len(excerpt.frames))
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
        excerpt.write_truth(folder / "truth", stamps_ns)
        if progress:
            progress("simulate", len(excerpt.frames), len(excerpt.frames))
    return out / "training"
