# SPDX-License-Identifier: MIT
"""The street written as a KITTI raw drive opens again as what it was."""

from __future__ import annotations

import numpy as np
import pytest

from densify.geometry.poses import inverse
from densify.outputs.simulated_street import write_street
from densify.readers.kitti import KittiRaw
from densify.readers.street import FileTruth, Street, write_bodies, write_points
from densify.street.simulator import Bodies
from tests.exported import refusal

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


def test_truth_files_equal_the_streets_truth(street, written):
    truth, exact = KittiRaw(written).truth, street.truth
    assert isinstance(truth, FileTruth)
    for frame in FRAMES:
        for name in ("T_world_lidar", "points", "instance", "moving"):
            ours, read = (getattr(t.sweep(frame), name) for t in (exact, truth))
            np.testing.assert_array_equal(read, ours)
        for target in (0, frame, 159):
            ours, read = (t.displacement(frame, target) for t in (exact, truth))
            np.testing.assert_array_equal(read, ours)
        for image in ("depth_m", "moving_mask"):
            ours, read = (getattr(t, image)("image_03", frame) for t in (exact, truth))
            np.testing.assert_array_equal(read, ours)


def test_writing_is_whole_or_not_at_all(street, written, tmp_path):
    before = sorted(p.name for p in written.parent.iterdir())
    out = written.parent.parent
    with refusal("--overwrite"):
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


def test_what_cannot_be_written_is_one_clear_line(street, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    dual = Street("street", 0, "dual32")
    for arguments, words in (
        ((street, tmp_path, [160]), "0 to 159"),
        ((street, tmp_path, []), "0 to 159"),
        ((street, tmp_path, [1], ["image_00"]), "image_02, image_03"),
        ((dual, tmp_path, [1]), "spins: hdl64, hdl32, vlp16, os128, vls128"),
        ((street, file / "below", [60], []), "cannot be written"),
    ):
        with refusal(words):
            write_street("kitti", *arguments)


def test_missing_or_malformed_truth_files_are_named(tmp_path):
    with refusal("bodies.npz: no such truth file"):
        FileTruth(tmp_path)
    np.savez(tmp_path / "bodies.npz", T_world_lidar=np.eye(4))
    with refusal("bodies.npz: holds no T_world_body, moving"):
        FileTruth(tmp_path)
    T = np.tile(np.eye(4), (3, 2, 1, 1))
    write_bodies(tmp_path, Bodies(T[:, 0], T, np.array([[False, True]] * 3)))
    truth, one = FileTruth(tmp_path), np.zeros(1, np.int32)
    with refusal("0000000001.npz: no such truth file"):
        truth.sweep(1)
    write_points(tmp_path, 1, one + 2, one, np.zeros((1, 3)))
    with refusal("bodies below 2"):
        truth.displacement(1, 2)
