# SPDX-License-Identifier: MIT
"""Find the files of a plain folder: sweeps, stamps, poses, and images."""

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
_DEPTH = 2  # levels of subfolders that are searched
_NO_SWEEPS = ("truth", "labels", "label", "poses", "calib", "calibration")
_STAMP_FILES = [f"{n}.{s}" for n in ("timestamps", "times", "stamps") for s in ("txt", "csv")]
_POSE_FILES = [
    f"{name}.{suffix}"
    for name in ("poses", "pose", "trajectory", "odometry", "groundtruth")
    for suffix in ("txt", "csv", "tum")
]


@dataclass(frozen=True)
class Series:
    """Files of sweeps or images in the order of time."""

    paths: Mapping[int, Path]  # path of each file, by its number
    # Stamp of each file, by its number; None if neither names nor a file state it
    stamps_ns: Mapping[int, int] | None
    told_by: str  # source of the stamps, for people; "" without stamps


def find_sweeps(folder: Path, files: str) -> list[Path]:
    """Return the numbered point files of a folder, all of the preferred suffix.

    ``files`` is the subfolder of the sweeps; "" searches the folder and two levels below it.
    """
    if files:
        existing(folder, files, "sweeps: {files: ...}", is_folder=True)
    groups_by_suffix: dict[int, dict[str, list[Path]]] = {}
    for subfolder in [folder / files] if files else _folders(folder):
        for path in _files(subfolder, SUFFIXES):
            if any(number_or_stamp is not None for number_or_stamp in named(path)[1:]):
                groups = groups_by_suffix.setdefault(SUFFIXES.index(path.suffix.lower()), {})
                groups.setdefault(subfolder.relative_to(folder).as_posix(), []).append(path)
    if not groups_by_suffix:
        raise InputError(
            f"{folder / files}: no sweeps; expected numbered files such as 000120.bin "
            f"({', '.join(SUFFIXES)}) in the folder or below it"
        )
    groups = groups_by_suffix[min(groups_by_suffix)]
    if len(groups) > 1:
        raise InputError(
            f"{folder}: several folders hold sweeps: {', '.join(groups)}; name one in "
            f"{folder / NAME}: sweeps: {{files: ...}}"
        )
    return next(iter(groups.values()))


def find_images(folder: Path) -> dict[str, list[Path]]:
    """Return the image files by folder, in this folder and two levels of subfolders."""
    images_of_folder = {str(p.relative_to(folder)): images_in(p) for p in _folders(folder)}
    return {name: images for name, images in images_of_folder.items() if images}


def images_in(folder: Path) -> list[Path]:
    """Return the image files directly in a folder, ordered by path."""
    return sorted(_files(folder, _IMAGE_SUFFIXES))


def find_pose_file(folder: Path, name: str) -> Path | None:
    """Return the pose file ``name``, or for "" a file of a usual name; None if none exists."""
    if name:
        return existing(folder, name, "poses: {file: ...}")
    return next((folder / n for n in _POSE_FILES if (folder / n).is_file()), None)


def existing(folder: Path, name: str, key: str, is_folder: bool = False) -> Path:
    """Return the file or folder ``name`` that densify.yaml gives under ``key``, if it exists."""
    path = folder / name
    if not (path.is_dir() if is_folder else path.is_file()):
        kind = "folder" if is_folder else "file"
        raise InputError(f"{path}: no such {kind}, though densify.yaml names it: {key}")
    return path


def in_time(
    root: Path, paths: Sequence[Path], stamps: str, unit: str, shared: bool = True
) -> Series:
    """Order files by time and find their stamps; files whose names are times are numbered from 0.

    ``stamps`` is ``names`` if file names are stamps, ``sweeps`` for files without stamps, a stamp
    file below ``root`` (the recording) or beside the files, or "" to search for one, with
    ``shared`` in ``root`` too. ``unit`` is the unit of the stamps, "" to detect it.
    """
    by_names = stamps == "names"
    names = [named(path, unit if by_names else "") for path in paths]
    untimed = [name.path for name in names if name.stamp_ns is None]
    if by_names and untimed:
        raise InputError(
            f"{untimed[0]}: its name is no time; expected such as 1317042651.468569638, or a "
            f"stamps_unit beside stamps: names in densify.yaml"
        )
    file = None
    if stamps not in ("names", "sweeps"):
        file = _stamp_file(root, paths[0].parent, stamps, shared)
    named_of = _numbered(names)
    path_of = {number: name.path for number, name in named_of.items()}
    if file is not None:
        stamp_file = StampFile.read(file, unit)
        stamps_ns, told_by = _matched(stamp_file, path_of), f"{file.name} in {stamp_file.unit}"
    elif untimed or stamps == "sweeps":
        return Series(path_of, None, "")
    else:
        stamps_ns = {number: name.stamp_ns or 0 for number, name in named_of.items()}
        told_by = "the names of the files"
    for before, number in pairwise(stamps_ns):
        if stamps_ns[number] <= stamps_ns[before]:
            raise InputError(
                f"{file or path_of[number]}: the time of number {number} is {stamps_ns[number]} ns"
                f", not after {stamps_ns[before]} ns of the one before; expected times that "
                f"ascend: sort the sweeps by time, and remove one that was stored twice"
            )
    return Series(path_of, stamps_ns, told_by)


def _numbered(names: Sequence[Named]) -> dict[int, Named]:
    """Return the files by number; files whose names are times are numbered from 0 in order."""
    if any(name.number is None for name in names):
        return dict(enumerate(sorted(names, key=lambda name: (name.stamp_ns or 0, name.path))))
    ordered = sorted(names, key=lambda name: (name.number, name.path))
    for before, name in pairwise(ordered):
        if before.number == name.number:
            raise InputError(
                f"{name.path}: has the number {name.number}, as {before.path.name} has; expected "
                f"names that end in different numbers"
            )
    return {name.number or 0: name for name in ordered}


def _matched(file: StampFile, paths: Mapping[int, Path]) -> dict[int, int]:
    """Return the stamp of each file by number; a line fits by file name, order or number."""
    if file.names is not None:
        by_name = {Path(n).stem: ns for n, ns in zip(file.names, file.stamp_ns, strict=True)}
        missing = [path for path in paths.values() if path.stem not in by_name]
        if missing:
            raise InputError(
                f"{file.path}: no line of {missing[0].name}; expected one of each file"
            )
        return {number: by_name[path.stem] for number, path in paths.items()}
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
        return existing(folder if (folder / name).is_file() else root, name, "stamps")
    searched = [folder] + [folder.parent] * (folder != root and (shared or folder.parent != root))
    files = (directory / file for directory in searched for file in _STAMP_FILES)
    return next((file for file in files if file.is_file()), None)


def _folders(root: Path) -> Iterator[Path]:
    """Yield the folder and its subfolders down to `_DEPTH`, by name, without links."""
    for folder, subfolders, _ in os.walk(root):
        subfolders[:] = sorted(f for f in subfolders if f[0] != "." and f not in _NO_SWEEPS)
        if len(Path(folder).relative_to(root).parts) == _DEPTH:
            subfolders.clear()
        yield Path(folder)


def _files(folder: Path, suffixes: Sequence[str]) -> Iterator[Path]:
    """Yield the visible files of a folder with one of the suffixes, without broken links."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name[0] != "." and path.suffix.lower() in suffixes and os.path.isfile(path):
            yield path
