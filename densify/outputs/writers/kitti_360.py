# SPDX-License-Identifier: MIT
"""Writes a street as a KITTI-360 drive, which `densify.readers.kitti.kitti_360` opens::

OUT/data_3d_raw/2026_06_12_drive_0000_sync/velodyne_points/{data/0000000000.bin, timestamps.txt}
OUT/data_2d_raw/2026_06_12_drive_0000_sync/image_00/{data_rect/0000000000.png, timestamps.txt}
OUT/data_poses/2026_06_12_drive_0000_sync/poses.txt
OUT/calibration/{calib_cam_to_pose.txt, calib_cam_to_velo.txt, perspective.txt}
OUT/data_3d_raw/.../truth/  as in `densify.readers.truth_files`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.types import Float, Int
from densify.outputs.writers.excerpt import Excerpt, check_cameras_fit, new_folder, put
from densify.outputs.writers.kitti_raw import (
    T_LEVEL_IMU,
    check_azimuth_tells_time,
    numbers,
    stamp_lines,
    velodyne_bytes,
)
from densify.street.cameras import CAMERAS, T_level_lidar

CAMERA_NAMES = {"image_02": "image_00", "image_03": "image_01"}
"""The street's cameras, and what the format calls them."""

_DRIVE = "2026_06_12_drive_0000_sync"


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for the cameras image_02 and image_03,
    which become image_00 and image_01, and for a sensor whose points' times follow from their
    azimuth."""
    street = excerpt.street
    check_cameras_fit(excerpt, "KITTI-360", CAMERA_NAMES)
    check_azimuth_tells_time(street, "KITTI-360")
    stamps_ns = np.array([street.stamp_ns(frame) for frame in excerpt.frames])
    T_lidar_pose = poses.inverse(T_level_lidar(street.simulator.tilt_deg)) @ T_LEVEL_IMU
    with new_folder(out, overwrite) as folder:
        drive = folder / "data_3d_raw" / _DRIVE
        for number, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            data = velodyne_bytes(returns.points, returns.intensity)
            put(drive / "velodyne_points" / "data" / f"{number:010d}.bin", data)
        put(drive / "velodyne_points" / "timestamps.txt", stamp_lines(stamps_ns))
        for name in excerpt.cameras:
            _write_images(folder / "data_2d_raw" / _DRIVE / CAMERA_NAMES[name], excerpt, name)
        for name, text in _calibration(T_lidar_pose, street.simulator.tilt_deg).items():
            put(folder / "calibration" / name, text.encode())
        T_world_pose = excerpt.T_world_ego(stamps_ns, T_lidar_pose)
        lines = [f"{number} {numbers(T[:3])}\n" for number, T in enumerate(T_world_pose)]
        put(folder / "data_poses" / _DRIVE / "poses.txt", "".join(lines).encode())
        excerpt.write_truth(drive / "truth", stamps_ns.tolist(), names=CAMERA_NAMES)
    return out


def _write_images(folder: Path, excerpt: Excerpt, name: str) -> None:
    images = excerpt.image_numbers(name)
    for number, image in enumerate(images):
        put(folder / "data_rect" / f"{number:010d}.png", excerpt.encoded_image(name, image))
    exposed_ns: Int = np.array([excerpt.street.image_stamps_ns(name)[image] for image in images])
    put(folder / "timestamps.txt", stamp_lines(exposed_ns))


def _calibration(T_lidar_pose: Float, tilt_deg: float) -> dict[str, str]:
    """Name to content. The cameras as built are turned by R_rect against the rectified ones."""
    to_pose, perspective = "", ""
    T_rect_cam = np.eye(4)
    T_rect_cam[:3, :3] = Rotation.from_rotvec([0.004, -0.006, 0.002]).as_matrix()
    for own, name in CAMERA_NAMES.items():
        camera = CAMERAS[own]
        T_cam_lidar = poses.inverse(T_rect_cam) @ camera.T_cam_lidar @ T_level_lidar(tilt_deg)
        to_pose += f"{name}: {numbers(poses.inverse(T_cam_lidar @ T_lidar_pose)[:3])}\n"
        P = camera.K @ np.eye(3, 4)
        perspective += f"S_rect_{name[-2:]}: {camera.width_px}.0 {camera.height_px}.0\n"
        perspective += (
            f"R_rect_{name[-2:]}: {numbers(T_rect_cam[:3, :3])}\nP_rect_{name[-2:]}: {numbers(P)}\n"
        )
    T_rect_lidar = CAMERAS["image_02"].T_cam_lidar @ T_level_lidar(tilt_deg)
    T_cam_lidar = poses.inverse(T_rect_cam) @ T_rect_lidar
    return {
        "calib_cam_to_pose.txt": to_pose,
        "calib_cam_to_velo.txt": numbers(poses.inverse(T_cam_lidar)[:3]) + "\n",
        "perspective.txt": perspective,
    }
