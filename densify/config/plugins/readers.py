# SPDX-License-Identifier: MIT
"""The readers of recordings. Each has the function `densify.readers.ReaderModule`; the module of
another package also has ``recognises(path)``, HOLDS and, if need be, SCENES and BOXES."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from densify.config.plugins.table import Row, Table

_SWEEP = re.compile(r".*\d.*\.(bin|pcd|ply|las|laz)", re.IGNORECASE)
_TABLE = re.compile(r".*\d.*\.(npy|npz|csv|txt)", re.IGNORECASE)  # which may be anything
_BESIDE = re.compile(r"\..*|(timestamps?|times|stamps|poses?|trajectory)\.\w+", re.IGNORECASE)
_AV2 = "city_SE3_egovehicle.feather"


@dataclass(frozen=True)
class Reader(Row):
    """recognises: return True if a place, which exists, holds such a recording, judged by names
    alone. holds: what is there, for messages. scenes: one place may hold several, named by
    ``#SCENE``. general: it recognises so much that all others are asked first. boxes: where it
    finds tracked boxes, for messages; "" if nowhere."""

    recognises: Callable[[Path], bool] = lambda path: False
    holds: str = "a recording of another package's reader"
    scenes: bool = False
    general: bool = False
    boxes: str = ""


def _any(*patterns: str) -> Callable[[Path], bool]:
    """Return a function that recognises a folder in which one of the patterns is found."""
    return lambda path: any(any(path.glob(pattern)) for pattern in patterns)


def _suffix(*suffixes: str) -> Callable[[Path], bool]:
    """Return a function that recognises a file with the suffix, or a folder with such files."""
    inside = _any(*(f"*{suffix}" for suffix in suffixes))
    return lambda path: path.suffix in suffixes if path.is_file() else inside(path)


def _capture(with_metadata: bool) -> Callable[[Path], bool]:
    return lambda path: path.suffix == ".pcap" and any(path.parent.glob("*.json")) == with_metadata


def _is_dgp(path: Path) -> bool:
    found = (*path.glob("scene_*.json"), *path.glob("*/scene_*.json"))
    return any(not file.name.startswith("scene_dataset") for file in found)


def _is_odometry(path: Path) -> bool:
    if (path / "velodyne").is_dir():
        return path.resolve().parent.name == "sequences" or (path / "times.txt").is_file()
    return any(path.glob("sequences/*/velodyne"))


def _holds_sweeps(path: Path) -> bool:
    """Look down to two folders below; tables of numbers count only where nothing else lies beside
    them."""
    if (path / "densify.yaml").is_file():
        return True
    for place, folders, files in os.walk(path):
        if any(_SWEEP.fullmatch(name) for name in files):
            return True
        if len(Path(place).relative_to(path).parts) == 2:
            folders.clear()
    names = [entry.name for entry in path.iterdir() if entry.is_file()] if path.is_dir() else []
    names = [name for name in names if not _BESIDE.fullmatch(name)]
    return bool(names) and all(_TABLE.fullmatch(name) for name in names)


READERS = Table(
    "reader",
    "densify.readers",
    ("open_recording", "recognises"),
    (
        Reader("kitti", "densify.readers.kitti.raw", _any("velodyne_points"),
               "a KITTI raw drive (with velodyne_points/)"),
        Reader("argoverse2", "densify.readers.argoverse2",
               _any(_AV2, f"*/{_AV2}", f"train/*/{_AV2}", f"val/*/{_AV2}", f"test/*/{_AV2}"),
               f"an Argoverse 2 log (with {_AV2})", boxes="annotations.feather", scenes=True),
        Reader("nuscenes", "densify.readers.nuscenes",
               _any("sample_data.json", "v*/sample_data.json"),
               "nuScenes or TruckScenes (with v1.0-*/sample_data.json)",
               boxes="v1.0-*/sample_annotation.json", scenes=True),
        Reader("waymo", "densify.readers.waymo", _any("lidar/*.parquet"),
               "Waymo's version 2 (with lidar/*.parquet)", boxes="lidar_box/CONTEXT.parquet",
               scenes=True),
        Reader("opensceneflow", "densify.readers.open_scene_flow", _suffix(".h5"),
               "OpenSceneFlow files (LOG.h5)", scenes=True),
        Reader("pandaset", "densify.readers.pandaset", _any("lidar/poses.json"),
               "a PandaSet sequence (with lidar/poses.json)",
               boxes="annotations/cuboids/00.pkl.gz"),
        Reader("kitti-360", "densify.readers.kitti.kitti_360", _any("data_3d_raw"),
               "KITTI-360 (with data_3d_raw/)", scenes=True),
        Reader("kitti-tracking", "densify.readers.kitti.tracking",
               _any("velodyne/[0-9][0-9][0-9][0-9]/"), "KITTI tracking (with velodyne/0000/)",
               boxes="label_02/0000.txt", scenes=True),
        Reader("kitti-odometry", "densify.readers.kitti.odometry", _is_odometry,
               "KITTI odometry or SemanticKITTI (sequences/, or a folder in it with velodyne/)",
               scenes=True),
        Reader("ros", "densify.readers.ros", _suffix(".bag", ".db3", ".mcap"),
               "a ROS bag (.bag, .db3, .mcap, or a folder of them)", scenes=True),
        Reader("dgp", "densify.readers.dgp", _is_dgp,
               "a DGP scene such as DDAD's (with scene_<hash>.json)", scenes=True),
        Reader("tri3d", "densify.readers.tri3d",
               _any("data/*/lidar_roof/", "*/data/*/lidar_roof/", "trainval-frames-*.json"),
               "ONCE (data/*/lidar_roof/) or ZOD Frames (trainval-frames-*.json)", scenes=True),
        Reader("ouster", "densify.readers.ouster", _capture(with_metadata=True),
               "an Ouster capture (.pcap with the sensor's .json beside it)", scenes=True),
        Reader("velodyne", "densify.readers.velodyne", _capture(with_metadata=False),
               "a Velodyne capture (.pcap), with its model behind #", scenes=True),
        Reader("folder", "densify.readers.folder.reader", _holds_sweeps,
               "a folder of numbered sweeps (000120.bin, .pcd, .ply, .npy, .csv, ...)",
               general=True),
    ),
)  # fmt: skip
