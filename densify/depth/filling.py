# SPDX-License-Identifier: MIT
"""Interpolation between measured pixels, compiled: see `densify.depth.fill`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float, Float32
from densify.geometry.compiled import Kernel, inlined

_RIDGE = 1e-7  # gives the slope of least norm where the pixels lie on one line
_MIN_PLANE_PX = 6  # fewer do not tell a plane from a step
_MOST_PX = 120  # half a window's size: thin rays are not bridged at any price
_ROWS = 8  # that are passed over together where none of them holds a measured pixel


class Known(NamedTuple):
    """The measured pixels row by row, of which those of row r left of column c are before
    ``before[r, c]``. before: (H,W+1) int32. num: (H+1,W+1) int32, of those above and to the left of
    a pixel's corner. column: (K,) int32. inverse: (K,) float64, 1/m.
    confidence: (K,) float32."""

    before: NDArray[np.int32]
    num: NDArray[np.int32]
    column: NDArray[np.int32]
    inverse: Float
    confidence: Float32


class _Inside(NamedTuple):
    """The measured pixels in a window, row by row. inverse: 1/m. right, down: columns and rows from
    its middle."""

    inverse: Float
    right: Float
    down: Float
    confidence: Float32


@inlined
def _any(num, top, bottom, left, right):  # type: ignore[no-untyped-def]
    return num[bottom, right] - num[top, right] - num[bottom, left] + num[top, left] > 0


@inlined
def _all_round(num, top, bottom, left, right, row, column):  # type: ignore[no-untyped-def]
    """Are there measured pixels to the left, to the right, above and below?"""
    return (
        _any(num, top, bottom, left, column)
        and _any(num, top, bottom, column + 1, right)
        and _any(num, top, row, left, right)
        and _any(num, row + 1, bottom, left, right)
    )


@inlined
def _gather(known, top, bottom, left, right, row, column, inside):  # type: ignore[no-untyped-def]
    """Collect the measured pixels of a window; returns how many there are, and the greatest and the
    least inverse depth."""
    num, near, far = 0, 0.0, np.inf
    for first in range(top, bottom, _ROWS):
        last = min(first + _ROWS, bottom)
        if not _any(known.num, first, last, left, right):
            continue
        for r in range(first, last):
            for k in range(known.before[r, left], known.before[r, right]):
                there = known.inverse[k]
                near, far = max(near, there), min(far, there)
                inside.inverse[num] = there
                inside.right[num] = known.column[k] - column
                inside.down[num] = r - row
                inside.confidence[num] = known.confidence[k]
                num += 1
    return num, near, far


@inlined
def _plane(inside, num, reach_u, reach_v):  # type: ignore[no-untyped-def]
    """Inverse depth in the centre and its two slopes: weighted least squares, the weight falling
    linearly to zero just outside the window."""
    n = u = v = uu = uv = vv = w = uw = vw = 0.0
    for i in range(num):
        there, du, dv = inside.inverse[i], inside.right[i], inside.down[i]
        weight = (1 - abs(dv) / (reach_v + 1)) * (1 - abs(du) / (reach_u + 1))
        n += weight
        u += weight * du
        v += weight * dv
        uu += weight * du * du
        uv += weight * du * dv
        vv += weight * dv * dv
        w += weight * there
        uw += weight * du * there
        vw += weight * dv * there
    u, v, w = u / n, v / n, w / n
    uu, vv, uv = uu / n - u * u + _RIDGE, vv / n - v * v + _RIDGE, uv / n - u * v
    uw, vw = uw / n - u * w, vw / n - v * w
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    return w - slope_u * u - slope_v * v, slope_u, slope_v


@inlined
def _spread(inside, num, centre, slope_u, slope_v):  # type: ignore[no-untyped-def]
    """Between the least and the greatest deviation from a plane, 1/m."""
    low, high = np.inf, -np.inf
    for i in range(num):
        there = centre + inside.down[i] * slope_v
        off = inside.inverse[i] - there - inside.right[i] * slope_u
        low, high = min(low, off), max(high, off)
    return high - low


@Kernel
def between(first, last, known, spacing_px, reaches, edge, filled_m, confidence, share):  # type: ignore[no-untyped-def]
    """Fill the empty pixels from ``first`` to ``last`` (row by row) as
    `densify.depth.fill.fill_between` says.

    known: `Known`. spacing_px: (H,W,2) float32 horizontally, vertically. reaches: (n,) half sizes
    of the windows in spacings, growing. edge: metres and share of the depth. Filled: filled_m and
    confidence (H,W) float32; share (H,W) float32, size of the window used as a share of the
    largest, 0 where nothing was filled.
    """
    height, width = filled_m.shape
    most = (2 * _MOST_PX + 1) ** 2
    inside = _Inside(np.empty(most), np.empty(most), np.empty(most), np.empty(most, np.float32))
    for p in range(first, last):
        row, column = p // width, p % width
        if filled_m[row, column] > 0:
            continue
        before_u, before_v = 0, 0
        for step in range(len(reaches)):
            reach_u = min(
                max(int(np.rint(reaches[step] * spacing_px[row, column, 0])), 1), _MOST_PX
            )
            reach_v = min(
                max(int(np.rint(reaches[step] * spacing_px[row, column, 1])), 1), _MOST_PX
            )
            if reach_u == before_u and reach_v == before_v:
                continue
            before_u, before_v = reach_u, reach_v
            top, bottom = max(row - reach_v, 0), min(row + reach_v + 1, height)
            left, right = max(column - reach_u, 0), min(column + reach_u + 1, width)
            if not _all_round(known.num, top, bottom, left, right, row, column):
                continue
            num, near, far = _gather(known, top, bottom, left, right, row, column, inside)
            allowed = max(edge[0], edge[1] / near)
            if num < _MIN_PLANE_PX and 1 / far - 1 / near > allowed:
                continue
            centre, slope_u, slope_v = _plane(inside, num, reach_u, reach_v)
            if num >= _MIN_PLANE_PX:
                spread = _spread(inside, num, centre, slope_u, slope_v)
                if spread / (centre * centre) > allowed:
                    continue
            if centre > 0:
                filled_m[row, column] = 1 / min(max(centre, far), near)
                confidence[row, column] = inside.confidence[:num].min()
                share[row, column] = (step + 1) / len(reaches)
                break
