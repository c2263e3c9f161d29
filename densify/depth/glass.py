# SPDX-License-Identifier: MIT
"""Windows of vehicles closed.

Lasers go through glass: what they measure in a window are seats, headrests and what lies beyond,
which no camera is asked for and most uses of a depth map (and KITTI's stereo benchmark) count as
wrong. A window is told by its frame: below, to both sides and in most directions besides a surface
that lies in one plane, of which roofs and pillars are thin and often not measured.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.framing import Rules, framed
from densify.depth.layers import Layers
from densify.depth.marching import DIRECTIONS, first_known
from densify.geometry.types import Bool, Float32, Int

_CELL_RAD = 1 / 360  # frames are looked for in cells of about that size
_REACH_RAD = 0.16
_BEHIND_M, _MOST_M = 0.2, 30.0  # of the plane: where what is seen through a window lies
_TAKEN_M = 0.1  # behind the plane: nearer is part of the vehicle
_AREA_M2 = (0.06, 2.5)
_LEAST_CELLS = 16
_LEAST_SOLID = 0.25  # of the rectangle around a window
_MEASURED = (0.02, 0.97)  # share of its cells
_MOST_IN_PLANE = 0.33  # share of its cells that are part of frames: hedges have more
_LEAST_AROUND = np.array([0.5, 0.1])  # shares of its cells with a frame above, and to both sides
_EIGHT = np.ones((3, 3), bool)


def close_windows(layers: Layers, focal_px: float, settings: ProjectSettings) -> Layers:
    """Put the plane of its frame into each window of a vehicle and take out what was measured
    behind it.

    A cell belongs to a window if in at least 11 of 16 directions, within 1.2 m, the nearest surface
    lies before it: 3 of the 5 downwards and one to each side among them; if these surfaces lie in
    one upright plane to 0.1 m, which goes on below for 0.2 m, as a door does and ground does not;
    and if the cell lies 0.2 to 30 m behind it, an empty one as if 0.18 m behind what is around it.
    The plane is fitted in inverse depth, first through the nearest surfaces, then through where
    each direction first comes to it, and again without what lies farthest off it. Connected cells
    make a window if they have a window's size and shape, if half of them have a frame above too,
    and a tenth one to both sides that does not lie lower, and if few among them lie in the plane,
    as in a hedge.

    focal_px: pixels per radian. The planes are as certain as the least certain part of their
    frames, times ``settings.fill_confidence``. ``layers.window`` says where windows are,
    ``layers.glass`` where a measured pixel was taken out.
    """
    size = max(1, round(focal_px * _CELL_RAD))
    cells = _cells(layers, size)
    found = np.zeros((6, *cells.near.shape), np.float32)
    framed.over_rows(
        cells.near.size,
        cells.near,
        cells.far,
        cells.confidence,
        first_known(cells.near > 0),
        DIRECTIONS,
        _rules(focal_px / size),
        found,
    )
    source = _windows(found[0], found[4:] > 0, cells, focal_px / size)
    row, column, plane_m, confidence = _planes(found[:4], source, size, layers.filled_m.shape)
    window = np.zeros(layers.filled_m.shape, bool)
    window[row, column] = True
    seen_m = layers.filled_m[row, column]
    behind = (seen_m == 0) | (seen_m > plane_m + _TAKEN_M) & (seen_m <= plane_m + _MOST_M)
    row, column = row[behind], column[behind]

    depth_m, filled_m = layers.depth_m.copy(), layers.filled_m.copy()
    certain, glass = layers.confidence.copy(), np.zeros(depth_m.shape, bool)
    glass[row, column] = depth_m[row, column] > 0
    depth_m[row, column] = 0
    filled_m[row, column] = plane_m[behind]
    certain[row, column] = confidence[behind] * np.float32(settings.fill_confidence)
    return replace(
        layers,
        depth_m=depth_m,
        filled_m=filled_m,
        confidence=certain,
        window=window,
        glass=glass,
    )


class _Cells(NamedTuple):
    """Blocks of pixels. near, far: inverse depth of the nearest and the farthest, 1/m, 0 none.
    confidence: the least. measured: whether any is."""

    near: Float32
    far: Float32
    confidence: Float32
    measured: Bool


def _cells(layers: Layers, size: int) -> _Cells:
    inverse = np.divide(
        1, layers.filled_m, out=np.zeros_like(layers.filled_m), where=layers.filled_m > 0
    )
    near = _blocks(inverse, size).max(axis=2)
    far = -_blocks(np.where(inverse > 0, -inverse, np.float32(-np.inf)), size).max(axis=2)
    least = -_blocks(np.where(inverse > 0, -layers.confidence, np.float32(-np.inf)), size).max(2)
    return _Cells(
        near=near,
        far=np.where(near > 0, far, np.float32(0)),
        confidence=np.where(near > 0, least, np.float32(0)),
        measured=_blocks(layers.depth_m, size).max(axis=2) > 0,
    )


def _blocks(values: Float32, size: int) -> Float32:
    """(H,W) -> (rows, columns, size²), what lies beyond the image repeated from its border."""
    height, width = (-(-n // size) for n in values.shape)
    beyond = [(0, height * size - values.shape[0]), (0, width * size - values.shape[1])]
    padded = np.pad(values, beyond, mode="edge").reshape(height, size, width, size)
    return padded.transpose(0, 2, 1, 3).reshape(height, width, size * size)


def _rules(focal_px: float) -> Rules:
    return Rules(
        focal_px=focal_px,
        reach_m=1.2,
        reach_px=round(_REACH_RAD * focal_px),
        behind_m=_BEHIND_M,
        most_m=_MOST_M,
        each_m=0.05,
        empty_m=0.18,
        least=11,
        below=3,
        plate_m=0.2,
        plate_off_m=0.15,
        rough_m=0.35,
        touch_m=0.06,
        off_m=0.1,
        lean=2.5,
    )


def _windows(inverse: Float32, around: Bool, cells: _Cells, focal_px: float) -> NDArray[np.int64]:
    """(H,W) index of the cell whose plane a cell takes, -1 outside windows. inverse: of the planes,
    0 none. around: (2,H,W) whose frame has parts above, and to both sides. Gaps of a cell or two in
    a window are closed."""
    framed = inverse > 0
    label, num = ndimage.label(ndimage.binary_closing(framed, _EIGHT), _EIGHT)
    area_m2 = np.divide(1, (inverse * focal_px) ** 2, out=np.zeros_like(inverse), where=framed)
    good = np.zeros(num + 1, bool)
    for number, box in enumerate(ndimage.find_objects(label), start=1):
        region = label[box] == number
        whole = ndimage.binary_fill_holes(region)
        in_plane = whole & ~framed[box] & (cells.near[box] > 0)
        own = region & framed[box]
        good[number] = (
            own.sum() >= max(_LEAST_CELLS, _LEAST_SOLID * region.size)
            and _AREA_M2[0] < area_m2[box][region].sum() < _AREA_M2[1]
            and _MEASURED[0] < cells.measured[box][own].mean() < _MEASURED[1]
            and (around[:, box[0], box[1]][:, own].mean(axis=1) >= _LEAST_AROUND).all()
            and in_plane.sum() <= _MOST_IN_PLANE * whole.sum()
        )
    row, column = ndimage.distance_transform_edt(
        ~framed, return_distances=False, return_indices=True
    )
    window = ndimage.binary_dilation(good[label], _EIGHT)  # cells on the border show both
    return np.where(window, row * inverse.shape[1] + column, -1)


def _planes(
    found: Float32, source: NDArray[np.int64], size: int, shape: tuple[int, ...]
) -> tuple[Int, Int, Float32, Float32]:
    """Row, column, depth in m and confidence of the pixels in windows. found: of
    `densify.depth.framing.framed`. source: of `_windows`."""
    row, column = np.nonzero(
        source.repeat(size, axis=0).repeat(size, axis=1)[: shape[0], : shape[1]] >= 0
    )
    at = source[row // size, column // size]
    inverse, slope_u, slope_v, confidence = found.reshape(4, -1)[:, at]
    middle = (size - 1) / 2
    cell_row, cell_column = np.divmod(at, source.shape[1])
    inverse = inverse + slope_u * ((column - middle) / size - cell_column)
    inverse += slope_v * ((row - middle) / size - cell_row)
    depth_m = 1 / np.maximum(inverse, 1e-3)
    return row, column, depth_m.astype(np.float32), confidence
