# SPDX-License-Identifier: MIT
"""Writes a street as a KITTI odometry sequence, which `densify.readers.kitti.odometry` opens::

    OUT/sequences/00/{velodyne/000000.bin, image_2/000000.png, calib.txt, times.txt}
    OUT/sequences/00/truth/  as in `densify.readers.truth_files`
    OUT/poses/00.txt

Points are compensated to the middle of the sweep with the street's true path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.outputs.writers.excerpt import Excerpt, check_cameras_fit, new_folder, put
from densify.outputs.writers.kitti_raw import numbers, projections, velodyne_bytes
from densify.street.cameras import T_RECTIFIED_LIDAR, T_level_lidar

CAMERA_NAMES = {"image_02": "image_2"}
"""The street's camera that exposes with the scanner, and what the format calls it."""

_SEQUENCE = "00"


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for the camera image_02 and for one
    scanner."""
    street = excerpt.street
    check_cameras_fit(excerpt, "KITTI odometry", CAMERA_NAMES)
    if len(street.simulator.sensor.scanners) > 1:
        raise InputError(
            f"{street.name}: cannot be written as KITTI odometry, whose points do not say which "
            f"scanner measured them; choose a sensor of one scanner such as hdl64"
        )
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    T_rect_lidar = T_RECTIFIED_LIDAR @ T_level_lidar(street.simulator.tilt_deg)
    T_world_lidar = excerpt.T_world_ego(np.array(stamps_ns))
    T_first_now = T_rect_lidar @ poses.inverse(T_world_lidar[0]) @ T_world_lidar
    T_first_now = T_first_now @ poses.inverse(T_rect_lidar)
    path = excerpt.poses()
    with new_folder(out, overwrite) as folder:
        sequence = folder / "sequences" / _SEQUENCE
        for number, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            fired = returns.points.astype(np.float64)
            points = path.compensated(fired, stamps_ns[number], returns.offset_ns)
            data = velodyne_bytes(points, returns.intensity)
            put(sequence / "velodyne" / f"{number:06d}.bin", data)
            for name in excerpt.cameras:
                image = sequence / CAMERA_NAMES[name] / f"{number:06d}.png"
                put(image, excerpt.encoded_image(name, frame))
        since_s = [f"{(ns - stamps_ns[0]) * 1e-9:.6e}\n" for ns in stamps_ns]
        put(sequence / "times.txt", "".join(since_s).encode())
        calibration = [*projections("P{}"), f"Tr: {numbers(T_rect_lidar[:3])}\n"]
        put(sequence / "calib.txt", "".join(calibration).encode())
        lines = [numbers(T[:3]) + "\n" for T in T_first_now]
        put(folder / "poses" / f"{_SEQUENCE}.txt", "".join(lines).encode())
        excerpt.write_truth(sequence / "truth", stamps_ns, names=CAMERA_NAMES)
    return out / "sequences" / _SEQUENCE
