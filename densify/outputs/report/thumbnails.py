# SPDX-License-Identifier: MIT
"""Small pictures of depth maps, many to a sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Progress
from densify.outputs.depth_png import read_depth_png
from densify.outputs.png import Picture, encode_webp
from densify.outputs.report.page_file import Blobs

WIDTH_PX, HEIGHT_PX = 112, 36
_COLUMNS, _ROWS = 16, 32
_QUALITY = 50
NEAR_M, FAR_M = 3.0, 80.0


def sheets(
    blobs: Blobs, paths: Sequence[Path], progress: Progress | None = None
) -> tuple[Mapping[str, Any], list[bool]]:
    """Return the entry of the pictures in their order, and which of the maps can be read.

    The entry has the sheets, ``columns`` and ``per_sheet``. A map that cannot be read is black.
    """
    per_sheet, found, packed = _COLUMNS * _ROWS, [], []
    with ThreadPoolExecutor() as pool:
        for start in range(0, len(paths), per_sheet):
            part = list(pool.map(_picture, paths[start : start + per_sheet]))
            found += [picture is not None for picture in part]
            packed.append(blobs.add_file(encode_webp(_sheet(part), _QUALITY), "image/webp"))
            if progress is not None:
                progress("pictures", min(start + per_sheet, len(paths)), len(paths))
    entry = {
        "sheets": packed,
        "columns": _COLUMNS,
        "per_sheet": per_sheet,
        "size_px": [WIDTH_PX, HEIGHT_PX],
        "near_m": NEAR_M,
        "far_m": FAR_M,
    }
    return entry, found


def _sheet(pictures: Sequence[Picture | None]) -> Picture:
    rows = -(-len(pictures) // _COLUMNS)
    sheet = np.zeros((rows * HEIGHT_PX, _COLUMNS * WIDTH_PX, 3), np.uint8)
    for place, picture in enumerate(pictures):
        if picture is not None:
            top, left = HEIGHT_PX * (place // _COLUMNS), WIDTH_PX * (place % _COLUMNS)
            height, width = picture.shape[:2]
            sheet[top : top + height, left : left + width] = picture
    return sheet


def _picture(path: Path) -> Picture | None:
    """Return RGB of the mean depth in each pixel, as large as fits; None if it cannot be read."""
    try:
        depth_m = read_depth_png(path)
    except InputError:
        return None
    height, width = depth_m.shape
    scale = min(WIDTH_PX / width, HEIGHT_PX / height)
    size_px = max(1, int(width * scale)), max(1, int(height * scale))
    total, known = (
        cv2.resize(values, size_px, interpolation=cv2.INTER_AREA)
        for values in (depth_m, (depth_m > 0).astype(np.float32))
    )
    mean_m = np.maximum(total / np.maximum(known, 1e-6), 1e-3)
    nearness = np.log(FAR_M / mean_m) / np.log(FAR_M / NEAR_M)
    levels = np.rint(255 * np.clip(nearness, 0, 1)).astype(np.uint8)
    rgb = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[:, :, ::-1].astype(np.uint8)
    rgb[known == 0] = 0
    return rgb
