# SPDX-License-Identifier: MIT
"""What lies in a folder of no known form: sweeps, their stamps, poses, and images."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from densify.config.errors import InputError
from densify.readers.folder.config import NAME
from densify.readers.point_files import SUFFIXES
from densify.readers.stamp_files import Named, StampFile, named

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_SURE_SUFFIXES = (".pcd", ".bin", ".ply", ".las", ".laz")
_DEPTH = 2  # folders below the one named
_NO_SWEEPS = ("truth", "labels", "label", "poses", "calib", "calibration")
_STAMP_FILES = tuple(
    f"{name}.{suffix}"
    for name in ("timestamps", "times", "stamps", "timestamp", "timestamps_lidar")
    for suffix in ("txt", "csv")
)
_POSE_FILES = (
    "poses.txt",
    "poses.csv",
    "poses.tum",
    "pose.txt",
    "trajectory.txt",
    "trajectory.csv",
    "traj.txt",
    "odometry.txt",
    "odom.txt",
    "groundtruth.txt",
    "gt_poses.txt",
    "slam_poses.txt",
)


@dataclass(frozen=True)
class Series:
    """Files of sweeps or images in the order of time. paths: by number. stamps_ns: by number, None
    if neither names nor a file tell. told_by: which, for people."""

    paths: Mapping[int, Path]
    stamps_ns: Mapping[int, int] | None
    told_by: str


def find_sweeps(folder: Path, files: str) -> list[Path]:
    """The files of the sweeps. files: the folder they are in, "" to look for it.

    Raises InputError if there are none, or several folders of them.
    """
    if files and not (folder / files).is_dir():
        raise InputError(
            f"{folder / files}: no such folder, though densify.yaml names it: sweeps: {{files: "
            f"{files}}}"
        )
    groups = sweep_folders(folder, files)
    if not groups:
        raise InputError(
            f"{folder / files}: no sweeps; expected numbered files such as 000120.bin "
            f"({', '.join(SUFFIXES)}) in the folder or below it"
        )
    if len(groups) > 1:
        raise InputError(
            f"{folder}: several folders hold sweeps: {', '.join(groups)}; name one in "
            f"{folder / NAME}: sweeps: {{files: ...}}"
        )
    return next(iter(groups.values()))


def sweep_folders(folder: Path, files: str = "") -> dict[str, list[Path]]:
    """Folders with numbered files of points and those files: the one named, or else it and those
    down to two folders below; only those of the surest suffix."""
    found: dict[int, dict[str, list[Path]]] = {}
    for place in [folder / files] if files else _folders(folder):
        for path in _files(place):
            suffix = path.suffix.lower()
            if suffix in SUFFIXES and _is_numbered(path):
                sure = suffix in _SURE_SUFFIXES
                rank = (_SURE_SUFFIXES if sure else SUFFIXES).index(suffix) + 10 * (not sure)
                name = place.relative_to(folder).as_posix()
                found.setdefault(rank, {}).setdefault(name, []).append(path)
    return found[min(found)] if found else {}


def find_images(folder: Path) -> dict[str, int]:
    """Folders with images, below the one named, and how many they hold."""
    counts = {
        str(place.relative_to(folder)): sum(
            path.suffix.lower() in IMAGE_SUFFIXES for path in _files(place)
        )
        for place in _folders(folder)
    }
    return {name: count for name, count in counts.items() if count}


def find_pose_file(folder: Path, name: str) -> Path | None:
    """The one named, or a file of a usual name; None if there is none."""
    if not name:
        return next((folder / n for n in _POSE_FILES if (folder / n).is_file()), None)
    if not (folder / name).is_file():
        raise InputError(
            f"{folder / name}: no such file, though densify.yaml names it: poses: {{file: {name}}}"
        )
    return folder / name


def in_time(
    root: Path, paths: Sequence[Path], stamps: str, unit: str, shared: bool = True
) -> Series:
    """Put files in the order of time.

    stamps: ``names``; ``sweeps``, which means none of their own; the name of a file, below the root
    or beside the files; "" to look for one, in the root too only if ``shared``. Files whose names
    are times are numbered from 0, others as their names say. Raises InputError if a name or a line
    is missing, two files have one number, or the stamps do not ascend.
    """
    by_names = stamps == "names"
    names = [named(path, unit if by_names else "") for path in paths]
    if by_names:
        for name in names:
            if name.stamp_ns is None:
                raise InputError(
                    f"{name.path}: its name is no time; expected such as 1317042651.468569638, or "
                    f"a stamps_unit beside stamps: names in densify.yaml"
                )
    if stamps == "sweeps":
        return Series(_numbered(names), None, "")
    file = None if by_names else _stamp_file(root, paths[0].parent, stamps, shared)
    timed = [(name.stamp_ns, name) for name in names if name.stamp_ns is not None]
    if file is None and len(timed) == len(names):
        ordered = [name for _, name in sorted(timed)]
        found = {number: name.stamp_ns or 0 for number, name in enumerate(ordered)}
        _check_ascending(found, [name.path for name in ordered])
        return Series({n: o.path for n, o in enumerate(ordered)}, found, "the names of the files")
    by_number = _numbered(names)
    if file is None:
        return Series(by_number, None, "")
    read = StampFile.read(file, unit)
    found = _matched(read, by_number)
    _check_ascending(found, [file] * len(found))
    return Series(by_number, found, f"{file.name} in {read.unit}")


def _numbered(names: Sequence[Named]) -> dict[int, Path]:
    if any(name.number is None for name in names):  # times in a file: the names need none
        ordered = sorted(names, key=lambda name: (name.stamp_ns or 0, name.path.name))
        return {number: name.path for number, name in enumerate(ordered)}
    found: dict[int, Path] = {}
    for name in sorted(names):
        number = name.number or 0
        if number in found:
            raise InputError(
                f"{name.path}: has the number {number}, as {found[number].name} has; expected "
                f"names that end in different numbers"
            )
        found[number] = name.path
    return dict(sorted(found.items()))


def _matched(file: StampFile, paths: Mapping[int, Path]) -> dict[int, int]:
    """The time of each file: by its name, or its row in the order of numbers, or its number."""
    if file.names is not None:
        by_name = dict(zip(file.names, file.stamp_ns, strict=True))
        by_stem = {Path(name).stem: ns for name, ns in by_name.items()}
        found = {}
        for number, path in paths.items():
            stamp_ns = by_name.get(path.name, by_stem.get(path.stem))
            if stamp_ns is None:
                raise InputError(f"{file.path}: no line of {path.name}; expected one of each file")
            found[number] = stamp_ns
        return found
    if len(file.stamp_ns) == len(paths):
        return dict(zip(paths, file.stamp_ns, strict=True))
    if len(file.stamp_ns) > max(paths):
        return {number: file.stamp_ns[number] for number in paths}
    raise InputError(
        f"{file.path}: got {len(file.stamp_ns)} times for {len(paths)} files numbered up to "
        f"{max(paths)}, expected one for each file, or one for each number from 0"
    )


def _check_ascending(stamps_ns: Mapping[int, int], where: Sequence[Path]) -> None:
    values = list(stamps_ns.values())
    for i in range(1, len(values)):
        if values[i] <= values[i - 1]:
            raise InputError(
                f"{where[i]}: the time of number {list(stamps_ns)[i]} is {values[i]} ns, not after "
                f"{values[i - 1]} ns of the one before; expected times that ascend"
            )


def _stamp_file(root: Path, folder: Path, name: str, shared: bool) -> Path | None:
    if name:
        place = next((p / name for p in (root, folder) if (p / name).is_file()), None)
        if place is None:
            raise InputError(
                f"{root / name}: no such file, though densify.yaml names it under stamps"
            )
        return place
    places = [folder] + [folder.parent] * (folder != root and (shared or folder.parent != root))
    files = (place / file for place in places for file in _STAMP_FILES)
    return next((file for file in files if file.is_file()), None)


def _folders(root: Path) -> Iterator[Path]:
    """The folder and those below it, by name; each once, whatever links lead to it."""
    level, met = [root], set[Path]()
    for _ in range(_DEPTH + 1):
        below = []
        for place in level:
            if place.resolve() in met:
                continue
            met.add(place.resolve())
            yield place
            below += [
                Path(entry.path)
                for entry in sorted(_entries(place), key=lambda entry: entry.name)
                if entry.is_dir()
                and not entry.name.startswith(".")
                and entry.name not in _NO_SWEEPS
            ]
        level = below


def _files(folder: Path) -> Iterator[Path]:
    for entry in _entries(folder):
        if not entry.name.startswith(".") and entry.is_file():
            yield Path(entry.path)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    """What lies in a folder, links to nowhere and to themselves left out."""
    try:
        with os.scandir(folder) as entries:
            return [e for e in entries if not e.is_symlink() or os.path.exists(e.path)]
    except OSError:
        return []


def _is_numbered(path: Path) -> bool:
    name = named(path)
    return name.number is not None or name.stamp_ns is not None
