# SPDX-License-Identifier: MIT
"""What people bring: values, files and folders that are not as they should be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.readers import describe, open_sequence
from densify.readers.kitti import KittiRaw
from tests.command import exit_code
from tests.dataset_scenes import copy_drive
from tests.ros_bags import PERIOD_NS, STAMP_NS, Maker, scan
from tests.test_reader_damage import LFS
from tests.test_reader_folder import bare


def numbered(folder: Path, num: int = 3, rows: np.ndarray | None = None) -> Path:
    return bare(folder, [f"{i:06d}.bin" for i in range(num)], rows)


# --- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bag", "folder"])
def test_an_intensity_that_is_not_finite_is_its_points_problem(kind, tmp_path):
    expected = scan()["intensity"] / np.float32(59)
    columns = scan() | {"intensity": expected.copy()}
    columns["intensity"][20:23], expected[20:23] = [np.inf, -np.inf, np.nan], 0
    place = tmp_path / "drive"
    if kind == "bag":
        maker = Maker()
        for i in range(3):
            maker.cloud(columns, STAMP_NS + i * PERIOD_NS)
        place = maker.write(tmp_path)
    else:
        rows = np.column_stack([columns[name] for name in ("x", "y", "z", "intensity")])
        numbered(place, rows=rows)
    sequence = open_sequence(place)
    np.testing.assert_allclose(sequence[sequence.frames[0]].intensity, expected, atol=1e-6)


@pytest.mark.parametrize("column", ["x", "z", "t", "lidar"])
def test_another_value_that_is_not_finite_costs_its_point_alone(column, tmp_path):
    columns = scan() | {"lidar": np.zeros(60, "f4"), "t": (scan()["t"] * 1e-9).astype("f4")}
    columns[column][7] = np.nan
    folder = tmp_path / "drive"
    folder.mkdir()
    for i in range(3):
        np.savez(folder / f"{i:03d}.npz", **columns)
    (folder / "densify.yaml").write_text("sweeps: {lidar: lidar}")
    sweep = open_sequence(folder)[1]
    np.testing.assert_array_equal(sweep.row, np.delete(np.arange(60), 7))


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy", ".npz", ".csv", ".las", ".bag"])
def test_pointers_of_git_lfs_are_called_that(suffix, tmp_path, capsys):
    for i in range(2 - (suffix == ".bag")):
        (tmp_path / f"{i:06d}{suffix}").write_text(LFS)
    assert exit_code("info", tmp_path) == 2
    assert "is a Git LFS pointer, not the data; run git lfs pull" in capsys.readouterr().err


def test_a_folder_of_empty_files_says_so_once(tmp_path):
    for path in numbered(tmp_path / "drive", 4).iterdir():
        path.write_bytes(b"")
    with pytest.raises(InputError, match="all 4 files of sweeps are empty"):
        open_sequence(tmp_path / "drive")


def test_poses_beside_each_sweep(tmp_path):
    for words, say in (("1 0 0 {0} 0 1 0 0 0 0 1 2", "4x4 rows"), ("{0} 0 2 0 0 0 1", "seven")):
        place = numbered(tmp_path / say)
        for i in range(3):
            (place / f"{i:06d}.pose").write_text(words.format(3.0 * i))
        sequence = open_sequence(place)
        np.testing.assert_allclose(sequence.T_world_lidar(2)[:3, 3], [6, 0, 2])
    (place / "000001.pose").write_text("1 2 3\n0 0 90\n")
    with pytest.raises(InputError, match=r"000001\.pose: got 6 numbers, expected 12 or 16"):
        open_sequence(place)


# --- folders --------------------------------------------------------------------------------------


def test_a_folder_that_is_no_recording_says_what_is_there(border_drive, tmp_path):
    (tmp_path / "pictures").mkdir()
    for i in range(3):
        (tmp_path / "pictures" / f"{i}.JPG").write_bytes(b"x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.odt").write_text("x")
    drive = border_drive
    places = {
        tmp_path / "pictures": "it holds 3 .jpg files, no lidar sweeps;",
        tmp_path / "empty": "it is empty;",
        tmp_path / "notes.odt": "it is a .odt file;",
        drive / "image_02": f"it holds 1 folder, .*inside a KITTI drive: give {drive};",
        drive / "image_02" / "data": f"it holds .*inside a KITTI drive: give {drive};",
    }
    for place, says in places.items():
        with pytest.raises(InputError, match=says) as error:
            open_sequence(place)
        assert len(str(error.value)) < 500
        assert "densify info --help says what each reads" in str(error.value)


def test_the_sweeps_of_a_drive_alone_say_what_is_lost(border_drive):
    for place in (border_drive / "velodyne_points", border_drive / "velodyne_points" / "data"):
        told = "\n".join(open_sequence(place).gaps())
        assert f"is a part of the KITTI drive {border_drive}: read alone it has no times" in told


def test_a_drive_that_is_a_link_has_the_calibration_beside_it(border_drive, tmp_path):
    target = copy_drive(border_drive, tmp_path / "store" / "2011_09_26")
    link = tmp_path / "mine" / target.name
    link.parent.mkdir()
    link.symlink_to(target)
    assert KittiRaw(link).cameras["image_02"].width_px
    for path in target.parent.glob("calib_*.txt"):
        text = path.read_text().replace("P_rect_02: ", "P_rect_02: 1")  # 1x fx
        (link.parent / path.name).write_text(text)
    ours, theirs = (KittiRaw(place).cameras["image_02"].K[0, 0] for place in (link, target))
    assert ours != theirs


# --- images ---------------------------------------------------------------------------------------


def folder_with_images(folder: Path, num_sweeps: int, num_images: int, more: str = "") -> Path:
    numbered(folder / "lidar", num_sweeps)
    (folder / "cam").mkdir()
    for i in range(num_images):
        cv2.imwrite(str(folder / "cam" / f"{i:06d}.png"), np.zeros((6, 8, 3), np.uint8))
    (folder / "densify.yaml").write_text(
        "sweeps: {files: lidar, rate_hz: 20}\ncameras:\n  front:\n    files: cam\n"
        "    size: [8, 6]\n    K: [5, 5, 3.5, 2.5]\n"
        f"    T_cam_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]\n{more}"
    )
    return folder


def test_images_that_are_stamped_by_the_sweeps_are_told(tmp_path):
    sequence = open_sequence(folder_with_images(tmp_path / "a", 32, 20))
    (told,) = sequence.gaps()
    assert told.startswith("front: 20 images without stamps beside 32 sweeps: each is taken as")
    assert "if their rates differ, give the images' times" in told
    assert "20 images without stamps beside 32 sweeps" in describe(sequence)
    (alike,) = open_sequence(folder_with_images(tmp_path / "b", 5, 5)).gaps()
    assert "rates" not in alike
    asked = folder_with_images(tmp_path / "c", 5, 5, "    stamps: sweeps\n")
    assert not open_sequence(asked).gaps()


def test_images_are_paired_by_their_stamps(tmp_path):
    place = folder_with_images(tmp_path / "a", 32, 20)
    (place / "cam" / "timestamps.txt").write_text("\n".join(f"{i / 12:.6f}" for i in range(20)))
    sequence = open_sequence(place)
    assert not sequence.gaps() and "12.00 Hz" in describe(sequence)


def test_a_size_that_the_first_image_has_not_is_refused_at_once(tmp_path):
    place = folder_with_images(tmp_path / "a", 3, 3)
    cv2.imwrite(str(place / "cam" / "000000.png"), np.zeros((12, 16, 3), np.uint8))
    with pytest.raises(InputError, match="got an image of 16 x 12 px; expected 8 x 6, as the"):
        open_sequence(place)


@pytest.mark.parametrize("compressed", [False, True])
def test_images_that_are_binned_twice_are_refused_at_once(compressed, tmp_path):
    maker, pixels = Maker(), np.zeros((6, 8, 3), np.uint8)
    maker.sweeps(3)
    if compressed:
        data = cv2.imencode(".png", pixels)[1].tobytes()
        maker.compressed(data, "/front/image_raw/compressed")
    else:
        maker.image(pixels, "rgb8")
    maker.info(binning=(2, 2))
    maker.transform("lidar", "front_optical", np.eye(4))
    with pytest.raises(InputError, match="camera_info says binning 2, but the images have all of"):
        open_sequence(maker.write(tmp_path))


def test_headers_without_stamps_are_told(tmp_path):
    maker = Maker()
    for i in range(3):
        maker.cloud(scan(), STAMP_NS + i * PERIOD_NS)
    for *_, message in maker.written:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    (told,) = open_sequence(maker.write(tmp_path)).gaps()
    assert told == "/points: 3 headers have no stamp: taken is when they were recorded"
