# SPDX-License-Identifier: MIT
"""Interpolate between the measured pixels of a depth map, where their votes confirm the result."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.boundary_pixels import ROUNDED, least_votes
from densify.depth.image_points import HIDDEN_FRACTION, HIDDEN_M
from densify.depth.layers import Layers
from densify.depth.neighbours import DIRECTIONS, NONE, extended, first_known, offset, plane
from densify.geometry.arrays import Float, Float32
from densify.geometry.compiled import Kernel, inlined

_NUM_SIZES = 3  # of the windows, up to a half size of a spacing of rays
_LEAST_SHARE, _LEAST_STAR_SHARE = 0.9, 0.8  # share of the votes
_RIDGE_PX2 = 1e-7
_MIN_PLANE_PX = 6  # fewer do not distinguish a plane from a step
_MOST_PX = 120  # greatest half size of a window
_ROWS = 8  # rows that are skipped together if they hold no measured pixel
_STAR_MET, _STAR_GAP = 8, 7  # directions with a known pixel; neighbouring directions without
_STAR_SPREAD = 0.1  # greatest difference between the predictions, as a share of inverse depth


def fill(layers: Layers, reach: float) -> Layers:
    """Fill the pixels that have measured pixels on both sides, if the pixels around confirm them.

    A filled depth stays if at least nine tenths of the votes (`least_votes`) are for it. ``reach``
    is the half size of the largest window in spacings of rays.
    """
    filled_m, tilt = fill_between(layers.depth_m, layers.tilt, layers.spacing_px, reach)
    filled = replace(layers, filled_m=filled_m, tilt=tilt)
    return _voted(filled, layers.depth_m, _LEAST_SHARE)


def _voted(layers: Layers, before_m: Float32, least_share: float) -> Layers:
    """Drop pixels filled since ``before_m`` (H,W) with less than ``least_share`` of the votes."""
    filled = (layers.filled_m > 0) & (before_m == 0)
    pixel = np.flatnonzero(filled)
    # Only measured pixels vote, because filled pixels would confirm themselves. Boundary pixels
    # that were not accepted may only vote against. This protects the pillar of a car, which has few
    # measured pixels.
    maps_m = np.maximum(layers.depth_m, layers.rim_m), layers.depth_m
    votes, depth_m = layers.votes.copy(), layers.filled_m.flat[pixel]
    votes.flat[pixel] = least_votes(layers, maps_m, pixel, depth_m)
    filled.flat[pixel] = votes.flat[pixel] < ROUNDED * least_share
    return replace(layers, votes=votes).without(filled)


class _Known(NamedTuple):
    """The K measured pixels of a map, row by row."""

    # (H,W+1) int32 number of measured pixels above row r or left of column c in row r
    before: NDArray[np.int32]
    num: NDArray[np.int32]  # (H+1,W+1) int32 integral image of the measured pixels
    column: NDArray[np.int32]  # (K,) int32 column of each pixel
    inverse: Float  # (K,) float64 inverse depth of each pixel, 1/m


class _Inside(NamedTuple):
    """The measured pixels in a window: inverse depth (1/m), columns and rows from the centre."""

    inverse: Float
    right: Float
    down: Float


def fill_between(
    depth_m: Float32, tilt: Float32, spacing_px: Float32, reach: float
) -> tuple[Float32, Float32]:
    """Interpolate empty pixels that have measured pixels on both sides.

    The window around an empty pixel must hold measured pixels to its left, to its right, above and
    below: nothing is extrapolated. No depth discontinuity may run through them. There is a
    discontinuity if deviations from a plane differ by more than 0.2 m and 5 % of the nearest depth.
    With fewer than six pixels the depths themselves are compared.

    The pixel gets the depth of the plane. Weights fall to zero just outside the window. The window
    grows in thirds of the ray spacing, then to ``reach`` spacings. The smallest sufficient window
    is taken. The maps are those of `Layers`, of measured pixels only.

    Returns:
        Copies of depth_m and tilt with the filled pixels.
    """
    filled_m, tilt = depth_m.copy(), tilt.copy()
    sizes = min(reach, 1.0) * np.arange(1, _NUM_SIZES + 1) / _NUM_SIZES
    reaches = np.append(sizes, reach) if reach > 1 else sizes
    measured = depth_m > 0
    height, width = depth_m.shape
    before = np.zeros((height, width + 1), np.int32)
    np.cumsum(measured, axis=1, dtype=np.int32, out=before[:, 1:])
    num = np.zeros((height + 1, width + 1), np.int32)
    np.cumsum(before, axis=0, out=num[1:])
    before += num[:-1, -1:]
    known = _Known(
        before=before,
        num=num,
        column=np.nonzero(measured)[1].astype(np.int32),
        inverse=1 / depth_m[measured].astype(np.float64),
    )
    _fill.over_rows(depth_m.size, known, spacing_px, reaches, filled_m, tilt)
    return filled_m, tilt


@inlined
def _any(num, top, bottom, left, right):  # type: ignore[no-untyped-def]
    return num[bottom, right] - num[top, right] - num[bottom, left] + num[top, left] > 0


@inlined
def _surrounded(num, top, bottom, left, right, row, column):  # type: ignore[no-untyped-def]
    """Return True if a window has measured pixels to the left, to the right, above and below."""
    return (
        _any(num, top, bottom, left, column)
        and _any(num, top, bottom, column + 1, right)
        and _any(num, top, row, left, right)
        and _any(num, row + 1, bottom, left, right)
    )


@inlined
def _gather(known, top, bottom, left, right, row, column, inside):  # type: ignore[no-untyped-def]
    """Put a window's pixels into ``inside``; return number, greatest and least inverse depth."""
    num, w_near, w_far = 0, 0.0, np.inf
    for first in range(top, bottom, _ROWS):
        last = min(first + _ROWS, bottom)
        if not _any(known.num, first, last, left, right):
            continue
        for r in range(first, last):
            for k in range(known.before[r, left], known.before[r, right]):
                w = known.inverse[k]
                w_near, w_far = max(w_near, w), min(w_far, w)
                inside.inverse[num] = w
                inside.right[num] = known.column[k] - column
                inside.down[num] = r - row
                num += 1
    return num, w_near, w_far


@inlined
def _fit(inside, num, reach_u, reach_v):  # type: ignore[no-untyped-def]
    """Fit a plane; return its inverse depth in the middle, both slopes, range of deviations."""
    n = u = v = uu = uv = vv = w = uw = vw = 0.0
    for i in range(num):
        inverse, du, dv = inside.inverse[i], inside.right[i], inside.down[i]
        # It falls to 0 just beyond the reach (px).
        weight = (1 - abs(dv) / (reach_v + 1)) * (1 - abs(du) / (reach_u + 1))
        n += weight
        u += weight * du
        v += weight * dv
        uu += weight * du * du
        uv += weight * du * dv
        vv += weight * dv * dv
        w += weight * inverse
        uw += weight * du * inverse
        vw += weight * dv * inverse
    centre, slope_u, slope_v = plane(n, u, v, uu, uv, vv, w, uw, vw, _RIDGE_PX2)
    low, high = np.inf, -np.inf
    for i in range(num):
        inverse = centre + inside.down[i] * slope_v
        off = inside.inverse[i] - inverse - inside.right[i] * slope_u
        low, high = min(low, off), max(high, off)
    return centre, slope_u, slope_v, high - low


@Kernel
def _fill(first, last, known, spacing_px, reaches, filled_m, tilt):  # type: ignore[no-untyped-def]
    """Fill the empty pixels from ``first`` to ``last`` as in `fill_between`."""
    height, width = filled_m.shape
    capacity = (2 * _MOST_PX + 1) ** 2
    inside = _Inside(np.empty(capacity), np.empty(capacity), np.empty(capacity))
    for p in range(first, last):
        row, column = p // width, p % width
        if filled_m[row, column] > 0:
            continue
        before_u, before_v = 0, 0
        for step in range(len(reaches)):  # half sizes in spacings of rays, ascending
            across_px = reaches[step] * spacing_px[row, column, 0]
            down_px = reaches[step] * spacing_px[row, column, 1]
            reach_u = min(max(int(np.rint(across_px)), 1), _MOST_PX)
            reach_v = min(max(int(np.rint(down_px)), 1), _MOST_PX)
            if reach_u == before_u and reach_v == before_v:
                continue
            before_u, before_v = reach_u, reach_v
            top, bottom = max(row - reach_v, 0), min(row + reach_v + 1, height)
            left, right = max(column - reach_u, 0), min(column + reach_u + 1, width)
            if not _surrounded(known.num, top, bottom, left, right, row, column):
                continue
            num, w_near, w_far = _gather(known, top, bottom, left, right, row, column, inside)
            allowed = max(HIDDEN_M, HIDDEN_FRACTION / w_near)
            if num < _MIN_PLANE_PX and 1 / w_far - 1 / w_near > allowed:
                continue
            centre, slope_u, slope_v, spread = _fit(inside, num, reach_u, reach_v)
            if num >= _MIN_PLANE_PX and spread / (centre * centre) > allowed:
                continue
            if centre > 0:
                filled_m[row, column] = 1 / centre
                tilt[row, column, 0], tilt[row, column, 1] = slope_u, slope_v
                break


def fill_stars(layers: Layers) -> Layers:
    """Fill holes from the first known pixel, measured or filled, in each of 16 directions.

    At least eight directions must have a known pixel within a spacing of rays, and at most seven
    neighbouring directions none. The surface of each known pixel is extended to the hole. These
    predictions must agree to 10 % of inverse depth. Their mean, weighted by the reciprocal of the
    steps, needs eight tenths of the votes.
    """
    known = layers.filled_m > 0
    inverse = np.divide(1, layers.filled_m, out=np.zeros_like(layers.filled_m), where=known)
    pixel = np.flatnonzero(~known)
    predicted_m, steps = np.zeros(len(pixel), np.float32), first_known(known)
    _star.over_rows(len(pixel), pixel, steps, inverse, layers.tilt, layers.spacing_px, predicted_m)
    filled_m = layers.filled_m.copy()
    filled_m.flat[pixel] = predicted_m
    return _voted(replace(layers, filled_m=filled_m), layers.filled_m, _LEAST_STAR_SHARE)


@inlined
def _widest_gap(met):  # type: ignore[no-untyped-def]
    """Return the largest number of neighbouring directions where ``met`` (16,) is False."""
    widest = run = 0
    for d in range(2 * len(met)):
        run = 0 if met[d % len(met)] else run + 1
        widest = max(widest, run)
    return min(widest, len(met))


@Kernel
def _star(first, last, pixel, steps, inverse, tilt, spacing_px, predicted_m):  # type: ignore[no-untyped-def]
    """Predict the depth of empty pixels from the first known pixels around them, 0 for none."""
    width = inverse.shape[1]
    met = np.empty(len(DIRECTIONS), np.bool_)
    for p in range(first, last):
        row, column = pixel[p] // width, pixel[p] % width
        reach_px = max(spacing_px[row, column, 0], spacing_px[row, column, 1])
        num, w_near, w_far = 0, 0.0, np.inf
        sum_w, weight = 0.0, 0.0
        for d in range(len(DIRECTIONS)):
            k = np.int64(steps[d, row, column])
            du, dv = offset(d, k)
            met[d] = k != NONE and du * du + dv * dv <= reach_px * reach_px
            if met[d]:
                w = extended(inverse, tilt, row + dv, column + du, du, dv)
                w_near, w_far = max(w_near, w), min(w_far, w)
                sum_w += w / k
                weight += 1 / k
                num += 1
        if num < _STAR_MET or _widest_gap(met) > _STAR_GAP:
            continue
        w = sum_w / weight
        if w_near - w_far <= _STAR_SPREAD * w:
            predicted_m[p] = 1 / w
