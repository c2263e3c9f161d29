# SPDX-License-Identifier: MIT
"""The readers: each opens the recordings of one data set.

To add one, write a module with the function that `densify.readers.ReaderModule` describes and one
row here. In a package of your own an entry point in the group ``densify.readers`` takes the row's
place, and the module says the rest: ``recognises(path)``, ``HOLDS`` and, if need be, ``SCENES`` and
``BOXES``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from densify.config.plugins.table import Table

_BAGS = (".bag", ".db3", ".mcap")
_SWEEP = re.compile(r".*\d.*\.(bin|pcd|ply|las|laz)", re.IGNORECASE)
_TABLE = re.compile(r".*\d.*\.(npy|npz|csv|txt)", re.IGNORECASE)  # which may be anything
_BESIDE = re.compile(r"\..*|(timestamps?|times|stamps|poses?|trajectory)\.\w+", re.IGNORECASE)


@dataclass(frozen=True)
class Reader:
    """recognises: whether a place, which exists, holds such a recording; quick, from names alone.
    holds: what is there, for messages. scenes: one place may hold several, named by ``#SCENE``.
    general: recognises so much that all others are asked first. boxes: where tracked boxes lie in a
    recording of which it reads them, for messages; empty for one of which it reads none."""

    name: str
    module: str
    recognises: Callable[[Path], bool]
    holds: str
    scenes: bool = False
    general: bool = False
    boxes: str = ""

    @property
    def usage(self) -> str:
        """How ``READER:PATH`` names it."""
        return self.name


def _row(name: str, module: ModuleType, version: str) -> Reader:
    return Reader(
        name,
        module.__name__,
        recognises=module.recognises,
        holds=getattr(module, "HOLDS", f"a recording for the reader {name}"),
        scenes=getattr(module, "SCENES", False),
        boxes=getattr(module, "BOXES", ""),
    )


def _is_argoverse2(path: Path) -> bool:
    splits = (path, *(path / split for split in ("train", "val", "test")))
    return (path / "city_SE3_egovehicle.feather").is_file() or any(
        any(split.glob("*/city_SE3_egovehicle.feather")) for split in splits
    )


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix in _BAGS
    return any(file.suffix in _BAGS for file in path.iterdir())


def _holds_sweeps(path: Path) -> bool:
    """Down to two folders below; tables of numbers only where nothing else lies beside them."""
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


def _is_kitti_odometry(path: Path) -> bool:
    if (path / "velodyne").is_dir():
        return path.resolve().parent.name == "sequences" or (path / "times.txt").is_file()
    return any((path / "sequences").glob("*/velodyne"))


def _is_dgp(path: Path) -> bool:
    found = (*path.glob("scene_*.json"), *path.glob("*/scene_*.json"))
    return any(not file.name.startswith("scene_dataset") for file in found)


def _is_once_or_zod(path: Path) -> bool:
    return (
        any(path.glob("data/*/lidar_roof/"))
        or any(path.glob("*/data/*/lidar_roof/"))
        or any(path.glob("trainval-frames-*.json"))
    )


def _is_capture(path: Path) -> bool:
    return path.suffix == ".pcap" and path.is_file()


def _has_metadata(path: Path) -> bool:
    return any(path.parent.glob("*.json"))


READERS = Table(
    kind="reader",
    group="densify.readers",
    built_in=(
        Reader(
            "kitti",
            "densify.readers.kitti.raw",
            recognises=lambda path: (path / "velodyne_points").is_dir(),
            holds="a KITTI raw drive (with velodyne_points/)",
        ),
        Reader(
            "argoverse2",
            "densify.readers.argoverse2",
            recognises=_is_argoverse2,
            holds="an Argoverse 2 log (with city_SE3_egovehicle.feather)",
            scenes=True,
            boxes="annotations.feather",
        ),
        Reader(
            "nuscenes",
            "densify.readers.nuscenes.reader",
            recognises=lambda path: (
                (path / "sample_data.json").is_file() or any(path.glob("v*/sample_data.json"))
            ),
            holds="nuScenes or TruckScenes (with v1.0-*/sample_data.json)",
            scenes=True,
            boxes="v1.0-*/sample_annotation.json",
        ),
        Reader(
            "waymo",
            "densify.readers.waymo.reader",
            recognises=lambda path: (
                (path / "lidar_calibration").is_dir() and any((path / "lidar").glob("*.parquet"))
            ),
            holds="Waymo's version 2 (with lidar/*.parquet)",
            scenes=True,
            boxes="lidar_box/CONTEXT.parquet",
        ),
        Reader(
            "opensceneflow",
            "densify.readers.open_scene_flow.reader",
            recognises=lambda path: path.suffix == ".h5" or any(path.glob("*.h5")),
            holds="OpenSceneFlow files (LOG.h5)",
            scenes=True,
        ),
        Reader(
            "pandaset",
            "densify.readers.pandaset.reader",
            recognises=lambda path: (path / "lidar" / "poses.json").is_file(),
            holds="a PandaSet sequence (with lidar/poses.json)",
            boxes="annotations/cuboids/00.pkl.gz",
        ),
        Reader(
            "kitti-360",
            "densify.readers.kitti.kitti_360",
            recognises=lambda path: (path / "data_3d_raw").is_dir(),
            holds="KITTI-360 (with data_3d_raw/)",
            scenes=True,
        ),
        Reader(
            "kitti-tracking",
            "densify.readers.kitti.tracking",
            recognises=lambda path: any((path / "velodyne").glob("[0-9][0-9][0-9][0-9]/")),
            holds="KITTI tracking (with velodyne/0000/)",
            scenes=True,
            boxes="label_02/0000.txt",
        ),
        Reader(
            "kitti-odometry",
            "densify.readers.kitti.odometry",
            recognises=_is_kitti_odometry,
            holds="KITTI odometry or SemanticKITTI (sequences/, or a folder in it with velodyne/)",
            scenes=True,
        ),
        Reader(
            "ros",
            "densify.readers.ros.reader",
            recognises=_is_bag,
            holds="a ROS bag (.bag, .db3, .mcap, or a folder of them)",
            scenes=True,
        ),
        Reader(
            "dgp",
            "densify.readers.dgp",
            recognises=_is_dgp,
            holds="a DGP scene such as DDAD's (with scene_<hash>.json)",
            scenes=True,
        ),
        Reader(
            "tri3d",
            "densify.readers.tri3d",
            recognises=_is_once_or_zod,
            holds="ONCE (data/*/lidar_roof/) or ZOD Frames (trainval-frames-*.json)",
            scenes=True,
        ),
        Reader(
            "ouster",
            "densify.readers.ouster",
            recognises=lambda path: _is_capture(path) and _has_metadata(path),
            holds="an Ouster capture (.pcap with the sensor's .json beside it)",
            scenes=True,
        ),
        Reader(
            "velodyne",
            "densify.readers.velodyne",
            recognises=lambda path: _is_capture(path) and not _has_metadata(path),
            holds="a Velodyne capture (.pcap), with its model behind #",
            scenes=True,
        ),
        Reader(
            "folder",
            "densify.readers.folder.reader",
            recognises=_holds_sweeps,
            holds="a folder of numbered sweeps (000120.bin, .pcd, .ply, .npy, .csv, ...)",
            general=True,
        ),
    ),
    members=("open_recording", "recognises"),
    row_of=_row,
)
