# SPDX-License-Identifier: MIT
"""Keys written as KITTI's depth tree, as its own loaders and tools would read them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import densify
from densify.geometry.types import DepthMap
from densify.outputs.depth_png import read_depth_png
from densify.outputs.kitti_tree import FileRecord, drive_folder, split_of, write_key, write_readme

H, W = 9, 14
CAMERAS = ("image_02", "image_03")
PRODUCTS = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
FOLDER = "val/2011_09_26_drive_0013_sync"


def maps(seed: int, height: int = H, width: int = W) -> dict[str, DepthMap]:
    rng = np.random.default_rng(seed)
    made = {}
    for camera in CAMERAS:
        depth = np.where(rng.random((height, width)) < 0.4, rng.uniform(2, 80, (height, width)), 0)
        filled = np.where(depth > 0, depth, rng.uniform(2, 80, (height, width)))
        filled[0] = depth[0]
        confidence = rng.random((height, width), dtype=np.float32)
        frame = np.where(depth > 0, 120, -1).astype(np.int32)
        made[camera] = DepthMap(
            camera, depth.astype(np.float32), filled.astype(np.float32), confidence, frame
        )
    return made


def files_in(folder: Path) -> dict[str, bytes]:
    """Hidden ones too."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def header(path: Path) -> tuple[int, ...]:
    """width, height, bit depth, colour type, compression, filter and interlacing of a PNG."""
    data = path.read_bytes()
    assert data[12:16] == b"IHDR"
    return struct.unpack(">IIBBBBB", data[16:29])


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


@given(st.lists(st.text() | st.sampled_from(ODD_NAMES), unique=True, max_size=30))
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
    assert set(records) == {
        f"{FOLDER}/proj_depth/{product}/{camera}/0000000120.png"
        for product in PRODUCTS
        for camera in CAMERAS
    }
    found = files_in(tmp_path)
    assert {name: FileRecord.of(data) for name, data in found.items()} == records
    for camera in CAMERAS:
        for product, depth_m in (
            ("velodyne_raw", sparse[camera].depth_m),
            ("groundtruth", dense[camera].depth_m),
            ("groundtruth_filled", dense[camera].filled_m),
        ):
            path = tmp_path / FOLDER / "proj_depth" / product / camera / "0000000120.png"
            back = read_depth_png(path)
            np.testing.assert_allclose(back, depth_m, atol=1 / 512)
            np.testing.assert_array_equal(back > 0, depth_m > 0)
            # As the README says.
            np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 256, back)
        path = tmp_path / FOLDER / "proj_depth" / "confidence" / camera / "0000000120.png"
        level = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        filled = dense[camera].filled_m > 0
        assert level.dtype == np.uint8
        np.testing.assert_array_equal(level > 0, filled)
        confidence = (level.astype(float) - 1) / 254
        np.testing.assert_allclose(
            confidence[filled], dense[camera].confidence[filled], atol=0.5 / 254 + 1e-6
        )


def test_the_format_is_that_of_the_official_files(tmp_path: Path, test_data) -> None:
    folder = test_data / "kitti/depth_annotated_sample"
    official = folder / "groundtruth_0000000050.png"
    image = cv2.imread(str(official), cv2.IMREAD_UNCHANGED)
    depth_m = read_depth_png(official)
    same = DepthMap(
        "image_02", depth_m, depth_m, np.ones_like(depth_m), np.zeros(depth_m.shape, np.int32)
    )
    write_key(tmp_path, FOLDER, 50, {"image_02": same}, {"image_02": same})
    for product in PRODUCTS[:3]:
        ours = tmp_path / FOLDER / "proj_depth" / product / "image_02" / "0000000050.png"
        assert header(ours) == header(official)
        np.testing.assert_array_equal(cv2.imread(str(ours), cv2.IMREAD_UNCHANGED), image)
    ours = tmp_path / FOLDER / "proj_depth" / "confidence" / "image_02" / "0000000050.png"
    width, height, bits, *rest = header(official)
    assert (bits, header(ours)) == (16, (width, height, 8, *rest))


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
