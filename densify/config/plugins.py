# SPDX-License-Identifier: MIT
"""List the built-in readers and engines, and find plug-ins of other packages by entry points.

The tables import no module. An entry point's name is the plug-in's, and its value a module::

    [project.entry-points."densify.readers"]
    npy = "densify_npy.reader"
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from densify.config.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class Plugin:
    """One reader or scene-flow engine, with fields that another package's module may also set."""

    name: str  # name, as users write it
    module: str  # import path of its module
    # Reader: returns True if a path holds its recordings, judged by file names
    recognises: Callable[[Path], bool] = lambda path: False
    # Reader: kind of recording, for messages
    holds: str = "a recording of another package's reader"
    boxes: str = ""  # reader: path of the annotated boxes, for messages
    scenes: bool = False  # reader: a path may hold several recordings, selected by ``#SCENE``
    argument: str = ""  # engine: name of the argument after the colon; empty for no argument
    # Engine: motion of a long stretch serves every key in it (`densify.flow.engines.SharedMotion`)
    shared: bool = False

    @property
    def usage(self) -> str:
        """Name and argument as users write them, such as ``npz:DIR``."""
        return f"{self.name}:{self.argument}" if self.argument else self.name

    def load_module(self) -> Any:
        """Return the plug-in's module after importing it."""
        return import_module(self.module)


@dataclass(frozen=True)
class Table:
    """All plug-ins of one kind, built-in or from entry points, which are looked up by name."""

    kind: str  # name of the kind, for messages
    group: str  # entry-point group through which packages add plug-ins
    members: tuple[str, ...]  # names of functions that a plug-in's module must have
    built_in: tuple[Plugin, ...]  # plug-ins of densify

    def names(self) -> list[str]:
        """Return the names of all plug-ins, the built-in ones first, without importing any."""
        return [*self._rows()]

    def require(self, name: str, where: str) -> None:
        """Raise InputError, starting with ``where``, if no plug-in has this name; import none."""
        rows = self._rows()
        if name not in rows:
            usages = [getattr(row, "usage", row.name) for row in rows.values()]
            raise InputError(
                f"{where}: got {name!r}, {did_you_mean(name, rows)}expected one of "
                f"{', '.join(usages)} (packages add others by entry points in {self.group})"
            )

    def plugin(self, name: str, where: str) -> Plugin:
        """Return the plug-in of this name; InputError if there is none or it cannot be imported."""
        self.require(name, where)
        return self._loaded(self._rows()[name])

    def __iter__(self) -> Iterator[Plugin]:
        """Yield all plug-ins, the most general built-in last; import other packages' one by one."""
        rows = self._rows()
        general = self.built_in[-1]
        yield from (self._loaded(row) for name, row in rows.items() if name != general.name)
        yield general

    def _rows(self) -> dict[str, Plugin | EntryPoint]:
        """Return name -> plug-in; entry points of other packages replace no built-in name."""
        from importlib.metadata import entry_points

        points = sorted(entry_points(group=self.group), key=lambda point: point.name)
        built_in = {row.name: row for row in self.built_in}
        return built_in | {point.name: point for point in points if point.name not in built_in}

    def _loaded(self, point: Plugin | EntryPoint) -> Plugin:
        if isinstance(point, Plugin):
            return point
        label = f"{self.kind} {point.name} of the package {point.dist.name if point.dist else '?'}"
        try:
            module = point.load()
        except Exception as error:  # an import raises anything
            raise InputError(
                f"{label}: cannot be imported from {point.value} ({type(error).__name__}: {error})"
                f"; mend or uninstall the package"
            ) from error
        if not all(callable(getattr(module, member, None)) for member in self.members):
            raise InputError(
                f"{label}: {point.value} is no module with {', '.join(self.members)}; mend or "
                f"uninstall the package"
            )
        values: dict[str, Any] = {"name": point.name, "module": module.__name__}
        for field in fields(Plugin)[2:]:  # all but name and module
            attribute = field.name if field.name == "recognises" else field.name.upper()
            values[field.name] = getattr(module, attribute, field.default)
        return Plugin(**values)


ENGINES = Table(
    "engine",
    "densify.flow_engines",
    ("estimate_motion",),
    (
        Plugin("groups", "densify.flow.tracking.groups", shared=True),
        Plugin("pairs", "densify.flow.two_clouds"),
        Plugin("paper", "densify.flow.objective"),
        Plugin("network", "densify.learning.network", argument="MODEL"),
        Plugin("npz", "densify.readers.flow_files", argument="DIR"),
    ),
)
"""The scene-flow engines. A module has the functions of `densify.flow.engines.EngineModule`."""


def check_engine_spec(spec: str) -> tuple[str, str]:
    """Return the name and the argument ("" for none) of an engine's ``NAME[:ARGUMENT]``.

    No module is imported. Raise InputError if no engine has this name, or if a built-in engine has
    an argument too many or lacks its argument.
    """
    name, _, argument = spec.partition(":")
    ENGINES.require(name, "flow.engine")
    for row in ENGINES.built_in:
        if row.name == name and bool(row.argument) != bool(argument):
            raise InputError(f"flow.engine: got {spec!r}, expected {row.usage}")
    return name, argument


def engine(spec: str) -> tuple[Plugin, str]:
    """Return the plug-in and the argument ("" for none) of an engine's ``NAME[:ARGUMENT]``."""
    name, argument = check_engine_spec(spec)
    return ENGINES.plugin(name, "flow.engine"), argument


def _any(*patterns: str) -> Callable[[Path], bool]:
    """Return a function that recognises a folder in which one of the patterns exists."""
    return lambda path: any(any(path.glob(pattern)) for pattern in patterns)


def _suffix(*suffixes: str) -> Callable[[Path], bool]:
    """Return a function that recognises a file with the suffix, or a folder with such files."""
    inside = _any(*(f"*{suffix}" for suffix in suffixes))
    return lambda path: path.name.endswith(suffixes) if path.is_file() else inside(path)


def _capture(with_metadata: bool) -> Callable[[Path], bool]:
    """Return a function that recognises a .pcap file with or without .json files beside it."""
    return lambda path: path.suffix == ".pcap" and any(path.parent.glob("*.json")) == with_metadata


def _is_odometry(path: Path) -> bool:
    """Return True for a sequence of KITTI odometry, or a folder with ``sequences``."""
    if (path / "velodyne").is_dir():
        return path.resolve().parent.name == "sequences" or (path / "times.txt").is_file()
    return any(path.glob("sequences/*/velodyne"))


_SWEEP = re.compile(r".*\d.*\.(bin|pcd|ply|las|laz)", re.IGNORECASE)
_TABLE = re.compile(r".*\d.*\.(npy|npz|csv|txt)", re.IGNORECASE)  # which may be anything
_BESIDE = re.compile(r"\..*|(timestamps?|times|stamps|poses?|trajectory)\.\w+", re.IGNORECASE)


def _holds_sweeps(path: Path) -> bool:
    """Return True for sweep files at most two folders deep, or for tables of numbers alone."""
    entries = (entry for pattern in ("*", "*/*", "*/*/*") for entry in path.glob(pattern))
    if (path / "densify.yaml").is_file() or any(_SWEEP.fullmatch(entry.name) for entry in entries):
        return True
    names = [entry.name for entry in path.glob("*") if entry.is_file()]
    names = [name for name in names if not _BESIDE.fullmatch(name)]
    return bool(names) and all(_TABLE.fullmatch(name) for name in names)


_AV2, _DGP = "city_SE3_egovehicle.feather", "scene_[0-9a-f][0-9a-f][0-9a-f]*.json"

READERS = Table(
    "reader",
    "densify.readers",
    ("open_recording", "recognises"),
    (
        Plugin("kitti", "densify.readers.kitti", _any("velodyne_points"),
               "a KITTI raw drive (with velodyne_points/)"),
        Plugin("argoverse2", "densify.readers.argoverse2",
               _any(_AV2, *(f"{folder}*/{_AV2}" for folder in ("", "train/", "val/", "test/"))),
               f"an Argoverse 2 log (with {_AV2})", "annotations.feather", True),
        Plugin("nuscenes", "densify.readers.nuscenes",
               _any("sample_data.json", "v*/sample_data.json"),
               "nuScenes (with v1.0-*/sample_data.json)",
               "v1.0-*/sample_annotation.json", True),
        Plugin("waymo", "densify.readers.waymo", _any("lidar/*.parquet"),
               "Waymo's version 2 (with lidar/*.parquet)", "lidar_box/CONTEXT.parquet", True),
        Plugin("pandaset", "densify.readers.pandaset", _any("lidar/poses.json"),
               "a PandaSet sequence (with lidar/poses.json)", "annotations/cuboids/00.pkl.gz"),
        Plugin("kitti-360", "densify.readers.kitti", _any("data_3d_raw"),
               "KITTI-360 (with data_3d_raw/)", scenes=True),
        Plugin("kitti-tracking", "densify.readers.kitti",
               _any("velodyne/[0-9][0-9][0-9][0-9]/"), "KITTI tracking (with velodyne/0000/)",
               "label_02/0000.txt", True),
        Plugin("kitti-odometry", "densify.readers.kitti", _is_odometry,
               "KITTI odometry or SemanticKITTI (sequences/, or a folder in it with velodyne/)",
               scenes=True),
        Plugin("ros", "densify.readers.ros",
               _suffix(".bag", ".db3", ".mcap", ".db3.zstd", ".mcap.zstd"),
               "a ROS bag (.bag, .db3, .mcap, or a folder of them)", scenes=True),
        Plugin("dgp", "densify.readers.dgp", _any(_DGP, f"*/{_DGP}"),
               "a DGP scene such as DDAD's (with scene_<hash>.json)", scenes=True),
        Plugin("ouster", "densify.readers.packets", _capture(with_metadata=True),
               "an Ouster capture (.pcap with the sensor's .json beside it)", scenes=True),
        Plugin("velodyne", "densify.readers.packets", _capture(with_metadata=False),
               "a Velodyne capture (.pcap), with its model behind #", scenes=True),
        Plugin("folder", "densify.readers.folder", _holds_sweeps,
               "a folder of numbered sweeps (000120.bin, .pcd, .ply, .npy, .csv, ...)"),
    ),
)  # fmt: skip
"""The readers of data sets. A module has the function of `densify.readers.ReaderModule`."""


class Form(NamedTuple):
    """An export format."""

    module: str  # module of `densify.outputs` with the function ``write_NAME``
    owned: tuple[str, ...]  # files and folders that the format writes
    of_drive: bool = True  # True if an export can cover several keys of a drive


EXPORTS = {
    "npy": Form("finished_run", ("depth", "depth_filled", "confidence"), of_drive=False),
    "exr": Form("finished_run", ("depth", "depth_filled", "confidence"), of_drive=False),
    "ply": Form("finished_run", ("cloud.ply",), of_drive=False),
    "pcd": Form("finished_run", ("cloud.pcd",), of_drive=False),
    "nerfstudio": Form("camera_exports", ("transforms.json", "images", "depth", "cloud.ply")),
    "colmap": Form("camera_exports", ("images", "sparse")),
    "splats": Form("camera_exports", ("images", "depths", "sparse", "movers", "tracks.json")),
    "moge": Form("camera_exports", (".index.txt", "keys")),
    "wai": Form("camera_exports", ("scene_meta.json", "images", "depth")),
    "kitti": Form("kitti_tree", ("train", "val", "files.txt", "annotations.json")),
    "kitti-tracking": Form("kitti_tree", ("label_02", "calib", "velodyne", "image_02")),
    "rrd": Form("viewers", ("recording.rrd",)),
    "mcap": Form("viewers", ("recording.mcap",)),
    "mp4": Form("viewers", ("video",)),
}
"""Name of an export format of ``densify export`` -> its writer."""
