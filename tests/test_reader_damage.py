# SPDX-License-Identifier: MIT
"""Damaged recordings of the readers' formats: each is refused in a line that names the place."""

from __future__ import annotations

import gzip
import pickle
import re
import shutil
from pathlib import Path

import pytest

from tests.reader_checks import check_refused

DRIVE = "2026_06_12_drive_0000_sync"


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def cut(num_bytes: int):
    return lambda path: path.write_bytes(path.read_bytes()[:num_bytes])


def swap(old: str, new: str):
    """Replace the first match."""
    return lambda path: path.write_text(re.sub(old, new, path.read_text(), count=1))


def write(content: str | bytes):
    data = content if isinstance(content, bytes) else content.encode()
    return lambda path: path.write_bytes(data)


PICKLE = pickle.dumps([1, 2])
POSES = "../../poses/00.txt"
TO_POSE = "calibration/calib_cam_to_pose.txt"
STAMPS = f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt"
DAMAGE = [  # format, file, what happens to it, what is said
    ("argoverse2", "city_SE3_egovehicle.feather", cut(-99), "not a whole"),
    ("argoverse2", "sensors/lidar/*.feather", cut(-99), "not a whole"),
    ("argoverse2", "calibration/egovehicle_SE3_sensor.feather", remove, "no such file"),
    ("dgp", "scene_*.json", cut(-9), "not a whole JSON"),
    ("dgp", "point_cloud/LIDAR", remove, "none of its sweeps is there"),
    ("dgp", "calibration/*.json", swap('"names": .', '"names": ["x",'), "names"),
    ("dgp", "point_cloud/LIDAR/*.npz", write(PICKLE), "not a readable .npz"),
    ("pandaset", "lidar/poses.json", cut(-40), "not a whole JSON file"),
    ("pandaset", "lidar/poses.json", swap(r"}}, {", "}}], [{"), "."),
    ("pandaset", "lidar", remove, "no sweeps"),
    ("pandaset", "lidar/00.pkl.gz", cut(-40), "not a gzipped pandas data frame"),
    ("pandaset", "lidar/00.pkl.gz", write(gzip.compress(PICKLE)), "it holds a list"),
    ("waymo", "lidar_calibration", remove, "no such file"),
    ("waymo", "lidar/*.parquet", cut(-3000), "not a whole parquet file"),
    ("nuscenes", "v1.0-mini", remove, "no nuScenes tables"),
    ("nuscenes", "v1.0-mini/ego_pose.json", remove, "no such table"),
    ("nuscenes", "v1.0-mini/sample_data.json", cut(-40), "not a whole JSON table"),
    (
        "nuscenes",
        "v1.0-mini/ego_pose.json",
        swap(r'"rotation": \[[^]]*', '"rotation": [1, 1, 0, 0'),
        "length 1.414",
    ),
    ("nuscenes", "s*/LIDAR_TOP/*", cut(-7), "a multiple of"),
    ("kitti-odometry", "calib.txt", remove, "missing"),
    ("kitti-odometry", "calib.txt", swap("Tr: ", "Rt: "), "no key Tr"),
    ("kitti-odometry", "calib.txt", swap("Tr: -0.0", "Tr: -9.0"), "rotation"),
    ("kitti-odometry", "times.txt", write("1e999999999\n"), "line 1: got .* 2261"),
    ("kitti-odometry", "times.txt", swap("2.0", "1.0"), "line 3: got"),
    ("kitti-odometry", POSES, swap(" ", " nan "), "line 1: got 13 values"),
    ("kitti-odometry", "velodyne/000000.bin", cut(-5), "truncated"),
    ("kitti-odometry", "image_2/000000.png", write("x"), "not a complete image"),
    ("kitti-tracking", "calib/0000.txt", swap("R_rect", "R"), "no key R_rect"),
    ("kitti-tracking", "oxts/0000.txt", cut(70), "line 1: got"),
    ("kitti-360", STAMPS, remove, "cannot be read"),
    ("kitti-360", "calibration/perspective.txt", swap("1242.0", "1240"), "expected 1240 x 375"),
    ("kitti-360", f"data_poses/{DRIVE}/poses.txt", write("0 1 0\n"), "got 3 values"),
    ("kitti-360", TO_POSE, swap("image_00", "image_04"), "no key image_00"),
]


@pytest.mark.parametrize(("format", "file", "harm", "says"), DAMAGE, ids=range(len(DAMAGE)))
def test_damage_is_refused_in_a_line(copied, tmp_path, format, file, harm, says) -> None:
    place = copied(format)
    harm(min(place.glob(file), default=place / file))
    check_refused(f"{format}:{place}", says, tmp_path)
