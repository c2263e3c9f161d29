# SPDX-License-Identifier: MIT
"""Keys written as KITTI's depth tree, as its own loaders and tools would read them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import densify
from densify.geometry.types import DepthMap
from densify.outputs.kitti_tree import FileRecord, write_key, write_readme
from densify.outputs.recording_folder import drive_folder, split_of
from tests.exported import CAMERAS, map_of, tree

PRODUCTS = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
FOLDER = "val/2011_09_26_drive_0013_sync"


def maps(seed: int) -> dict[str, DepthMap]:
    return {camera: map_of(camera, seed + i) for i, camera in enumerate(CAMERAS)}


# Names


def test_the_split_is_that_of_the_benchmark() -> None:
    official = {
        "2011_09_26": (2, 5, 13, 20, 23, 36, 79, 95, 113),
        "2011_09_28": (37,),
        "2011_09_29": (26,),
        "2011_09_30": (16,),
        "2011_10_03": (47,),
    }
    for date, numbers in official.items():
        for number in range(200):
            expected = "val" if number in numbers else "train"
            assert split_of(f"{date}_drive_{number:04d}_sync") == expected
    for name in ("street:street?seed=0", "", "2011_09_26_drive_0013_synced", "drive_0013_sync"):
        assert split_of(name) == "train"


ODD_NAMES = ["", ".", "..", "../../etc", "a/b", "/", "-rf", ".hidden", "a b", "a  b", "ä", "å"]
ODD_NAMES += ["x" * 300, "x" * 301, "a\nb", "a\0b"]


@given(st.lists(st.text() | st.sampled_from(ODD_NAMES), unique=True, max_size=8))
def test_any_name_becomes_one_harmless_folder(names: list[str]) -> None:
    plain = [name for name in names if not set(name) & set(":?=&")]
    folders = [drive_folder(name) for name in plain]
    assert len(set(folders)) == len(folders)
    for folder in (*folders, *map(drive_folder, names)):
        assert folder.isascii() and len(folder) <= 100
        assert not set(folder) & set("/\\\0 \n\"'") and folder[0] not in ".-"
        assert drive_folder(folder) == folder


# Maps


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    sparse, dense = maps(1), maps(2)
    records = write_key(tmp_path, FOLDER, 120, sparse, dense)
    assert {name: FileRecord.of(data) for name, data in tree(tmp_path).items()} == records
    for camera in CAMERAS:
        paths = [f"{FOLDER}/proj_depth/{kind}/{camera}/0000000120.png" for kind in PRODUCTS]
        assert {*paths} <= {*records} and len(records) == len(PRODUCTS) * len(CAMERAS)
        stored = [cv2.imread(str(tmp_path / path), cv2.IMREAD_UNCHANGED) for path in paths]
        maps_m = (sparse[camera].depth_m, dense[camera].depth_m, dense[camera].filled_m)
        for steps, depth_m in zip(stored, maps_m, strict=False):
            expected_m = np.where(depth_m < 256, depth_m, 0)  # farther is none in this format
            # As the README says
            np.testing.assert_allclose(steps / 256, expected_m, atol=1 / 512)
            np.testing.assert_array_equal(steps > 0, expected_m > 0)
        level, has_depth = stored[3], stored[2] > 0
        assert level.dtype == np.uint8
        np.testing.assert_array_equal(level > 0, has_depth)
        confidence = (level.astype(float) - 1)[has_depth] / 254
        np.testing.assert_allclose(
            confidence, dense[camera].confidence[has_depth], atol=0.5 / 254 + 1e-6
        )


# README


def test_the_readme_says_what_a_reader_needs(tmp_path: Path) -> None:
    settings = {"gate": {"min_score": np.float64(0.5)}, "config": {"flow": {"braces": "{window}"}}}
    write_readme(tmp_path, method="flow", window=5, settings=settings)
    text = (tmp_path / "README.txt").read_text("utf-8")
    for part in (
        *(densify.__version__, "flow", "window 5", "11 lidar sweeps", *PRODUCTS),
        *("cv2.imread(path, cv2.IMREAD_UNCHANGED) / 256", "0 is none", "manifest.jsonl"),
        *("licence", "min_score: 0.5", "'{window}'"),
    ):
        assert part in text, part
    assert max(map(len, text.splitlines())) <= 100
    assert str(tmp_path) not in text
