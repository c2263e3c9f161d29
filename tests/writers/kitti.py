# SPDX-License-Identifier: MIT
"""A street as KITTI odometry, tracking and KITTI-360, with the camera image_02."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.outputs.simulated_street import (
    T_lidar_imu,
    numbers,
    oxts_line,
    projections,
    stamp_lines,
    sweep_data,
)
from densify.street.cameras import CAMERAS, T_RECTIFIED_LIDAR, T_level_lidar
from writers.excerpt import Excerpt, drawn_boxes, put

DRIVE = "2026_06_12_drive_0000_sync"


def write_odometry(excerpt: Excerpt, out: Path) -> Path:
    """Points are compensated to the middle of the sweep with the true path."""
    street, sequence = excerpt.street, out / "sequences" / "00"
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    for number, frame in enumerate(excerpt.frames):
        offset_ns = excerpt.returns(frame).offset_ns
        points = excerpt.poses().compensate(excerpt.fired(frame), stamps_ns[number], offset_ns)
        put(sequence / "velodyne" / f"{number:06d}.bin", sweep_data(street, frame, points))
        for name in excerpt.cameras:
            put(sequence / "image_2" / f"{number:06d}.png", excerpt.png_image(name, frame))
    T_rect_lidar = _T_rect_lidar(excerpt)
    T_world_rect = excerpt.T_world_ego(np.array(stamps_ns), poses.inverse(T_rect_lidar))
    T_first_now = poses.inverse(T_world_rect[0]) @ T_world_rect
    since_s = [f"{(ns - stamps_ns[0]) * 1e-9:.6e}\n" for ns in stamps_ns]
    put(sequence / "times.txt", "".join(since_s))
    put(sequence / "calib.txt", f"{projections('P{}')}Tr: {numbers(T_rect_lidar[:3])}\n")
    put(out / "poses" / "00.txt", "".join(numbers(T[:3]) + "\n" for T in T_first_now))
    excerpt.write_truth(sequence / "truth", stamps_ns, names={"image_02": "image_2"})
    return sequence


def write_tracking(excerpt: Excerpt, out: Path) -> Path:
    """With the boxes that image_02 shows."""
    street, folder = excerpt.street, out / "training"
    for number, frame in enumerate(excerpt.frames):
        put(folder / "velodyne/0000" / f"{number:06d}.bin", sweep_data(street, frame))
        for name in excerpt.cameras:
            put(folder / name / "0000" / f"{number:06d}.png", excerpt.png_image(name, frame))
    calibration = (
        f"{projections('P{}')}R_rect {numbers(np.eye(3))}\n"
        f"Tr_velo_cam {numbers(_T_rect_lidar(excerpt)[:3])}\n"
        f"Tr_imu_velo {numbers(T_lidar_imu(street.simulator.tilt_deg)[:3])}\n"
    )
    put(folder / "calib" / "0000.txt", calibration)
    records = [oxts_line(street, frame, excerpt.frames[0]) for frame in excerpt.frames]
    put(folder / "oxts" / "0000.txt", "".join(records))
    lines = [line for n, f in enumerate(excerpt.frames) for line in _labels(excerpt, f, n)]
    put(folder / "label_02" / "0000.txt", "".join(lines))
    excerpt.write_truth(folder / "truth", [street.stamp_ns(f) for f in excerpt.frames])
    return folder


def _T_rect_lidar(excerpt: Excerpt) -> Float:
    return T_RECTIFIED_LIDAR @ T_level_lidar(excerpt.street.simulator.tilt_deg)


def _labels(excerpt: Excerpt, frame: int, number: int) -> Iterator[str]:
    """Lines of the boxes in the image, each at the time when the scanner met it."""
    camera, drawn = CAMERAS["image_02"], drawn_boxes(excerpt, frame)
    T_rect_lidar = _T_rect_lidar(excerpt)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for instance, T_world_box, size_m, met_ns in zip(
        drawn.instance, drawn.T_world_box, drawn.size_m, drawn.met_ns, strict=True
    ):
        T_rect_box = T_rect_lidar @ poses.inverse(excerpt.pose(met_ns)) @ T_world_box
        T_cam_box = camera.T_cam_lidar @ poses.inverse(T_RECTIFIED_LIDAR) @ T_rect_box
        seen = _rectangle(camera, poses.transform(T_cam_box, corners * size_m))
        if seen is None:
            continue
        length_m, width_m, height_m = size_m
        front, (x, y, z) = T_rect_box[:3, 0], T_rect_box[:3, 3]
        turn = float(np.arctan2(-front[2], front[0]))
        place = [height_m, width_m, length_m, x, y + height_m / 2, z, turn]
        values = numbers(np.array([turn - np.arctan2(x, z), *seen, *place]))
        yield f"{number} {instance} Car 0 0 {values}\n"


def _rectangle(camera: Camera, corners_cam: Float) -> tuple[float, ...] | None:
    """Left, top, right, bottom in the image of the corners before the camera."""
    ahead = corners_cam[corners_cam[:, 2] > 0.5]
    if not len(ahead):
        return None
    uv = (ahead / ahead[:, 2:]) @ camera.K[:2].T
    last = np.array([camera.width_px - 1, camera.height_px - 1])
    low, high = np.clip(uv.min(axis=0), 0, last), np.clip(uv.max(axis=0), 0, last)
    return (*low, *high) if (high > low).all() else None


def write_kitti_360(excerpt: Excerpt, out: Path) -> Path:
    """The camera as built is turned by R_rect against the rectified one, image_00."""
    street, drive = excerpt.street, out / "data_3d_raw" / DRIVE
    tilt_deg, stamps_ns = street.simulator.tilt_deg, [street.stamp_ns(f) for f in excerpt.frames]
    for number, frame in enumerate(excerpt.frames):
        path = drive / "velodyne_points" / "data" / f"{number:010d}.bin"
        put(path, sweep_data(street, frame))
    put(drive / "velodyne_points" / "timestamps.txt", stamp_lines(np.array(stamps_ns)))
    folder = out / "data_2d_raw" / DRIVE / "image_00"
    images = excerpt.image_numbers("image_02")
    for number, image in enumerate(images):
        put(folder / "data_rect" / f"{number:010d}.png", excerpt.png_image("image_02", image))
    exposed_ns = street.image_stamps_ns("image_02")
    put(folder / "timestamps.txt", stamp_lines(np.array([exposed_ns[n] for n in images])))
    T_rect_cam = np.eye(4)
    T_rect_cam[:3, :3] = Rotation.from_rotvec([0.004, -0.006, 0.002]).as_matrix()
    camera = CAMERAS["image_02"]
    T_cam_lidar = poses.inverse(T_rect_cam) @ camera.T_cam_lidar @ T_level_lidar(tilt_deg)
    T_pose_cam = poses.inverse(T_cam_lidar @ T_lidar_imu(tilt_deg))
    perspective = (
        f"S_rect_00: {camera.width_px}.0 {camera.height_px}.0\n"
        f"R_rect_00: {numbers(T_rect_cam[:3, :3])}\nP_rect_00: {numbers(camera.K @ np.eye(3, 4))}\n"
    )
    calibration = out / "calibration"
    put(calibration / "calib_cam_to_pose.txt", f"image_00: {numbers(T_pose_cam[:3])}\n")
    put(calibration / "calib_cam_to_velo.txt", numbers(poses.inverse(T_cam_lidar)[:3]) + "\n")
    put(calibration / "perspective.txt", perspective)
    T_world_pose = excerpt.T_world_ego(np.array(stamps_ns), T_lidar_imu(tilt_deg))
    lines = [f"{number} {numbers(T[:3])}\n" for number, T in enumerate(T_world_pose)]
    put(out / "data_poses" / DRIVE / "poses.txt", "".join(lines))
    excerpt.write_truth(drive / "truth", stamps_ns, names={"image_02": "image_00"})
    return out
