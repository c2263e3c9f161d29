# SPDX-License-Identifier: MIT
"""Which depth map belongs to which: files of two folders, or masks beside them, paired by drive,
camera and frame, whatever layout each side has::

    <drive>/proj_depth/<product>/image_02/0000000005.png    KITTI's depth trees
    <drive>_sync_<product>_0000000005_image_02.png          KITTI's selected validation images
    [<drive>/]000005/depth/image_02.png                     densify's own output (or depth_filled)
    [<drive>/]000005/depth/image_02/000007.png              its maps of single images, by number
    [<drive>/][image_02/]0000000005.png, scene_a.png        plain folders; the name is the frame

The sets of `densify dataset` are of the first or of the third layout. A drive is KITTI's dated name
wherever it stands in a path, or the name of the folder in that place. The folder around keys may be
just any that a run wrote to: its name counts only if the other side knows a drive of that name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from densify.config.errors import InputError

_DRIVE = re.compile(r"(?P<drive>\d{4}_\d\d_\d\d_drive_\d{4})(?:_sync|_extract)?")
_CAMERA = re.compile(r"(?<![^/])(?P<camera>image_\d\d)(?![^/])")
_DEPTH_TREE = re.compile(
    r"/(?P<folder>[^/]+)/proj_depth/(?P<product>[^/]+)/(?P<camera>[^/]+)/(?P<frame>\d+)\.png$"
)
_KITTI_SELECTION = re.compile(
    _DRIVE.pattern + r"_(?P<product>[a-z_]+)_(?P<frame>\d+)_(?P<camera>image_\d\d)\.png$"
)
_OWN_OUTPUT = re.compile(
    r"/(?P<frame>\d{6,})/(?P<product>depth|depth_filled)/(?P<camera>[^/]+)\.png$"
)
_OWN_IMAGES = re.compile(
    r"/\d{6,}/(?P<product>depth|depth_filled)/(?P<camera>[^/]+)/(?P<frame>\d+)\.png$"
)
_OWN_DEPTH = {_OWN_OUTPUT: 3, _OWN_IMAGES: 4}  # parts of a path from the key's folder on
_TRUTH_PRODUCTS = ("groundtruth", "groundtruth_depth")
_MEASURED, _FILLED = ("depth", "groundtruth"), ("depth_filled", "groundtruth_filled")
_OURS = ("depth", *_FILLED, "confidence")  # no other trees have these


@dataclass(frozen=True)
class DepthPair:
    """Files of one image. mask: None where there is none."""

    predicted: Path
    truth: Path
    mask: Path | None = None


@dataclass(frozen=True)
class DepthPairs:
    """pairs: at least one, ordered by the truth's path. without_truth: predicted files that no
    truth was found for; without_prediction: truth files; without_mask: truth files of pairs that
    the mask folder says nothing of (empty where no masks are given)."""

    pairs: tuple[DepthPair, ...]
    without_truth: tuple[Path, ...] = ()
    without_prediction: tuple[Path, ...] = ()
    without_mask: tuple[Path, ...] = ()


@dataclass(frozen=True)
class _File:
    """folder: around the key, perhaps its drive, where no drive is told."""

    path: Path
    frame: str
    drive: str | None
    camera: str | None
    product: str | None
    folder: str | None = None


def pair_depth_files(
    predicted: Path, truth: Path, mask: Path | None = None, *, filled: bool = False
) -> DepthPairs:
    """Pair the PNG files of two places, and masks with them.

    predicted, truth, mask: a file or a folder with everything under it each; two files are a pair
    whatever their names. What only one side's names say (the drive, the camera) is not compared.
    Where a folder holds a layout other than the plain one, files outside it are no depth maps. Of
    what densify made the measured maps are taken (``depth``, or ``groundtruth`` of a set), or the
    filled ones if ``filled``; of a truth that has KITTI's ``groundtruth`` nothing else.

    Raises InputError if a place is missing, names are ambiguous, or nothing pairs.
    """
    found = _product(_found(predicted, "PREDICTED"), predicted, filled)
    true = _found(truth, "TRUTH")
    true = [f for f in true if f.product in _TRUTH_PRODUCTS] or _product(true, truth, filled=False)
    if predicted.is_file() and truth.is_file():
        if mask is not None and not mask.is_file():
            raise InputError(f"--mask {mask}: expected a PNG file, as PREDICTED and TRUTH are")
        return DepthPairs((DepthPair(predicted, truth, mask),))
    matched = _match(found, true, predicted, truth)
    if not matched:
        raise InputError(
            f"no pair: {_example(found, predicted)}, {_example(true, truth)}; expected the same "
            f"drive, camera and frame, or equal names, on both sides"
        )
    paired_truth = set(matched)
    masks: Mapping[Path, Path] = {}
    if mask is not None:
        if not mask.is_dir():
            raise InputError(f"--mask {mask}: expected a folder of masks, named as the depth maps")
        paired = [file for file in true if file.path in paired_truth]
        masks = _match(_found(mask, "--mask"), paired, mask, truth)
    paired_predicted = set(matched.values())
    return DepthPairs(
        tuple(DepthPair(matched[path], path, masks.get(path)) for path in sorted(matched)),
        without_truth=_others(found, paired_predicted),
        without_prediction=_others(true, paired_truth),
        without_mask=tuple(sorted(paired_truth - set(masks))) if mask is not None else (),
    )


def _found(place: Path, what: str) -> list[_File]:
    """The PNG files of a place, ordered by path; plain ones only if there are no others."""
    if place.is_file():
        return [_parsed(place, place.parent)]
    if not place.is_dir():
        raise InputError(f"{what} {place}: no such file or folder")
    # Hidden ones are unfinished results.
    paths = [
        path
        for path in place.rglob("*.png")
        if not any(part.startswith(".") for part in path.relative_to(place).parts)
    ]
    if not paths:
        raise InputError(f"{what} {place}: holds no PNG files, expected depth maps")
    files = [_parsed(path, place) for path in sorted(paths)]
    return [file for file in files if file.product is not None] or files


def _parsed(path: Path, place: Path) -> _File:
    text = path.absolute().as_posix()
    for layout in (_DEPTH_TREE, _KITTI_SELECTION, *_OWN_DEPTH):
        if match := layout.search(text):
            parts = match.groupdict()
            frame = str(int(parts["frame"]))
            above = text[: match.end("folder") if layout is _DEPTH_TREE else match.start()]
            drive = parts.get("drive") or _last(_DRIVE, above, "drive") or parts.get("folder")
            depth = _OWN_DEPTH.get(layout)
            around = path.relative_to(place).parts[:-depth] if depth else ()
            folder = around[-1] if around else None
            return _File(path, frame, drive, parts["camera"], parts["product"], folder)
    folder = path.absolute().parent.as_posix()
    frame = str(int(path.stem)) if path.stem.isdecimal() else path.stem
    return _File(
        path, frame, _last(_DRIVE, folder, "drive"), _last(_CAMERA, folder, "camera"), None
    )


def _last(pattern: re.Pattern[str], text: str, name: str) -> str | None:
    found = [match[name] for match in pattern.finditer(text)]
    return found[-1] if found else None


def _product(files: Sequence[_File], place: Path, filled: bool) -> list[_File]:
    """One product of what densify made."""
    if filled:
        wanted = [file for file in files if file.product in _FILLED]
        if not wanted:
            raise InputError(
                f"--filled: {place}: holds no {' or '.join(_FILLED)} maps; leave --filled out"
            )
        return wanted
    ours = any(file.product in _OURS for file in files)
    return [file for file in files if ours and file.product in _MEASURED] or list(files)


def _match(
    left: Sequence[_File], right: Sequence[_File], left_place: Path, right_place: Path
) -> dict[Path, Path]:
    """Right path to left path, by frame and by what all the files of both sides say."""
    left, right = _with_drives(left, right), _with_drives(right, left)
    everything = (*left, *right)
    told = [n for n in ("drive", "camera") if all(getattr(f, n) is not None for f in everything)]
    names = ["frame", *told]
    here, there = _keyed(left, names, left_place), _keyed(right, names, right_place)
    return {path: here[key] for key, path in there.items() if key in here}


def _with_drives(files: Sequence[_File], others: Sequence[_File]) -> Sequence[_File]:
    """Take the folders around the keys for drives if the others know one of that name."""
    known = {file.drive or file.folder for file in others}
    if not any(file.folder in known for file in files if file.folder is not None):
        return files
    return [replace(file, drive=file.drive or file.folder) for file in files]


def _keyed(
    files: Sequence[_File], names: Sequence[str], place: Path
) -> dict[tuple[str, ...], Path]:
    keyed: dict[tuple[str, ...], Path] = {}
    for file in files:
        key = tuple(getattr(file, name) for name in names)
        if key in keyed:
            raise InputError(
                f"{place}: {keyed[key].relative_to(place)} and {file.path.relative_to(place)} are "
                f"both {' '.join(f'{n} {k}' for n, k in zip(names, key, strict=True))}, by what "
                f"the names on both sides say; give one drive, camera and product at a time"
            )
        keyed[key] = file.path
    return keyed


def _others(files: Sequence[_File], paired: set[Path]) -> tuple[Path, ...]:
    return tuple(file.path for file in files if file.path not in paired)


def _example(files: Sequence[_File], place: Path) -> str:
    first = files[0]
    says = [f"{n} {v}" for n in ("drive", "camera", "frame") if (v := getattr(first, n))]
    return f"{place} has {len(files)} file{'s' * (len(files) != 1)} such as {' '.join(says)}"
