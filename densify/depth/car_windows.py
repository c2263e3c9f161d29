# SPDX-License-Identifier: MIT
"""Car windows closed.

Lasers go through glass: what they measure in a window are seats, headrests and what lies beyond.
Most uses of a depth map (and KITTI's stereo benchmark) count that as wrong. A window is found by
its frame: below, to both sides and in most directions besides there is a surface in one plane. Of
it roofs and pillars are thin and often not measured.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.depth.layers import Layers
from densify.depth.neighbours import DIRECTIONS, NONE, first_known, offset, plane
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float32, Int

_CONFIDENCE = np.float32(0.5)  # of a window's pixel, as a share of the least of its frame
_CELL_RAD = 1 / 360  # frames are searched for in cells of about that size
_REACH_RAD, _REACH_M = 0.16, 1.2  # of a frame from a cell; the less of both
_BEHIND_M, _MOST_M = 0.2, 30.0  # of the plane: where a cell of a window lies
_EACH_M = 0.05  # behind each part of the frame, at least
_EMPTY_M = 0.18  # an empty cell counts as this much behind the farthest known one around
_TAKEN_M = 0.1  # behind the plane: nearer is part of the vehicle
_LEAST, _BELOW = 11, 3  # of 16 directions with a frame; of the five downwards
_ROUGH_M, _OFF_M = 0.35, 0.1  # most distance of a frame from its plane, at first and in the end
_TOUCH_M = 0.06  # behind the plane: a ray comes to it at a nearer surface
_PLATE_M, _PLATE_OFF_M = 0.2, 0.15  # height of the surface below, in the plane to this
_LEAN = 2.5  # most metres of depth per metre of height: windows stand upright
_RIDGE_PX2 = 1e-7
_AREA_M2 = (0.06, 2.5)
_LEAST_CELLS = 16
_LEAST_SOLID = 0.25  # of the rectangle around a window
_MEASURED = (0.02, 0.97)  # share of its cells
_MOST_IN_PLANE = 0.33  # share of its cells that are part of frames: hedges have more
_LEAST_AROUND = np.array([0.5, 0.1])  # shares of its cells with a frame above, and to both sides
_EIGHT = np.ones((3, 3), bool)


def close_windows(layers: Layers, focal_px: float) -> Layers:
    """Put the plane of its frame into each car window, and take out what was measured behind it.

    A cell belongs to a window if in at least 11 of 16 directions, within 1.2 m, the nearest surface
    lies before it: three of the five downwards and one to each side among them. These surfaces must
    lie in one upright plane to 0.1 m, which goes on below for 0.2 m, as a door does and ground does
    not, and the cell 0.2 to 30 m behind it. The plane is fitted in inverse depth, first through the
    nearest surfaces, then through where each direction first comes to it. Connected cells make a
    window if they have its size and shape, if half of them have a frame above too, if a tenth have
    one to both sides that does not lie lower, and if few of them lie in the plane, as in a hedge.

    focal_px: pixels per radian. ``layers.solid`` says where windows are, ``layers.glass`` where a
    measured pixel was taken out.
    """
    size = max(1, round(focal_px * _CELL_RAD))
    cells = _cells(layers, size)
    cell_focal_px = focal_px / size
    found = np.zeros((6, *cells.near.shape), np.float32)
    steps, reach_px = first_known(cells.near > 0), round(_REACH_RAD * cell_focal_px)
    near, far, known = cells.near, cells.far, cells.confidence
    find_frames.over_rows(near.size, near, far, known, steps, cell_focal_px, reach_px, found)
    source = _windows(found[0], found[4:] > 0, cells, cell_focal_px)
    row, column, planes, confidence = _planes(found[:4], source, size, layers.filled_m.shape)
    window = np.zeros(layers.filled_m.shape, bool)
    window[row, column] = True
    plane_m = (1 / np.maximum(planes[0], 1e-3)).astype(np.float32)
    seen_m = layers.filled_m[row, column]
    behind = (seen_m == 0) | (seen_m > plane_m + _TAKEN_M) & (seen_m <= plane_m + _MOST_M)
    row, column = row[behind], column[behind]

    depth_m, filled_m, tilt = layers.depth_m.copy(), layers.filled_m.copy(), layers.tilt.copy()
    certain, glass = layers.confidence.copy(), np.zeros(depth_m.shape, bool)
    glass[row, column] = depth_m[row, column] > 0
    depth_m[row, column] = 0
    filled_m[row, column] = plane_m[behind]
    tilt[row, column] = planes[1:, behind].T
    certain[row, column] = confidence[behind] * _CONFIDENCE
    return replace(
        layers,
        depth_m=depth_m,
        filled_m=filled_m,
        tilt=tilt,
        confidence=certain,
        solid=window,
        glass=glass,
    )


class _Cells(NamedTuple):
    """Blocks of pixels: nearest and farthest inverse depth (1/m, 0 none), least confidence, and
    whether any is measured."""

    near: Float32
    far: Float32
    confidence: Float32
    measured: Bool


def _cells(layers: Layers, size: int) -> _Cells:
    inverse = np.divide(
        1, layers.filled_m, out=np.zeros_like(layers.filled_m), where=layers.filled_m > 0
    )
    some, none = inverse > 0, np.float32(np.inf)
    near = _blocks(inverse, size).max(axis=2)
    far = _blocks(np.where(some, inverse, none), size).min(axis=2)
    least = _blocks(np.where(some, layers.confidence, none), size).min(axis=2)
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


def _windows(inverse: Float32, around: Bool, cells: _Cells, focal_px: float) -> NDArray[np.int64]:
    """Return (H,W) the index of the cell whose plane a cell takes, -1 outside windows.

    inverse: of the planes, 0 none. around: (2,H,W) the frame has parts above, and to both sides.
    Gaps of a cell or two in a window are closed.
    """
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
    """Return row, column (P,), inverse depth with its slopes (3,P) and confidence (P,) of the
    pixels in windows. found: (4,H,W) of cells, see `find_frames`. source: of `_windows`."""
    row, column = np.nonzero(
        source.repeat(size, axis=0).repeat(size, axis=1)[: shape[0], : shape[1]] >= 0
    )
    at = source[row // size, column // size]
    inverse, slope_u, slope_v, confidence = found.reshape(4, -1)[:, at]
    middle = (size - 1) / 2
    cell_row, cell_column = np.divmod(at, source.shape[1])
    inverse = inverse + slope_u * ((column - middle) / size - cell_column)
    inverse += slope_v * ((row - middle) / size - cell_row)
    return row, column, np.stack([inverse, slope_u / size, slope_v / size]), confidence


@inlined
def _plane_of(parts):  # type: ignore[no-untyped-def]
    """Return inverse depth in the origin and both slopes of the plane through (n,3) offsets and
    inverse depths."""
    u = v = w = uu = uv = vv = uw = vw = 0.0
    for part in parts:
        du, dv, there = part[0], part[1], part[2]
        u, v, w = u + du, v + dv, w + there
        uu, uv, vv = uu + du * du, uv + du * dv, vv + dv * dv
        uw, vw = uw + du * there, vw + dv * there
    return plane(float(len(parts)), u, v, uu, uv, vv, w, uw, vw, _RIDGE_PX2)


@inlined
def _at(fitted, du, dv):  # type: ignore[no-untyped-def]
    """Return the inverse depth of a plane beside the origin."""
    return fitted[0] + fitted[1] * du + fitted[2] * dv


@inlined
def _off_m(fitted, du, dv, inverse):  # type: ignore[no-untyped-def]
    """Return how far a surface lies from the plane along its ray."""
    there = _at(fitted, du, dv)
    return abs(1 / there - 1 / inverse) if there > 0 else np.inf


@inlined
def _is_before(depth, fitted, focal_px):  # type: ignore[no-untyped-def]
    """Return True if the plane stands upright before something ``depth`` metres away."""
    centre, _, slope_v = fitted
    if centre * (depth - _BEHIND_M) <= 1 or centre * (depth - _MOST_M) > 1:
        return False
    return abs(slope_v) * focal_px <= _LEAN * centre


@inlined
def _is_around(which, num):  # type: ignore[no-untyped-def]
    """Return True if the directions are as many as a frame has: straight down, around that, to the
    left and to the right."""
    down, below, left, right = 0, 0, 0, 0
    for i in range(num):
        down += which[i] == 4
        below += 2 <= which[i] <= 6
        left += 7 <= which[i] <= 9
        right += which[i] <= 1 or which[i] == 15
    return min(down, left, right) > 0 and num >= _LEAST and below >= _BELOW


@inlined
def _in_plane(parts, which, num, off_m):  # type: ignore[no-untyped-def]
    """Return how many parts are left, moved to the front, once none lies farther than ``off_m``
    from the plane through all; the farthest goes first. 0 if too few are left."""
    while _is_around(which, num):
        fitted = _plane_of(parts[:num])
        most, worst = 0.0, 0
        for i in range(num):
            off = _off_m(fitted, parts[i, 0], parts[i, 1], parts[i, 2])
            if off > most:
                most, worst = off, i
        if most <= off_m:
            return num
        num -= 1
        parts[worst], which[worst] = parts[num], which[num]
    return 0


@inlined
def _depth(row, column, near, far, steps, reach_px):  # type: ignore[no-untyped-def]
    """Return how far away a cell is, guessed if it is empty; 0 if nothing is around."""
    if far[row, column] > 0:
        return 1 / far[row, column]
    farthest = 0.0
    for d in range(len(DIRECTIONS)):
        k = np.int64(steps[d, row, column])
        if k != NONE and k <= reach_px:
            du, dv = offset(d, k)
            farthest = max(farthest, 1 / near[row + dv, column + du] + _EMPTY_M)
    return farthest


@inlined
def _steps_inside(row, column, d, shape, most):  # type: ignore[no-untyped-def]
    """Return one more than the steps in a direction, up to ``most``, that stay in the image."""
    right, down = DIRECTIONS[d, 1]
    across = column if right < 0 else shape[1] - 1 - column if right > 0 else most
    along = row if down < 0 else shape[0] - 1 - row if down > 0 else most
    steps = most
    if right:
        steps = min(steps, 2 * across + 1 if abs(right) == 1 else across)  # the second of two goes
    if down:
        steps = min(steps, 2 * along + 1 if abs(down) == 1 else along)
    return steps + 1


@inlined
def _nearest_parts(row, column, depth, near, focal_px, reach_px, parts, which):  # type: ignore[no-untyped-def]
    """Find the nearest surface in each direction, where it lies before the cell; return how many.
    Gives up once too many directions are open, or the one straight down."""
    reach = _REACH_M * focal_px
    num = 0
    for i in range(len(DIRECTIONS)):
        d = (4 + i * 8 + i // 2 * 5) % len(DIRECTIONS)  # straight down and up, then other sides
        most, at = np.float32(0), 0
        for k in range(1, _steps_inside(row, column, d, near.shape, reach_px)):
            du, dv = offset(d, k)
            there = near[np.uint64(row + dv), np.uint64(column + du)]
            if there > most and k <= reach * there:
                most, at = there, k
        du, dv = offset(d, at)
        parts[num, 0], parts[num, 1], parts[num, 2] = du, dv, most
        if parts[num, 2] * (depth - _EACH_M) > 1 >= parts[num, 2] * (depth - _MOST_M):
            which[num] = d
            num += 1
        elif i - num >= len(DIRECTIONS) - _LEAST:
            return 0
        if i == 0 and num == 0:
            return 0
    return num


@inlined
def _touching_parts(row, column, depth, reach_px, near, fitted, parts, which):  # type: ignore[no-untyped-def]
    """Find where the ray in each direction first comes to a surface before the cell that touches
    the plane, unless one far before it is in the way; return how many do."""
    num = 0
    for d in range(len(DIRECTIONS)):
        for k in range(1, _steps_inside(row, column, d, near.shape, reach_px)):
            du, dv = offset(d, k)
            there, of_plane = near[row + dv, column + du], _at(fitted, du, dv)
            if there > 0 and of_plane > 0 and 1 / there < 1 / of_plane + _TOUCH_M:
                if 1 / of_plane - _ROUGH_M < 1 / there < depth - _EACH_M:
                    parts[num, 0], parts[num, 1], parts[num, 2], which[num] = du, dv, there, d
                    num += 1
                break
    return num


@inlined
def _stands_on_plates(row, column, reach_px, near, fitted, focal_px):  # type: ignore[no-untyped-def]
    """Return True if a surface goes on in the plane straight below, and in two directions downwards
    in all, as a door does and ground does not."""
    length = _PLATE_M * focal_px * fitted[0]
    plates = 0
    for d in range(2, 7):
        run, seen = 0, 0
        for k in range(1, _steps_inside(row, column, d, near.shape, reach_px)):
            if run > length:
                break
            du, dv = offset(d, k)
            there = near[row + dv, column + du]
            if there > 0:
                flat = _off_m(fitted, du, dv, there) <= _PLATE_OFF_M
                run, seen = (run + 1, seen + 1) if flat else (0, 0)
            elif run > 0:
                run += 1
        if run > length and 2 * seen > run:
            plates += 1
        elif d == 4:
            return False
    return plates >= _BELOW - 1


@Kernel
def find_frames(first, last, near, far, known, steps, focal_px, most_px, found):  # type: ignore[no-untyped-def]
    """Find the plane of the frame around each cell that has one.

    near, far, known: (H,W) of `_Cells`. steps: (16,H,W) of `first_known`. most_px: reach. found:
    (6,H,W) float32: the plane's inverse depth in the cell, its slopes to the right and down, the
    frame's least confidence, and 1 where it has a part upwards, and parts on both sides that do not
    lie lower; stays 0 where there is no frame.
    """
    width = near.shape[1]
    parts = np.zeros((len(DIRECTIONS) + 1, 3))
    which = np.zeros(len(DIRECTIONS) + 1, np.int64)
    for p in range(first, last):
        row, column = p // width, p % width
        depth = _depth(row, column, near, far, steps, most_px)
        if depth <= _BEHIND_M:
            continue
        num = _nearest_parts(row, column, depth, near, focal_px, most_px, parts, which)
        num = _in_plane(parts, which, num, _ROUGH_M)
        if num == 0:
            continue
        fitted = _plane_of(parts[:num])
        if not _is_before(depth, fitted, focal_px):
            continue
        reach_px = int(min(_REACH_M * focal_px * fitted[0], float(most_px)))
        num = _touching_parts(row, column, depth, reach_px, near, fitted, parts, which)
        num = _in_plane(parts, which, num, _OFF_M)
        if num == 0:
            continue
        fitted = _plane_of(parts[:num])
        if not _is_before(depth, fitted, focal_px):
            continue
        if not _stands_on_plates(row, column, reach_px, near, fitted, focal_px):
            continue
        least, above, left, right = np.float32(np.inf), False, False, False
        for i in range(num):
            least = min(least, known[row + int(parts[i, 1]), column + int(parts[i, 0])])
            above |= 11 <= which[i] <= 13
            left |= 8 <= which[i] <= 9
            right |= which[i] == 0 or which[i] == 15
        found[0, row, column], found[1, row, column], found[2, row, column] = fitted
        found[3, row, column] = least
        found[4, row, column], found[5, row, column] = above, left and right
