# SPDX-License-Identifier: MIT
"""The series of files in a plain folder: sweeps, their stamps, poses, and images."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from densify.config.errors import InputError
from densify.readers.folder.config import NAME
from densify.readers.point_files import SUFFIXES
from densify.readers.stamp_files import Named, StampFile, named

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_SURE_SUFFIXES = (".pcd", ".bin", ".ply", ".las", ".laz")
_DEPTH = 2  # folders below the one named
_NO_SWEEPS = ("truth", "labels", "label", "poses", "calib", "calibration")
_STAMP_FILES = tuple(
    f"{name}.{suffix}"
    for name in ("timestamps", "times", "stamps", "timestamp", "timestamps_lidar")
    for suffix in ("txt", "csv")
)
_POSE_FILES = (
    *("poses.txt", "poses.csv", "poses.tum", "pose.txt", "trajectory.txt", "trajectory.csv"),
    *("traj.txt", "odometry.txt", "odom.txt", "groundtruth.txt", "gt_poses.txt", "slam_poses.txt"),
)


@dataclass(frozen=True)
class Series:
    """Files of sweeps or images in the order of time. paths: by number. stamps_ns: by number, None
    if neither names nor a file tell. told_by: which, for people."""

    paths: Mapping[int, Path]
    stamps_ns: Mapping[int, int] | None
    told_by: str


def sweep_folders(folder: Path, files: str = "") -> dict[str, list[Path]]:
    """Return the folders with numbered files of points, and those files of the surest suffix.

    files: the folder they are in, "" to look in this one and two folders down. Raises InputError if
    there are none.
    """
    if files and not (folder / files).is_dir():
        raise InputError(
            f"{folder / files}: no such folder, though densify.yaml names it: sweeps: {{files: "
            f"{files}}}"
        )
    order = (*_SURE_SUFFIXES, *(suffix for suffix in SUFFIXES if suffix not in _SURE_SUFFIXES))
    found: dict[int, dict[str, list[Path]]] = {}
    for place in [folder / files] if files else _folders(folder):
        for path in _files(place, SUFFIXES):
            name = named(path)
            if name.number is not None or name.stamp_ns is not None:
                groups = found.setdefault(order.index(path.suffix.lower()), {})
                groups.setdefault(place.relative_to(folder).as_posix(), []).append(path)
    if not found:
        raise InputError(
            f"{folder / files}: no sweeps; expected numbered files such as 000120.bin "
            f"({', '.join(SUFFIXES)}) in the folder or below it"
        )
    return found[min(found)]


def find_sweeps(folder: Path, files: str) -> list[Path]:
    """Return the files of the sweeps. Raises InputError if there are none, or several folders of
    them."""
    groups = sweep_folders(folder, files)
    if len(groups) > 1:
        raise InputError(
            f"{folder}: several folders hold sweeps: {', '.join(groups)}; name one in "
            f"{folder / NAME}: sweeps: {{files: ...}}"
        )
    return next(iter(groups.values()))


def find_images(folder: Path) -> dict[str, list[Path]]:
    """Return the folders with images, this one and those two folders down, and their images."""
    found = {str(p.relative_to(folder)): images_in(p) for p in _folders(folder)}
    return {name: images for name, images in found.items() if images}


def images_in(folder: Path) -> list[Path]:
    return sorted(_files(folder, _IMAGE_SUFFIXES))


def find_pose_file(folder: Path, name: str) -> Path | None:
    """Return the file that is named, or one of a usual name; None if there is none."""
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
    unnamed = [name.path for name in names if name.stamp_ns is None]
    if by_names and unnamed:
        raise InputError(
            f"{unnamed[0]}: its name is no time; expected such as 1317042651.468569638, or a "
            f"stamps_unit beside stamps: names in densify.yaml"
        )
    file = None
    if stamps not in ("names", "sweeps"):
        file = _stamp_file(root, paths[0].parent, stamps, shared)
    if file is None and not unnamed and stamps != "sweeps":
        ordered = sorted(names, key=lambda name: (name.stamp_ns or 0, name.path))
        found = {number: name.stamp_ns or 0 for number, name in enumerate(ordered)}
        by_number, told_by = {n: o.path for n, o in enumerate(ordered)}, "the names of the files"
    else:
        by_number = _numbered(names)
        if file is None:
            return Series(by_number, None, "")
        read = StampFile.read(file, unit)
        found, told_by = _matched(read, by_number), f"{file.name} in {read.unit}"
    for before, number in pairwise(found):
        if found[number] <= found[before]:
            raise InputError(
                f"{file or by_number[number]}: the time of number {number} is {found[number]} ns, "
                f"not after {found[before]} ns of the one before; expected times that ascend"
            )
    return Series(by_number, found, told_by)


def _numbered(names: Sequence[Named]) -> dict[int, Path]:
    if any(name.number is None for name in names):  # a file of times: the names need none
        ordered = sorted(names, key=lambda name: (name.stamp_ns or 0, name.path.name))
        return {number: name.path for number, name in enumerate(ordered)}
    found: dict[int, Path] = {}
    for name in sorted(names, key=lambda name: name.path):
        number = name.number or 0
        if number in found:
            raise InputError(
                f"{name.path}: has the number {number}, as {found[number].name} has; expected "
                f"names that end in different numbers"
            )
        found[number] = name.path
    return dict(sorted(found.items()))


def _matched(file: StampFile, paths: Mapping[int, Path]) -> dict[int, int]:
    """Return the time of each file: by its name, or its row in the order of numbers, or its
    number."""
    if file.names is not None:
        by_name = dict(zip(file.names, file.stamp_ns, strict=True))
        by_name |= {Path(name).stem: ns for name, ns in by_name.items()}
        missing = [p for p in paths.values() if not {p.name, p.stem} & by_name.keys()]
        if missing:
            raise InputError(
                f"{file.path}: no line of {missing[0].name}; expected one of each file"
            )
        return {n: by_name.get(p.name, by_name.get(p.stem, 0)) for n, p in paths.items()}
    if len(file.stamp_ns) == len(paths):
        return dict(zip(paths, file.stamp_ns, strict=True))
    if len(file.stamp_ns) > max(paths):
        return {number: file.stamp_ns[number] for number in paths}
    raise InputError(
        f"{file.path}: got {len(file.stamp_ns)} times for {len(paths)} files numbered up to "
        f"{max(paths)}, expected one for each file, or one for each number from 0"
    )


def _stamp_file(root: Path, folder: Path, name: str, shared: bool) -> Path | None:
    if name:
        places = [place / name for place in (root, folder) if (place / name).is_file()]
        if not places:
            raise InputError(
                f"{root / name}: no such file, though densify.yaml names it under stamps"
            )
        return places[0]
    near = [folder] + [folder.parent] * (folder != root and (shared or folder.parent != root))
    files = (place / file for place in near for file in _STAMP_FILES)
    return next((file for file in files if file.is_file()), None)


def _folders(root: Path) -> Iterator[Path]:
    """Yield the folder and those below it, by name; links to folders are not followed."""
    for place, folders, _ in os.walk(root):
        folders[:] = sorted(f for f in folders if f[0] != "." and f not in _NO_SWEEPS)
        if len(Path(place).relative_to(root).parts) == _DEPTH:
            folders.clear()
        yield Path(place)


def _files(folder: Path, suffixes: Sequence[str]) -> Iterator[Path]:
    """Yield visible files of these suffixes; links to nowhere and to themselves are none."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name[0] != "." and path.suffix.lower() in suffixes and os.path.isfile(path):
            yield path
