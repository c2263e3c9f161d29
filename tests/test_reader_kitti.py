# SPDX-License-Identifier: MIT
"""KITTI raw, odometry, tracking and KITTI-360: streets written in their formats, and real drives.

`test_simulate` reads a street back that was written as a raw drive.
"""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import cameras, poses
from densify.readers import describe, open_sequence
from densify.readers.kitti import KittiOdometry, KittiRaw
from tests.reader_checks import check_cameras, check_sweeps, check_truth
from tests.recorded import CAMERA, FRAMES

DRIVE = "2026_06_12_drive_0000_sync"
FIRST, MIDDLE, LAST = FRAMES


# Raw drives


@pytest.fixture
def drive(copied):
    return copied("kitti")


def edit_line(path, frame, edit):
    """Replace the line of a frame."""
    lines = path.read_text().splitlines()
    lines[frame] = edit(lines[frame])
    path.write_text("\n".join(lines))


def late(milliseconds):
    """Return a function that makes a recorded stamp later, exactly."""
    step = np.timedelta64(milliseconds * 1_000_000 + 7, "ns")
    return lambda text: str(np.datetime64(text, "ns") + step).replace("T", " ")


def test_start_and_end_of_sweeps_suffice_for_their_stamps(drive):
    stamp_ns = KittiRaw(drive).stamp_ns(MIDDLE)
    (drive / "velodyne_points" / "timestamps.txt").unlink()
    sequence = KittiRaw(drive)
    assert sequence[MIDDLE].stamp_ns == stamp_ns and sequence[MIDDLE].offset_ns is not None
    assert any("no timestamps.txt" in text for text in sequence.gaps())
    assert not any("100 ms" in text for text in sequence.gaps())
    (drive / "velodyne_points" / "timestamps_end.txt").unlink()
    sequence = KittiRaw(drive)
    assert sequence.stamp_ns(MIDDLE) == MIDDLE * 100_000_000
    assert sequence[MIDDLE].offset_ns is None
    assert any("100 ms" in text for text in sequence.gaps())


def test_invalid_rows_are_dropped_and_the_rest_keep_their_row(drive):
    columns = np.ones((8, 4), "<f4") * np.arange(1, 9, dtype="<f4")[:, None]
    columns[[0, 7]] = 0
    columns[2, 1], columns[3, 3], columns[5, 0] = np.nan, np.nan, np.inf
    columns[4, :3] = 0  # at the origin, with a reflectance
    columns[6, :2] = 0  # straight up is a position
    (drive / f"velodyne_points/data/{FIRST:010d}.bin").write_bytes(columns.tobytes())
    sweep = KittiRaw(drive)[FIRST]
    np.testing.assert_array_equal(sweep.row, [1, 3, 6])
    np.testing.assert_array_equal(sweep.points, columns[[1, 3, 6], :3])
    np.testing.assert_array_equal(sweep.intensity, [2, 0, 7])  # 0 where there is none
    assert sweep.offset_ns.shape == (3,)


def test_cameras_project_as_the_calibration_chain_says(drive):
    """By hand, with a rectification and a camera beside the first."""
    R_rect = Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix()
    R, t = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.01, -0.08, -0.27])
    K = np.array([[50.0, 0, 19.5], [0, 50.0, 9.5], [0, 0, 1]])
    P = np.column_stack([K, K @ [0.06, 0.0, 0.003]])

    def words(array):
        return " ".join(map(repr, np.ravel(array).tolist()))

    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: {words(R_rect)}\nS_rect_02: 40 20\nP_rect_02: {words(P)}\n"
    )
    (drive.parent / "calib_velo_to_cam.txt").write_text(f"R: {words(R)}\nT: {words(t)}\n")
    (drive / "image_03").mkdir()  # not in the calibration
    (camera,) = KittiRaw(drive).cameras.values()
    assert (camera.name, camera.width_px, camera.height_px) == ("image_02", 40, 20)
    point = np.array([12.0, 1.5, -0.7])
    projected = camera.K @ poses.transform(camera.T_cam_lidar, point[None])[0]
    np.testing.assert_allclose(projected, P @ [*R_rect @ (R @ point + t), 1], rtol=1e-12)


def test_image_stamps_are_those_of_the_exposure(drive):
    sequence = KittiRaw(drive)
    exposed_ns = sequence.image_stamps_ns(CAMERA)[MIDDLE]
    path = drive / CAMERA / "timestamps.txt"
    edit_line(path, MIDDLE, late(2))
    assert KittiRaw(drive).image_stamps_ns(CAMERA)[MIDDLE] == exposed_ns + 2_000_007
    path.unlink()
    assert KittiRaw(drive).image_stamps_ns(CAMERA)[MIDDLE] == sequence.stamp_ns(MIDDLE)


def test_a_drive_of_sweeps_alone_opens(drive):
    for path in (*drive.parent.glob("calib*.txt"), *drive.glob("image_*"), drive / "oxts"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    sequence = KittiRaw(drive)
    assert dict(sequence.cameras) == {} and len(sequence[FIRST]) > 1000
    assert "cameras" in describe(sequence)


def test_poses_are_interpolated_to_the_sweep(drive):
    """The record of each sweep comes 17 ms after it."""
    T = [KittiRaw(drive).T_world_lidar(frame) for frame in FRAMES]
    for frame in FRAMES:
        edit_line(drive / "oxts" / "timestamps.txt", frame, late(17))
    sequence = KittiRaw(drive)
    for number in (1, 2):
        between = poses.interpolate(T[number - 1], T[number], 0.83)
        np.testing.assert_allclose(sequence.T_world_lidar(FRAMES[number]), between, atol=1e-4)
        assert np.abs(T[number] - between).max() > 0.05


def test_a_line_that_is_no_stamp_costs_its_frame_alone(drive):
    whole = KittiRaw(drive)
    for path in (drive / "velodyne_points", drive / "oxts"):
        edit_line(path / "timestamps.txt", MIDDLE, lambda _: "yesterday")
    sequence = KittiRaw(drive)
    assert sequence.stamp_ns(LAST) == whole.stamp_ns(LAST)
    np.testing.assert_allclose(sequence.T_world_lidar(FIRST), whole.T_world_lidar(FIRST), atol=1e-3)
    with pytest.raises(InputError, match=f"no stamp of frame {MIDDLE}"):
        sequence.stamp_ns(MIDDLE)


def test_description_of_a_drive(drive):
    (drive / f"velodyne_points/data/{MIDDLE:010d}.bin").unlink()
    sequence = KittiRaw(drive)
    table = dict(line.split(maxsplit=1) for line in describe(sequence).splitlines())
    assert table["frames"] == f"{FIRST}, {LAST} (2, 1 missing between them)"
    assert table["rate"] == "5.00 Hz"
    num_points = (f"{len(sequence[frame]):,} in frame {frame}" for frame in (FIRST, LAST))
    assert table["points"] == ", ".join(num_points)
    assert table["image_02"].startswith("1242 x 375 px, fx ")
    assert table["image_02"].endswith(f"rectified, 3 images: {FIRST}-{LAST}, 10.00 Hz")
    assert table["poses"].startswith("yes, a path of ") and table["truth"] == "none"


# Relatives


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
        moved = poses.inverse(T_world_first) @ street.T_world_lidar(frame)
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


@pytest.mark.parametrize(("format", "camera"), [("tracking", CAMERA), ("360", "image_00")])
def test_tracking_and_360_are_given_back(format, camera, recorded, excerpt):
    sequence = open_sequence(recorded(f"kitti-{format}"))
    clock_ns = -excerpt.street.stamp_ns(FRAMES[0]) * (format == "tracking")
    check_sweeps(sequence, excerpt, offset_ns=20, clock_ns=clock_ns)
    check_cameras(sequence, excerpt, names={CAMERA: camera}, clock_ns=clock_ns)
    check_truth(sequence, excerpt)


@pytest.mark.parametrize(
    ("format", "scene"),
    [("kitti-odometry", "00"), ("kitti-tracking", "0000"), ("kitti-360", DRIVE)],
)
def test_scenes(recorded, format, scene):
    place = recorded(format)
    root = place.parent.parent if format == "kitti-odometry" else place
    names = {open_sequence(spec).name for spec in (root, f"{format}:{root}#{scene}")}
    assert len(names) == 1 and scene in names.pop()
    with pytest.raises(InputError, match="no recording 77; choose one"):
        open_sequence(f"{format}:{root}#77")
    with pytest.raises(InputError, match=r"no KITTI.* expected"):
        open_sequence(f"{format}:{root.parent}")


def test_sparse_poses_are_interpolated(copied):
    place = copied("kitti-360")
    path = place / "data_poses" / DRIVE / "poses.txt"
    lines = path.read_text().splitlines(keepends=True)
    whole = open_sequence(place).T_world_lidar(1)
    path.write_text(lines[0] + lines[2])
    assert 0 < np.abs(open_sequence(place).T_world_lidar(1) - whole).max() < 0.02
    path.unlink()
    with pytest.raises(InputError, match="no poses"):
        open_sequence(place).T_world_lidar(1)


FISHEYE = """%YAML:1.0
---
image_width: 1400
image_height: 1400
mirror_parameters: {xi: 2.2}
distortion_parameters: {k1: 0.016, k2: 1.65, p1: 0.0, p2: 0.0}
projection_parameters: {gamma1: 1336.0, gamma2: 1335.0, u0: 716.9, v0: 705.7}
"""


def test_a_fisheye_projects_as_the_data_sets_tools_do(copied):
    """It looks to the left, a metre to the left of the scanner."""
    place, unit = copied("kitti-360"), "1 0 0 0 0 1 0 0 0 0 1 0"
    images, calibration = place / "data_2d_raw" / DRIVE / "image_02", place / "calibration"
    (images / "data_rgb").mkdir(parents=True)
    cv2.imwrite(str(images / "data_rgb/0000000001.png"), np.zeros((1400, 1400, 3), np.uint8))
    shutil.copy(place / "data_3d_raw" / DRIVE / "velodyne_points/timestamps.txt", images)
    (calibration / "image_02.yaml").write_text(FISHEYE)
    (calibration / "calib_cam_to_velo.txt").write_text(unit)
    to_pose = f"image_00: {unit}\nimage_02: 1 0 0 0 0 0 1 1 0 -1 0 0\n"
    (calibration / "calib_cam_to_pose.txt").write_text(to_pose)
    sequence = open_sequence(place)
    camera = sequence.cameras["image_02"]
    assert list(sequence.image_stamps_ns("image_02")) == [1]
    assert sequence.image("image_02", 1).shape == (1400, 1400, 3)
    points = np.array([[2.0, 5.0, 0.5], [-3.0, 4.0, 1.0], [0.0, -5.0, 0.0]])
    in_camera = poses.transform(camera.T_cam_lidar, points)
    np.testing.assert_allclose(in_camera[0], [2.0, -0.5, 4.0], atol=1e-9)
    uv, seen = cameras.image_points(camera, in_camera)
    assert seen.tolist() == [True, True, False]
    # kitti360scripts' CameraFisheye.cam2image, by hand
    x, y, z = in_camera[0] / np.sqrt(2.0**2 + 0.5**2 + 4.0**2)
    x, y = x / (z + 2.2), y / (z + 2.2)
    bent = 1 + 0.016 * (x * x + y * y) + 1.65 * (x * x + y * y) ** 2
    np.testing.assert_allclose(uv[0], [1336 * x * bent + 716.9, 1335 * y * bent + 705.7])


# Real recordings


def test_real_odometry_sweeps(test_data):
    path = test_data / "kitti_odometry/sequences/00"
    sequence = open_sequence(path)
    assert list(sequence.frames) == [0, 1, 2] and not sequence.cameras
    assert [len(sequence[n]) for n in range(3)] == [124_668, 124_605, 124_478]
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


DRIVES = "kitti/2011_09_26/2011_09_26_drive_{}_sync"


@pytest.mark.parametrize(("drive", "frame", "num_cameras"), [("0013", 101, 1), ("0002", 5, 2)])
def test_real_drive(test_data, drive, frame, num_cameras):
    """Of whole drives or of excerpts that have these."""
    sequence = KittiRaw(test_data / DRIVES.format(drive))
    assert len(sequence.cameras) >= num_cameras
    sweep = sequence[frame]
    assert 110_000 < len(sweep) < 130_000
    assert np.abs(sweep.offset_ns).max() < 52_000_000
    assert np.ptp(sweep.offset_ns) > 100_000_000
    for name in ("image_02", "image_03")[:num_cameras]:
        camera = sequence.cameras[name]
        assert sequence.image(name, frame).shape == (375, 1242, 3)
        lag_ns = sequence.image_stamps_ns(name)[frame] - sweep.stamp_ns
        assert abs(lag_ns) < 1_000_000
        p = poses.transform(camera.T_cam_lidar, sweep.points)
        u, v, _ = (camera.K @ p[p[:, 2] > 1].T) / p[p[:, 2] > 1, 2]
        inside = (abs(u - 621) < 621) & (abs(v - 187) < 187)
        assert 15_000 < inside.sum() < 25_000
        assert np.median(v[inside]) > 187  # mostly road, below the horizon
