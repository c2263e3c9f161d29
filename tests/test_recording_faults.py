# SPDX-License-Identifier: MIT
"""What people bring: values, files and folders that are not as they should be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.readers import open_sequence
from densify.readers.kitti import KittiRaw
from tests.command import exit_code
from tests.dataset_scenes import copy_drive
from tests.ros_bags import scan
from tests.test_reader_damage import LFS
from tests.test_reader_folder import bare


def numbered(folder: Path, num: int = 3, rows: np.ndarray | None = None) -> Path:
    return bare(folder, [f"{i:06d}.bin" for i in range(num)], rows)


# --- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["x", "z", "t", "lidar", "intensity"])
def test_a_value_that_is_not_finite_costs_its_point_alone(column, tmp_path):
    """An intensity that is not finite becomes 0."""
    columns = scan() | {"lidar": np.zeros(60, "f4"), "t": (scan()["t"] * 1e-9).astype("f4")}
    columns[column][7:10] = [np.nan, np.inf, -np.inf]
    for i in range(3):
        np.savez(tmp_path / f"{i:03d}.npz", **columns)
    (tmp_path / "densify.yaml").write_text("sweeps: {lidar: lidar}")
    sweep = open_sequence(tmp_path)[1]
    if column == "intensity":
        expected = np.nan_to_num(columns[column], posinf=0, neginf=0) / 255
        np.testing.assert_allclose(sweep.intensity, expected, atol=1e-6)
    else:
        np.testing.assert_array_equal(sweep.row, np.delete(np.arange(60), [7, 8, 9]))


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
