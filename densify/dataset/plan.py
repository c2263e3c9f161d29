# SPDX-License-Identifier: MIT
"""Plan a training set: the key sweeps of the recordings, and how their maps are made.

``OUT/dataset.json`` holds the plan, with which a later run continues the set::

    schema_version, densify (version)
    layout, method, window, cameras, gate, config    settings for every key sweep, see `Recipe`
    drives    name -> data (text of ``--data``), folder (relative to OUT), frames (planned key
              frame numbers, as [first, last] runs), cameras (name -> width_px, height_px, K,
              T_cam_lidar, distortion, model, max_angle_deg, row_time_s, column_time_s)
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np

from densify.config import Config, Section, as_mapping, choice_field, number_field
from densify.config.errors import InputError
from densify.config.file_content import read_json
from densify.geometry.types import Camera, LidarSequence
from densify.outputs.folders import drive_folder, is_same, plain, split_of, write_file
from densify.pipeline.sweeps import Cut
from densify.readers import Spec, open_sequence
from densify.readers.timeline import Timeline, check_window, choose_cameras, format_frames, to_runs
from densify.version import __version__

SCHEMA_VERSION = 1
_KNOWN = {"method": ("flow", "icp", "none"), "layout": ("kitti-depth", "densify")}
_FILE = "dataset.json"
_MOST_FRAMES = 10_000_000
_RECIPE = ("densify", "layout", "method", "window", "cameras", "gate", "config")
"""Entries of dataset.json that must be equal in all runs for a training set, but for limits."""
_CAMERA = [f.name for f in fields(Camera) if f.name != "name"]


@dataclass(frozen=True)
class Gate(Section):
    """Limits of the scores, set by ``--set dataset.NAME=VALUE``. None means no limit.

    A key sweep beyond a limit is not written. The scores need no ground truth.

    Attributes:
        max_ghost: Greatest share of accumulated points at positions that the key sweep saw through.
        min_density: Least share of the image's pixels with a measured depth, in every camera.
        max_outliers: Greatest share of outliers against the held-out key sweep, in every camera.
        min_sweeps: Least number of sweeps in the window, which ends and holes in time may cut.
        max_ratio: Greatest share of ghosts or held-out outliers, as a multiple of the median of the
            neighbouring key sweeps.
        suspects: ``keep`` or put ``aside`` the key sweeps that the page of the set calls suspect.
        split: Split of the tree, ``train`` or ``val``; ``kitti`` takes KITTI's official split.
    """

    max_ghost: float | None = number_field(None, 0, 1)
    min_density: float | None = number_field(None, 0, 1)
    max_outliers: float | None = number_field(None, 0, 1)
    min_sweeps: int | None = number_field(None, 1, 101)
    max_ratio: float | None = number_field(4.0, 1, 1e6)
    suspects: str = choice_field("keep", "aside")
    split: str = choice_field("kitti", "train", "val")

    def reason(self, scores: Mapping[str, Any], num_sweeps: int) -> str | None:
        """Return why a key sweep is beyond a limit, or None within all limits.

        ``scores`` are those of a manifest line. ``num_sweeps`` is the size of the window.
        """
        ghost, outliers = scores["ghost"], scores["outliers"]
        if self.min_sweeps is not None and num_sweeps < self.min_sweeps:
            return f"{num_sweeps} sweeps, expected at least {self.min_sweeps}"
        if self.max_ghost is not None and (ghost or 0) > self.max_ghost:
            return f"ghost rate {ghost:.5f}, expected at most {self.max_ghost:g}"
        for camera, density in scores["density"].items():
            if self.min_density is not None and density < self.min_density:
                return f"density {density:.4f} in {camera}, expected at least {self.min_density:g}"
            share = outliers.get(camera) or 0
            if self.max_outliers is not None and share > self.max_outliers:
                return f"outliers {share:.5f} in {camera}, expected at most {self.max_outliers:g}"
        return None


@dataclass(frozen=True)
class Recipe:
    """Settings for all key sweeps of a training set.

    Attributes:
        window: Number of sweeps on each side of a key sweep.
        method: ``flow``, ``icp`` or ``none``: scene flow, rigid accumulation or single sweep.
        layout: ``kitti-depth`` for KITTI's depth tree, ``densify`` for files as of ``densify run``.
        cameras: Names of the cameras, None for all.
        gate: Limits of the scores, and the split of the tree.
        config: Settings from `densify.config.resolve`. A limit of outliers turns scoring on.
    """

    window: int = 5
    method: str = "flow"
    layout: str = "kitti-depth"
    cameras: tuple[str, ...] | None = None
    gate: Gate = field(default_factory=Gate)
    config: Config = field(default_factory=Config)

    def __post_init__(self) -> None:
        check_window(self.window)
        if self.gate.max_outliers is not None:
            object.__setattr__(self, "config", self.config.scored())
        if self.layout == "kitti-depth" and self.config.project.per == "image":
            raise InputError(
                "--layout kitti-depth: has one map of a camera for each sweep; got "
                "project.per=image, expected sweep; for one of every image add --layout densify"
            )
        for option, known in _KNOWN.items():
            if (value := getattr(self, option)) not in known:
                raise InputError(f"--{option} {value}: expected one of {', '.join(known)}")


@dataclass(frozen=True)
class Drive:
    """A recording of a training set."""

    name: str  # name of the recording's folder
    data: str  # text of ``--data``, with an absolute path
    folder: str  # folder of the recording's files, relative to the training set
    cameras: Mapping[str, Camera] = field(compare=False)  # the wanted cameras, by name
    # Key frame numbers, ascending. The key sweeps of a block share pipeline stages.
    blocks: tuple[tuple[int, ...], ...]

    @property
    def keys(self) -> tuple[int, ...]:
        """The frame numbers of all key sweeps, ascending."""
        return tuple(chain.from_iterable(self.blocks))


def plan(data: Sequence[str], keys: slice | None, recipe: Recipe) -> list[Drive]:
    """Return every recording with its chosen key sweeps.

    ``data`` and ``keys`` are the arguments of `make_dataset`. Raise InputError for a recording that
    is given twice, has no camera or lacks the keys.
    """
    drives: dict[str, Drive] = {}
    for spec in data:
        sequence = open_sequence(spec)
        name = drive_folder(sequence.name)
        if name in drives:
            raise InputError(
                f"data {spec}: {drives[name].data} is called {name} as well; give every "
                f"recording once, or make two sets with two --out"
            )
        cameras = {camera.name: camera for camera in choose_cameras(sequence, recipe.cameras)}
        if not cameras:
            raise InputError(f"data {spec}: has no camera; expected one to make depth maps for")
        split = recipe.gate.split
        folder = f"{split_of(sequence.name) if split == 'kitti' else split}/{name}"
        if recipe.layout == "densify":
            folder = name if len(data) > 1 else "."
        wanted = _keys(sequence, keys, spec)
        cut = Cut.of(Timeline.of(sequence), recipe.window, wanted)
        blocks = tuple(tuple(block) for _, block in groupby(wanted, cut.number_of.__getitem__))
        drives[name] = Drive(name, Spec.parse(spec).absolute(), folder, cameras, blocks)
    return list(drives.values())


def choose_spread(drives: Sequence[Drive], num_keys: int) -> list[Drive]:
    """Return the recordings with ``num_keys`` of their keys alone, spread evenly over all keys.

    The first is half a step after the start, because windows are cut at the ends. InputError is
    raised for fewer than 1 key.
    """
    if num_keys < 1:
        raise InputError(f"preview {num_keys}: expected 1 key or more")
    names = [(drive.name, key) for drive in drives for key in drive.keys]
    rows = (np.arange(num_keys) + 0.5) * len(names) / num_keys
    chosen = {names[int(row)] for row in rows}
    thinned = []
    for drive in drives:
        blocks = (tuple(k for k in keys if (drive.name, k) in chosen) for keys in drive.blocks)
        thinned.append(replace(drive, blocks=tuple(filter(None, blocks))))
    return thinned


def _keys(sequence: LidarSequence, keys: slice | None, spec: str) -> tuple[int, ...]:
    """Return the chosen frame numbers of a recording. Raise InputError if there are none."""
    if keys is None:
        return tuple(sequence.frames)
    lowest, highest = min(sequence.frames), max(sequence.frames)
    start = lowest if keys.start is None else keys.start
    stop = highest + 1 if keys.stop is None else keys.stop
    step = 1 if keys.step is None else keys.step
    if not all(isinstance(number, int) for number in (start, stop, step)) or step < 1:
        raise InputError(f"keys: got {keys}, expected whole numbers and a step of 1 or more")
    wanted = range(start, stop, step)
    chosen = tuple(frame for frame in sequence.frames if frame in wanted)
    if not chosen or start < lowest or wanted[-1] > highest:
        text = f"{start}:{stop}" + ("" if step == 1 else f":{step}")
        raise InputError(
            f"--keys {text}: {sequence.name} ({spec}) has {format_frames(sequence.frames)}; "
            f"expected A:B within {lowest}:{highest + 1}, or all"
        )
    return chosen


def write_plan(out: Path, recipe: Recipe, drives: Sequence[Drive]) -> None:
    """Write ``dataset.json``, or extend the plan of an earlier run with the same recipe.

    The limits of the scores may differ, and the new ones replace the earlier ones. InputError is
    raised if the rest of the recipe or the recordings differ.
    """
    table = _table(recipe, drives)
    before = read_plan(out)
    if before is not None:
        _check_same(out, before, table)
        table["drives"] = _united(out, before["drives"], table["drives"])
    if before is None or table != before:
        text = json.dumps(table, indent=1) + "\n"
        write_file(out / _FILE, text.encode())


def read_plan(out: Path) -> dict[str, Any] | None:
    """Return the content of dataset.json, None without it. Raise InputError if damaged."""
    path = out / _FILE
    if not path.is_file():
        return None
    try:
        table = read_json(path)
        if table["schema_version"] == SCHEMA_VERSION:
            drives_of(table)
            return {name: table[name] for name in ("schema_version", *_RECIPE, "drives")}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path}: damaged or no description of a training set: {reason}; choose another folder"
        ) from error
    raise InputError(
        f"{path}: got schema_version {table['schema_version']}, expected {SCHEMA_VERSION}; "
        f"it was made by another version of densify"
    )


def drives_of(table: Mapping[str, Any]) -> dict[str, Drive]:
    """Return the recordings in the result of `read_plan`, by name, each with a single block."""
    return {
        name: Drive(
            name,
            drive["data"],
            drive["folder"],
            {camera: _read_camera(camera, stored) for camera, stored in drive["cameras"].items()},
            (tuple(_frames(drive["frames"])),),
        )
        for name, drive in table["drives"].items()
    }


def planned_keys(table: Mapping[str, Any]) -> set[tuple[str, int]]:
    """Return (drive, frame number) of every key sweep in the result of `read_plan`."""
    return {(name, key) for name, drive in drives_of(table).items() for key in drive.keys}


def _table(recipe: Recipe, drives: Sequence[Drive]) -> dict[str, Any]:
    """Return the content of dataset.json."""
    table = {
        "schema_version": SCHEMA_VERSION,
        "densify": __version__,
        **{name: getattr(recipe, name) for name in ("layout", "method", "window", "cameras")},
        "gate": asdict(recipe.gate),
        "config": as_mapping(recipe.config),
        "drives": {
            drive.name: {
                "data": drive.data,
                "folder": drive.folder,
                "frames": _as_runs(drive.keys),
                "cameras": {
                    name: {column: getattr(camera, column) for column in _CAMERA}
                    for name, camera in drive.cameras.items()
                },
            }
            for drive in drives
        },
    }
    return dict(plain(table))


def _check_same(out: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError if a set was made with another recipe or another version of densify."""
    expected, got = (_flat({name: table[name] for name in _RECIPE}) for table in (before, now))
    limits = {f"gate.{name}" for name in asdict(Gate()) if name != "split"}
    limits |= {"config.output.score"}  # a limit of outliers turns it on; maps do not depend on it
    for option in {**expected, **got}:
        if option not in limits and got.get(option) != expected.get(option):
            raise InputError(
                f"--out {out}: the set in it was made with {option} = {expected.get(option)}, "
                f"got {got.get(option)}; choose another --out, or go on with the same options"
            )


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested mappings by dotted names, such as ``gate.max_ghost``."""
    values: dict[str, Any] = {}
    for name, value in table.items():
        nested = isinstance(value, Mapping)
        values |= _flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values


def _united(out: Path, before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the drives of both plans. The frames of a drive in both are joined."""
    united = dict(before)
    for name, drive in now.items():
        earlier = before.get(name, drive)
        if not is_same(name, drive["data"], name, earlier["data"]):
            raise InputError(
                f"--out {out}: {name} in the set is another recording, {earlier['data']}; got "
                f"{drive['data']}; choose another --out"
            )
        for entry in ("folder", "cameras"):
            if earlier[entry] != drive[entry]:
                raise InputError(
                    f"--out {out}: {name} is in the set with other {entry}; choose another --out"
                )
        frames = {*_frames(earlier["frames"]), *_frames(drive["frames"])}
        united[name] = {**drive, "frames": _as_runs(sorted(frames))}
    if len({drive["folder"] for drive in united.values()}) < len(united):
        raise InputError(f"--out {out}: holds another recording; choose another --out")
    return dict(sorted(united.items()))


def _read_camera(name: str, stored: Mapping[str, Any]) -> Camera:
    """Return a camera from its entry in dataset.json."""
    columns = {column: stored[column] for column in _CAMERA if column in stored}
    columns["K"] = np.array(stored["K"], np.float64).reshape(3, 3)
    columns["T_cam_lidar"] = np.array(stored["T_cam_lidar"], np.float64).reshape(4, 4)
    columns["distortion"] = tuple(stored["distortion"])
    return Camera(name=name, **columns)


def _as_runs(frames: Iterable[int]) -> list[list[int]]:
    """Return ascending frame numbers as runs [first, last]."""
    return [[run[0], run[-1]] for run in to_runs(frames)]


def _frames(ends: Iterable[Sequence[int]]) -> list[int]:
    """Return the frame numbers in runs [first, last]."""
    ranges = [range(first, last + 1) for first, last in ends]
    if sum(max(0, run.stop - run.start) for run in ranges) > _MOST_FRAMES:  # len() overflows
        raise ValueError(f"more than {_MOST_FRAMES:,} frames of one recording")
    return [frame for run in ranges for frame in run]
