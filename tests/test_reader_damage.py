# SPDX-License-Identifier: MIT
"""Damaged recordings of the readers' formats: each is refused in a line that names the place."""

from __future__ import annotations

import gzip
import pickle
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.readers import open_sequence
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


def swap_line(number: int, new: str):
    """Replace a line, numbered from 0."""
    return swap(rf"\A((?:.*\n){{{number}}}).*", rf"\g<1>{new}")


PNG = cv2.imencode(".png", np.zeros((20, 39, 3), np.uint8))[1].tobytes()
LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 1900000\n"
CALIBRATION = "../calib_cam_to_cam.txt"
SWEEP, IMAGE, OXTS = (
    f"{folder}/data/0000000059.{suffix}"
    for folder, suffix in (("velodyne_points", "bin"), ("image_02", "png"), ("oxts", "txt"))
)
TURNS = "velodyne_points/timestamps"
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
    ("nuscenes", "v1.0-mini/ego_pose.json", swap('(?<="rotation": .)[^]]*', "1,1,0,0"), "h 1.414"),
    ("nuscenes", "s*/LIDAR_TOP/*", cut(-7), "a multiple of"),
    ("kitti", "velodyne_points", remove, "no KITTI recording"),
    ("kitti", "velodyne_points/data/59.bin", write(bytes(64)), "has the number 59, as "),
    ("kitti", SWEEP, cut(-5), "truncated: got .* bytes.*multiple of 16"),
    ("kitti", SWEEP, write(bytes(48)), "holds no points .frame 59"),
    ("kitti", SWEEP, write(LFS), "is a Git LFS pointer"),
    ("kitti", CALIBRATION, remove, "cam_to_cam.txt: missing"),
    ("kitti", "../calib_imu_to_velo.txt", remove, "imu_to_velo.txt: missing"),
    ("kitti", CALIBRATION, swap("R_rect_00.*\n", ""), "no key R_rect_00"),
    ("kitti", CALIBRATION, swap("R_rect_00: 1.0", "R_rect_00: one"), "R_rect_00: .*'one'"),
    ("kitti", CALIBRATION, swap("R_rect_00: 1.0", "R_rect_00: 1.01"), "R_rect_00: .*rotation"),
    ("kitti", CALIBRATION, swap("P_rect_02.*", "P_rect_02" + 12 * " 0"), "positive focal lengths"),
    ("kitti", "oxts", remove, "no poses.*register.source=kiss-icp"),
    ("kitti", OXTS, remove, "no oxts record of frame 59.* 60-61"),
    ("kitti", OXTS, swap(r"^\S+", "91"), "latitude of 91"),
    ("kitti", f"{TURNS}.txt", swap_line(59, "2262-09-26 13:10:51"), "no stamp .*59.*0-58, 60-159"),
    ("kitti", f"{TURNS}_start.txt", swap_line(59, ""), "_start.txt: no stamp of frame 59"),
    ("kitti", f"{TURNS}.txt", write("\n1317042651.1\n"), "got '1317042651.1'.* 1970 to 2261"),
    ("kitti", f"{TURNS}_end.txt", swap_line(59, "1990-01-01 00:00:00"), "59 ends .* before it"),
    ("kitti", IMAGE, write(b""), r"0000000059.png.*0 bytes.*PNG or JPEG"),
    ("kitti", IMAGE, write(PNG), "39 x 20 px; expected 1242 x 375.*image_02"),
    ("kitti-odometry", "calib.txt", swap("Tr: ", "Rt: "), "no key Tr"),
    ("kitti-odometry", "calib.txt", swap("Tr: -0.0", "Tr: -9.0"), "rotation"),
    ("kitti-odometry", "times.txt", write("1e999999999\n"), "line 1: got .* 2261"),
    ("kitti-odometry", "times.txt", swap("2.0", "1.0"), "got 3 poses, .* stamps that ascend"),
    ("kitti-odometry", POSES, swap(r"^\S+", "nan"), "line 1: got a value that is not finite"),
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


LISTED = {  # folders of sweeps and of images, and the table that names their files
    "nuscenes": ("samples/LIDAR_TOP", "samples/image_02", "v1.0-mini/sample_data.json"),
    "dgp": ("point_cloud/LIDAR", "rgb/image_02", "scene_abc.json"),
}


@pytest.mark.parametrize("format", LISTED)
def test_what_is_not_on_the_disk_leaves_a_gap(copied, format) -> None:
    place, (sweeps, images, _) = copied(format), LISTED[format]
    sorted((place / sweeps).iterdir())[1].unlink()
    min((place / images).iterdir()).unlink()
    sequence = open_sequence(place)
    assert list(sequence.frames) == [0, 2]
    assert list(sequence.image_stamps_ns("image_02")) == [1, 2]
    with pytest.raises(InputError, match="frames that exist: 0, 2"):
        sequence[1]


@pytest.mark.parametrize("format", LISTED)
def test_no_file_outside_of_the_folder_is_read(copied, format) -> None:
    place, (sweeps, _, table) = copied(format), LISTED[format]
    text, name = (place / table).read_text(), min((place / sweeps).iterdir()).name
    for file in ("../secret.bin", "/etc/hostname"):
        (place / table).write_text(text.replace(f"{sweeps}/{name}", file))
        says = f"{table}.*names the file '{file}', outside of"
        check_refused(f"{format}:{place}", says, place)
    (place / table).write_text(text.replace(sweeps, f"../{place.name}/{sweeps}"))
    open_sequence(place)
