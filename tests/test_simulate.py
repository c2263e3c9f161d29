# SPDX-License-Identifier: MIT
"""The street written as a KITTI raw drive opens again as what it was."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.outputs.simulated_street import write_street
from densify.readers.kitti.raw import KittiRaw
from densify.readers.street import Street
from densify.readers.truth_files import FileTruth, write_bodies, write_points
from densify.street.simulator import Bodies

FRAMES = [58, 60]


@pytest.fixture(scope="module")
def street() -> Street:
    return Street("street", 0, "vlp16")


@pytest.fixture(scope="module")
def written(street, tmp_path_factory):
    seen = []
    out = tmp_path_factory.mktemp("simulate") / "kitti"
    drive = write_street(
        "kitti", street, out, FRAMES, ["image_03"], lambda *call: seen.append(call)
    )
    assert seen == [("simulate", 0, 2), ("simulate", 1, 2), ("simulate", 2, 2)]
    return drive


def test_tree_is_kittis(street, written):
    date = written.parent
    assert written.name == f"{date.name}_drive_0001_sync"
    assert {p.name for p in date.iterdir()} == {
        "calib_cam_to_cam.txt",
        "calib_velo_to_cam.txt",
        "calib_imu_to_velo.txt",
        written.name,
    }
    names = [f"{frame:010d}" for frame in FRAMES]
    for folder, suffix in (
        ("velodyne_points/data", "bin"),
        ("image_03/data", "png"),
        ("oxts/data", "txt"),
        ("truth/points", "npz"),
        ("truth/depth/image_03", "npz"),
    ):
        found = sorted(p.name for p in (written / folder).iterdir())
        assert found == [f"{n}.{suffix}" for n in names]
    stamps = sorted(p.relative_to(written).as_posix() for p in written.rglob("timestamps*.txt"))
    assert stamps == [
        "image_03/timestamps.txt",
        "oxts/timestamps.txt",
        "velodyne_points/timestamps.txt",
        "velodyne_points/timestamps_end.txt",
        "velodyne_points/timestamps_start.txt",
    ]
    for path in stamps:
        lines = (written / path).read_text().splitlines()
        assert len(lines) == 160
        assert all(len(line.split(".")[1]) == 9 for line in lines)
    points = np.fromfile(written / "velodyne_points/data/0000000060.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(points[:, :3], street[60].points)
    assert len((written / "oxts/data/0000000060.txt").read_text().split()) == 30


def test_our_own_reader_gives_the_street_back(street, written):
    kitti = KittiRaw(written)
    assert list(kitti.frames) == FRAMES
    for frame in FRAMES:
        ours, read = street[frame], kitti[frame]
        np.testing.assert_array_equal(read.points, ours.points)
        np.testing.assert_array_equal(read.intensity, ours.intensity)
        assert read.stamp_ns == ours.stamp_ns
        assert np.abs(read.offset_ns - ours.offset_ns).max() <= 20
        assert kitti.image_stamps_ns("image_03")[frame] == street.image_stamps_ns("image_03")[frame]
        np.testing.assert_array_equal(
            kitti.image("image_03", frame), street.image("image_03", frame)
        )
    steps = [inverse(s.T_world_lidar(58)) @ s.T_world_lidar(60) for s in (street, kitti)]
    np.testing.assert_allclose(*steps, atol=1e-6)
    ours, read = street.cameras["image_03"], kitti.cameras["image_03"]
    np.testing.assert_allclose(read.T_cam_lidar, ours.T_cam_lidar, atol=1e-12)
    np.testing.assert_allclose(read.K, ours.K, atol=1e-12)
    assert (read.width_px, read.height_px) == (ours.width_px, ours.height_px)


def test_recorded_motion_is_that_of_the_poses(street, written):
    record = np.array((written / "oxts/data/0000000060.txt").read_text().split(), float)
    before, after = (street.T_world_lidar(frame) for frame in (59, 61))
    velocity = (after - before)[:3, 3] / 0.2
    np.testing.assert_allclose(record[[7, 6]], velocity[:2], atol=0.25)  # east, north
    assert abs(np.hypot(*record[8:10]) - np.hypot(*velocity[:2])) < 0.2
    yaw = np.arctan2(*(after - before)[[1, 0], 3])
    assert abs(record[5] - yaw) < 0.05


def test_truth_files_equal_the_streets_truth(street, written):
    truth = KittiRaw(written).truth
    assert isinstance(truth, FileTruth)
    for frame in FRAMES:
        ours, read = street.truth.sweep(frame), truth.sweep(frame)
        for name in ("T_world_lidar", "points", "instance", "moving"):
            np.testing.assert_array_equal(getattr(read, name), getattr(ours, name))
        for target in (0, frame, 159):
            np.testing.assert_array_equal(
                truth.displacement(frame, target), street.truth.displacement(frame, target)
            )
        np.testing.assert_array_equal(
            truth.depth_m("image_03", frame), street.truth.depth_m("image_03", frame)
        )
        np.testing.assert_array_equal(
            truth.moving_mask("image_03", frame), street.truth.moving_mask("image_03", frame)
        )


def test_writing_is_whole_or_not_at_all(street, written, tmp_path):
    before = sorted(p.name for p in written.parent.iterdir())
    out = written.parent.parent
    with pytest.raises(InputError, match="--overwrite"):
        write_street("kitti", street, out, FRAMES)

    def interrupted(stage, done, total):
        if done:
            raise KeyboardInterrupt

    for folder, overwrite in ((out, True), (tmp_path / "new", False)):
        with pytest.raises(KeyboardInterrupt):
            write_street("kitti", street, folder, FRAMES, [], interrupted, overwrite)
    assert not (tmp_path / "new").exists()
    assert sorted(p.name for p in written.parent.iterdir()) == before
    assert len(list(out.iterdir())) == 1  # nothing left aside
    again = write_street("kitti", street, tmp_path, FRAMES[:1], [])
    (again / "mine.txt").write_text("old")
    assert write_street("kitti", street, tmp_path, FRAMES[1:], [], overwrite=True) == again
    assert not (again / "mine.txt").exists()
    assert list(KittiRaw(again).frames) == FRAMES[1:]


def test_another_calibration_is_kept(street, tmp_path):
    drive = write_street("kitti", street, tmp_path, FRAMES[:1], [])
    path = drive.parent / "calib_velo_to_cam.txt"
    ours = path.read_bytes()
    shutil.rmtree(drive)
    path.write_text("R: 1\n")
    with pytest.raises(InputError, match=r"calib_velo_to_cam\.txt: another .* --overwrite"):
        write_street("kitti", street, tmp_path, FRAMES[:1], [])
    assert path.read_text() == "R: 1\n" and not drive.exists()
    path.write_bytes(ours)
    assert write_street("kitti", street, tmp_path, FRAMES[:1], []) == drive
    path.write_text("R: 1\n")
    write_street("kitti", street, tmp_path, FRAMES[:1], [], overwrite=True)
    assert path.read_bytes() == ours


def test_what_cannot_be_written_is_one_clear_line(street, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    for arguments, message in (
        ((street, tmp_path, [160]), "0 to 159"),
        ((street, tmp_path, []), "0 to 159"),
        ((street, tmp_path, [1], ["image_00"]), "image_02, image_03"),
        (
            (Street("street", 0, "dual32"), tmp_path, [1]),
            "spins: hdl64, hdl32, vlp16, os128, vls128",
        ),
        ((street, file / "below", [60], []), "cannot be written"),
    ):
        with pytest.raises(InputError) as error:
            write_street("kitti", *arguments)
        assert message in str(error.value) and "\n" not in str(error.value)


# truth files


def _bodies() -> Bodies:
    T_world_body = np.tile(np.eye(4), (3, 2, 1, 1))
    T_world_body[:, 1, 0, 3] = [0.0, 1.0, 2.5]
    T_world_lidar = np.tile(np.eye(4), (3, 1, 1))
    T_world_lidar[1, :2, :2] = [[0, -1], [1, 0]]
    return Bodies(T_world_lidar, T_world_body, np.array([[False, True]] * 3))


def test_displacement_is_written_in_the_frames_own_axes(tmp_path):
    write_bodies(tmp_path, _bodies())
    body, point = np.array([0, 1], np.int32), np.array([[5.0, 0, 0], [5.0, 0, 0]])
    write_points(tmp_path, 1, body, np.array([-1, 0], np.int32), point)
    truth = FileTruth(tmp_path)
    assert truth is not None
    # the lidar of frame 1 looks along +y of the world, where +x is its right
    np.testing.assert_array_equal(truth.displacement(1, 2), [[0, 0, 0], [0, -1.5, 0]])
    np.testing.assert_array_equal(truth.sweep(1).points, [[0, -5, 0], [0, -6, 0]])
    assert truth.sweep(1).moving.tolist() == [False, True]


def test_missing_or_malformed_truth_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"bodies\.npz: no such truth file"):
        FileTruth(tmp_path)
    np.savez(tmp_path / "bodies.npz", T_world_lidar=np.eye(4))
    with pytest.raises(InputError, match=r"bodies\.npz: holds no T_world_body, moving"):
        FileTruth(tmp_path)
    bodies = _bodies()
    write_bodies(tmp_path, Bodies(bodies.T_world_lidar[:2], bodies.T_world_body, bodies.moving))
    with pytest.raises(InputError, match=r"expected T_world_lidar \(F,4,4\)"):
        FileTruth(tmp_path)
    write_bodies(tmp_path, bodies)
    truth = FileTruth(tmp_path)
    assert truth is not None
    with pytest.raises(InputError, match="0 to 2"):
        truth.sweep(3)
    with pytest.raises(InputError, match=r"0000000001\.npz: no such truth file"):
        truth.sweep(1)
    one = np.zeros(1, np.int32)
    for body, instance, point in (
        (one + 2, one, np.zeros((1, 3))),
        (one - 1, one, np.zeros((1, 3))),
        (one, np.zeros(2, np.int32), np.zeros((1, 3))),
        (one, one, np.zeros((2, 3))),
    ):
        write_points(tmp_path, 1, body, instance, point)
        with pytest.raises(InputError, match="bodies below 2"):
            truth.displacement(1, 2)
    path = tmp_path / "points" / "0000000001.npz"
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"not a readable \.npz file"):
        truth.sweep(1)
    with pytest.raises(InputError, match="no such truth file"):
        truth.depth_m("image_02", 1)
    (tmp_path / "depth" / "image_02").mkdir(parents=True)
    np.savez(tmp_path / "depth" / "image_02" / "0000000001.npz", depth_m=np.zeros((2, 2)))
    with pytest.raises(InputError, match="moving"):
        truth.moving_mask("image_02", 1)
