# SPDX-License-Identifier: MIT
"""The readers of KITTI odometry, KITTI tracking and KITTI-360 on streets written in their formats,
on broken ones, and on a real sequence."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry import cameras
from densify.geometry.poses import inverse
from densify.readers import open_sequence
from densify.readers.kitti import Kitti360, KittiOdometry
from tests.reader_checks import check_cameras, check_sweeps, check_truth
from tests.recorded import CAMERA, FRAMES

DRIVE = "2026_06_12_drive_0000_sync"


def test_odometry_is_given_back(recorded, excerpt):
    sequence, street = open_sequence(recorded("kitti-odometry")), excerpt.street
    clock_ns = -street.stamp_ns(FRAMES[0])
    check_cameras(sequence, excerpt, names={CAMERA: "image_2"}, clock_ns=clock_ns)
    check_truth(sequence, excerpt)
    assert [sequence.stamp_ns(n) for n in range(3)] == [0, 100_000_000, 200_000_000]
    first, T_world_first = sequence.T_world_lidar(0), street.T_world_lidar(FRAMES[0])
    np.testing.assert_allclose(first, np.eye(4), atol=1e-9)
    for number, frame in enumerate(FRAMES):
        sweep, true = sequence[number], street[frame]
        np.testing.assert_array_equal(sweep.intensity, true.intensity)
        # undone, but for some that were fired straight behind: at the begin of the turn or its end
        away_m = np.linalg.norm(sweep.points - true.points, axis=1)
        late_ns = np.abs(sweep.offset_ns - true.offset_ns)
        assert np.percentile(away_m, 99.8) < 0.005 and away_m.max() < 1.2  # turns between poses
        assert np.percentile(late_ns, 99.8) < 50_000
        moved = inverse(T_world_first) @ street.T_world_lidar(frame)
        np.testing.assert_allclose(sequence.T_world_lidar(number), moved, atol=1e-6)


def test_odometry_without_poses_is_given_as_it_stands(copied, excerpt):
    place = copied("kitti-odometry")
    (place.parent.parent / "poses/00.txt").unlink()
    sequence = KittiOdometry(place)
    for number, frame in enumerate(FRAMES):
        sweep, true = sequence[number], excerpt.street.truth.sweep(frame)
        assert sweep.offset_ns is None and sweep.scanner_origins is None
        # compensated: where everything that stands was at the stamp
        still = ~true.moving
        np.testing.assert_allclose(sweep.points[still], true.points[still], atol=1e-4)


def test_tracking_is_given_back(recorded, excerpt):
    sequence = open_sequence(recorded("kitti-tracking"))
    clock_ns = -excerpt.street.stamp_ns(FRAMES[0])
    check_sweeps(sequence, excerpt, offset_ns=20, clock_ns=clock_ns)
    check_cameras(sequence, excerpt, clock_ns=clock_ns)
    check_truth(sequence, excerpt)


def test_kitti_360_is_given_back(recorded, excerpt):
    sequence = open_sequence(recorded("kitti-360"))
    check_sweeps(sequence, excerpt, offset_ns=20)
    check_cameras(sequence, excerpt, names={CAMERA: "image_00"})
    check_truth(sequence, excerpt)


def test_scenes(recorded):
    root = recorded("kitti-odometry").parent.parent
    assert open_sequence(root).name == open_sequence(f"kitti-odometry:{root}#00").name == "00"
    for name, scene in (("kitti-tracking", "0000"), ("kitti-360", DRIVE)):
        assert scene in open_sequence(f"{name}:{recorded(name)}#{scene}").name
    for reader in ("kitti-odometry", "kitti-tracking", "kitti-360"):
        spec = root if reader == "kitti-odometry" else recorded(reader)
        with pytest.raises(InputError, match="no recording 77; choose one"):
            open_sequence(f"{reader}:{spec}#77")
        with pytest.raises(InputError, match=r"no KITTI.* expected"):
            open_sequence(f"{reader}:{spec.parent}")


def test_sparse_poses_are_interpolated(copied):
    place = copied("kitti-360")
    poses = place / "data_poses" / DRIVE / "poses.txt"
    lines = poses.read_text().splitlines(keepends=True)
    whole = Kitti360(place, DRIVE).T_world_lidar(1)
    poses.write_text(lines[0] + lines[2])
    between = Kitti360(place, DRIVE).T_world_lidar(1)
    assert 0 < np.abs(between - whole).max() < 0.02
    poses.unlink()
    with pytest.raises(InputError, match="no poses"):
        Kitti360(place, DRIVE).T_world_lidar(1)


FISHEYE = """%YAML:1.0
---
model_type: MEI
camera_name: image_02
image_width: 1400
image_height: 1400
mirror_parameters:
   xi: 2.2
distortion_parameters:
   k1: 0.016
   k2: 1.65
   p1: 0.0
   p2: 0.0
projection_parameters:
   gamma1: 1336.0
   gamma2: 1335.0
   u0: 716.9
   v0: 705.7
"""


@pytest.fixture
def fisheye(copied):
    """A drive with an image of a fisheye that looks to the left, a metre to the scanner's left."""
    place = copied("kitti-360")
    images = place / "data_2d_raw" / DRIVE / "image_02"
    (images / "data_rgb").mkdir(parents=True)
    cv2.imwrite(str(images / "data_rgb/0000000001.png"), np.zeros((1400, 1400, 3), np.uint8))
    stamps = place / "data_3d_raw" / DRIVE / "velodyne_points/timestamps.txt"
    shutil.copy(stamps, images)
    (place / "calibration/image_02.yaml").write_text(FISHEYE)
    to_pose = place / "calibration/calib_cam_to_pose.txt"
    T_pose_cam = np.fromstring(to_pose.read_text().split(":")[1].split("\n")[0], sep=" ")
    T_pose_cam0 = np.vstack([T_pose_cam.reshape(3, 4), [0, 0, 0, 1]])
    to_velo = place / "calibration/calib_cam_to_velo.txt"
    T_lidar_cam0 = np.vstack([np.loadtxt(to_velo).reshape(3, 4), [0, 0, 0, 1]])
    T_lidar_cam = np.array([[1.0, 0, 0, 0], [0, 0, 1, 1], [0, -1, 0, 0], [0, 0, 0, 1]])
    T_pose_cam = T_pose_cam0 @ inverse(T_lidar_cam0) @ T_lidar_cam
    line = "image_02: " + " ".join(map(repr, T_pose_cam[:3].ravel().tolist()))
    to_pose.write_text(to_pose.read_text() + line + "\n")
    return place


def test_a_fisheye_projects_as_the_data_sets_tools_do(fisheye):
    sequence = Kitti360(fisheye, DRIVE)
    camera = sequence.cameras["image_02"]
    assert list(sequence.image_stamps_ns("image_02")) == [1]
    assert sequence.image("image_02", 1).shape == (1400, 1400, 3)
    points = np.array([[2.0, 5.0, 0.5], [-3.0, 4.0, 1.0], [0.0, -5.0, 0.0]])
    in_camera = points @ camera.T_cam_lidar[:3, :3].T + camera.T_cam_lidar[:3, 3]
    np.testing.assert_allclose(in_camera[0], [2.0, -0.5, 4.0], atol=1e-9)
    uv, seen = cameras.image_points(camera, in_camera)
    assert seen.tolist() == [True, True, False]
    # kitti360scripts' CameraFisheye.cam2image, by hand
    x, y, z = in_camera[0] / np.sqrt(2.0**2 + 0.5**2 + 4.0**2)
    x, y = x / (z + 2.2), y / (z + 2.2)
    bent = 1 + 0.016 * (x * x + y * y) + 1.65 * (x * x + y * y) ** 2
    np.testing.assert_allclose(uv[0], [1336 * x * bent + 716.9, 1335 * y * bent + 705.7])


# A real sequence


def test_real_odometry_sweeps(test_data):
    path = test_data / "kitti_odometry/sequences/00"
    for place in (path, path.parent.parent):
        sequence = open_sequence(place)
        assert isinstance(sequence, KittiOdometry)
    assert list(sequence.frames) == [0, 1, 2] and not sequence.cameras
    assert [len(sequence[n]) for n in range(3)] == [
        1_994_688 // 16,
        1_993_680 // 16,
        1_991_648 // 16,
    ]
    sweep = sequence[0]
    raw = np.fromfile(path / "velodyne/000000.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(sweep.points, raw[:, :3])
    np.testing.assert_array_equal(sweep.intensity, raw[:, 3])
    near = np.hypot(*sweep.points[:, :2].T) < 10
    assert np.median(sweep.points[near, 2]) == pytest.approx(-1.73, abs=0.1)  # the road


def test_undoing_sharpens_real_elevations(test_data, tmp_path):
    """The three sweeps were taken going straight ahead, 0.707 m each (by registration)."""
    path = test_data / "kitti_odometry/sequences/00/velodyne"
    (tmp_path / "velodyne").symlink_to(path.resolve())
    T = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
    (tmp_path / "calib.txt").write_text("Tr: " + T.format(0))
    (tmp_path / "poses.txt").write_text("".join(T.format(0.707 * n) for n in range(3)))

    def entropy(sweep):
        x, y, z = sweep.points.T
        range_m = np.linalg.norm(sweep.points, axis=1)
        elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))[(range_m > 5) & (range_m < 20)]
        share = np.histogram(elevation_deg, np.arange(-26, 4, 0.02))[0] / len(elevation_deg)
        return -np.sum(share[share > 0] * np.log(share[share > 0]))

    undone, stored = KittiOdometry(tmp_path)[1], open_sequence(path.parent)[1]
    assert undone.offset_ns is not None and stored.offset_ns is None
    assert entropy(undone) < entropy(stored) - 0.1
    (tmp_path / "poses.txt").write_text("".join(T.format(-0.707 * n) for n in range(3)))
    assert entropy(KittiOdometry(tmp_path)[1]) > entropy(stored) - 0.01
