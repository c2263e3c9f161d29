# SPDX-License-Identifier: MIT
"""Pair estimated and true depth maps, and masks, by the drive, camera and frame in their paths.

Estimated and true maps each have one of these layouts (`densify dataset`: the 1st or 3rd)::

    <drive>/proj_depth/<product>/image_02/0000000005.png    KITTI's depth trees
    <drive>_sync_<product>_0000000005_image_02.png          KITTI's selected validation images
    000005/depth/image_02.png                               densify's own output (or depth_filled)
    000005/depth/image_02/000007.png                        its maps of single images, by number
    [image_02/]0000000005.png, scene_a.png                  plain folders; the name is the frame

A drive is KITTI's dated name anywhere in a path, or the folder that holds proj_depth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from densify.config.errors import InputError

_DRIVE = re.compile(r"(?P<drive>\d{4}_\d\d_\d\d_drive_\d{4})(?:_sync|_extract)?")
_CAMERA = re.compile(r"(?<![^/])(?P<camera>image_\d\d)(?![^/])")
_KEY = r"(?P<product>depth|depth_filled)/(?P<camera>[^/]+)"
_LAYOUTS = (
    r"/(?P<folder>[^/]+)/proj_depth/(?P<product>[^/]+)/(?P<camera>[^/]+)/(?P<frame>\d+)\.png$",
    _DRIVE.pattern + r"_(?P<product>[a-z_]+)_(?P<frame>\d+)_(?P<camera>image_\d\d)\.png$",
    rf"/(?P<frame>\d{{6,}})/{_KEY}\.png$",
    rf"/\d{{6,}}/{_KEY}/(?P<frame>\d+)\.png$",
)
_TRUTH_PRODUCTS = ("groundtruth", "groundtruth_depth")
_MEASURED, _FILLED = ("depth", "groundtruth"), ("depth_filled", "groundtruth_filled")
# No other trees have these.
_ONLY_DENSIFY = ("depth", *_FILLED, "confidence")


@dataclass(frozen=True)
class DepthPair:
    """Paths of an image's estimated and true depth map, and of its mask of moving objects."""

    predicted: Path
    truth: Path
    mask: Path | None = None


@dataclass(frozen=True)
class DepthPairs:
    """Pairs of estimated and true depth maps, and the files that could not be paired."""

    pairs: tuple[DepthPair, ...]  # one or more pairs, ordered by the path of the true map
    without_truth: tuple[Path, ...] = ()  # paths of estimated maps without a true map
    without_prediction: tuple[Path, ...] = ()  # paths of true maps without an estimated map
    # Paths of paired true maps without a mask; empty if no masks are given
    without_mask: tuple[Path, ...] = ()


class _File(NamedTuple):
    """A depth map or mask, and what its path names."""

    path: Path
    frame: str
    drive: str | None
    camera: str | None
    product: str | None = None  # None for a plain name

    @staticmethod
    def parse(path: Path) -> _File:
        """Find frame, drive, camera and product in a path."""
        text = path.absolute().as_posix()
        for layout in _LAYOUTS:
            if match := re.search(layout, text):
                groups = match.groupdict()
                drive = _last_name(_DRIVE, text[: match.end("product")]) or groups.get("folder")
                frame = str(int(groups["frame"]))
                return _File(path, frame, drive, groups["camera"], groups["product"])
        frame = str(int(path.stem)) if path.stem.isdecimal() else path.stem
        folder = path.absolute().parent.as_posix()
        return _File(path, frame, _last_name(_DRIVE, folder), _last_name(_CAMERA, folder))


def pair_depth_files(
    predicted: Path, truth: Path, mask: Path | None = None, *, filled: bool = False
) -> DepthPairs:
    """Pair estimated PNG depth maps with true depth maps and with masks of moving objects.

    Two files are paired whatever their names. In folders the frames must agree, and the drive and
    the camera too if all paths name them. Raise InputError if files are missing or ambiguous, or
    none match.

    Args:
        predicted: File of an estimated map, or folder that is searched with its subfolders. Files
            of a known layout exclude others.
        truth: File or folder of true maps.
        mask: File or folder of masks, None for none.
        filled: True to pair densify's filled maps instead of its maps of measured pixels.
    """
    estimated = _of_product(_depth_files(predicted, "PREDICTED"), predicted, filled)
    files = _depth_files(truth, "TRUTH")
    published = [file for file in files if file.product in _TRUTH_PRODUCTS]
    true = published or _of_product(files, truth, filled=False)
    are_files = predicted.is_file() and truth.is_file()
    if mask is not None and not (mask.is_file() if are_files else mask.is_dir()):
        kind = "PNG file, as PREDICTED and TRUTH are" if are_files else "folder of masks"
        raise InputError(f"--mask {mask}: expected a {kind}")
    if are_files:
        return DepthPairs((DepthPair(predicted, truth, mask),))
    estimated_of_true = _match(estimated, true, predicted, truth)
    if not estimated_of_true:
        raise InputError(
            f"no pair of {estimated[0].path} and {len(estimated) - 1} more with {true[0].path} and "
            f"{len(true) - 1} more; expected the same drive, camera and frame, or equal names"
        )
    mask_of_true: Mapping[Path, Path] = {}
    if mask is not None:
        paired = [file for file in true if file.path in estimated_of_true]
        mask_of_true = _match(_depth_files(mask, "--mask"), paired, mask, truth)
    used, paths = set(estimated_of_true.values()), sorted(estimated_of_true)
    return DepthPairs(
        tuple(DepthPair(estimated_of_true[path], path, mask_of_true.get(path)) for path in paths),
        without_truth=tuple(file.path for file in estimated if file.path not in used),
        without_prediction=tuple(f.path for f in true if f.path not in estimated_of_true),
        without_mask=tuple(path for path in paths if mask and path not in mask_of_true),
    )


def _depth_files(path: Path, argument: str) -> list[_File]:
    """Return the sorted PNG files at a path: those of known layouts, or all if none is known."""
    if path.is_file():
        return [_File.parse(path)]
    # Hidden files are unfinished results. Exported maps are copies of the maps beside them.
    exported = {p.parent for p in path.rglob("export.yaml")} - {path}
    files = [
        _File.parse(image)
        for image in sorted(path.rglob("*.png"))
        if "/." not in f"/{image.relative_to(path).as_posix()}"
        and not exported.intersection(image.parents)
    ]
    if not files:
        raise InputError(
            f"{argument} {path}: no such file or folder with PNG files, expected depth maps"
        )
    return [file for file in files if file.product is not None] or files


def _last_name(pattern: re.Pattern[str], text: str) -> str | None:
    """Return the first group of the pattern's last match in a text, None without a match."""
    names = [match[1] for match in pattern.finditer(text)]
    return names[-1] if names else None


def _of_product(files: list[_File], path: Path, filled: bool) -> list[_File]:
    """Return densify's filled or measured maps, or all files if another method made them."""
    chosen = [file for file in files if file.product in (_FILLED if filled else _MEASURED)]
    if filled and not chosen:
        raise InputError(
            f"--filled: {path}: holds no {' or '.join(_FILLED)} maps; leave --filled out"
        )
    made_by_densify = filled or any(file.product in _ONLY_DENSIFY for file in files)
    return chosen if chosen and made_by_densify else files


def _match(
    left: Sequence[_File], right: Sequence[_File], left_path: Path, right_path: Path
) -> dict[Path, Path]:
    """Return right -> left path where the frames agree, and drive and camera if all have them."""
    names = ["frame"]
    for name in ("drive", "camera"):
        if all(getattr(file, name) is not None for file in (*left, *right)):
            names.append(name)
    left_by_key = _keyed(left, names, left_path)
    right_by_key = _keyed(right, names, right_path)
    return {path: left_by_key[key] for key, path in right_by_key.items() if key in left_by_key}


def _keyed(files: Sequence[_File], names: Sequence[str], path: Path) -> dict[str, Path]:
    """Return the paths by the named fields as text. Raise InputError if two files agree in all."""
    keyed: dict[str, Path] = {}
    for file in files:
        key = " ".join(f"{name} {getattr(file, name)}" for name in names)
        if key in keyed:
            raise InputError(
                f"{path}: {keyed[key].relative_to(path)} and {file.path.relative_to(path)} are "
                f"both {key}, by what the names on both sides say; give one drive, camera and "
                f"product at a time"
            )
        keyed[key] = file.path
    return keyed
