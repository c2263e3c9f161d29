# SPDX-License-Identifier: MIT
"""Add pixels to the measured ones of a depth map, where the votes of known pixels confirm them.

The stages are, in order: accept boundary pixels by the image, fill windows by planes, fill holes
by stars, and count the pixels that a laser's spot covers as measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.measured_pixels import MapRecord
from densify.depth.patches import (
    AGREE_FRACTION,
    AGREE_M,
    FOOTPRINT,
    HIDDEN_FRACTION,
    HIDDEN_M,
    add_moments,
    plane,
)
from densify.depth.votes import (
    DIRECTIONS,
    NONE,
    ROUNDED,
    Voters,
    extended,
    first_known,
    inverse_of,
    offset,
    votes_for,
)
from densify.geometry.arrays import Bool, Float, Float32
from densify.geometry.compiled import Kernel, inlined

LEAST_SHARE = 0.97
"""Share of the votes for a boundary pixel that is kept."""
_FILL_SHARE, _STAR_SHARE = 0.9, 0.8  # share of the votes for a filled pixel
_NUM_SIZES = 3  # of the windows, up to a half size of a spacing of rays
_RIDGE_PX2 = 1e-7
_MIN_PLANE_PX = 6  # fewer do not distinguish a plane from a step
_MOST_PX = 120  # greatest half size of a window
_STAR_MET = len(DIRECTIONS) // 2  # least number of directions with a known pixel
_STAR_SPREAD = 0.1  # greatest difference between the predictions, as a share of inverse depth
_SPOT_PX = 4  # greatest half width of a spot


def accept_boundary_pixels(record: MapRecord, rims: str) -> None:
    """Accept the boundary pixels that the image confirms; reject the others.

    With ``rims=image`` a pixel is accepted if 97 % of the votes are for its depth. ``keep`` accepts
    all pixels, ``strict`` none.
    """
    pixel = np.flatnonzero(record.boundary_m)
    share = np.full(len(pixel), np.float32(0.5))
    depth_m = record.boundary_m.flat[pixel]
    if record.lab.size:
        share = votes_for(record, [record.depth_m], pixel, depth_m, surely=True)
    accepted = share >= LEAST_SHARE if rims == "image" else np.full(len(pixel), rims == "keep")
    record.votes.flat[pixel] = share
    record.depth_m.flat[pixel[accepted]] = depth_m[accepted]
    record.rejected_m.flat[pixel[~accepted]] = depth_m[~accepted]
    record.filled_m[:] = record.depth_m


def fill(record: MapRecord, reach: float) -> None:
    """Fill the pixels that have measured pixels on both sides, if the pixels around confirm them.

    A filled depth stays if at least nine tenths of the votes (`votes_for`) are for it. ``reach`` is
    the half size of the largest window in spacings of rays.
    """
    empty = record.filled_m == 0
    fill_between(record.filled_m, record.tilt, record.spacing_px, reach)
    _reject_unconfirmed(record, empty, _FILL_SHARE)


def _reject_unconfirmed(record: MapRecord, empty: Bool, least_share: float) -> None:
    """Reject filled pixels that were ``empty`` (H,W) and have less than this share of votes."""
    filled = empty & (record.filled_m > 0)
    pixel = np.flatnonzero(filled)
    # Only measured pixels vote, because filled pixels would confirm themselves. Boundary pixels
    # that were not accepted may only vote against. This protects the pillar of a car, which has few
    # measured pixels.
    maps_m = np.maximum(record.depth_m, record.boundary_m), record.depth_m
    votes = votes_for(record, maps_m, pixel, record.filled_m.flat[pixel], surely=False)
    record.votes.flat[pixel] = votes
    filled.flat[pixel] = votes < ROUNDED * least_share
    record.reject(filled)


class _Known(NamedTuple):
    """The K measured pixels of a map, row by row."""

    # (H,W+1) int32 number of measured pixels above row r or left of column c in row r
    before: NDArray[np.int32]
    num: NDArray[np.int32]  # (H+1,W+1) int32 integral image of the measured pixels
    column: NDArray[np.int32]  # (K,) int32 column of each pixel
    inverse: Float  # (K,) float64 inverse depth of each pixel, 1/m


def fill_between(filled_m: Float32, tilt: Float32, spacing_px: Float32, reach: float) -> None:
    """Interpolate empty pixels that have measured pixels on both sides, in place.

    The window around an empty pixel must hold measured pixels to its left, to its right, above and
    below: nothing is extrapolated. No depth discontinuity may run through them. There is a
    discontinuity if deviations from a plane differ by more than 0.2 m and 6 % of the nearest depth.
    With fewer than six pixels the depths themselves are compared.

    The pixel gets the depth of the plane. Weights fall to zero just outside the window. The window
    grows in thirds of the ray spacing, then to ``reach`` spacings. The smallest sufficient window
    is taken. The maps are those of `MapRecord`, ``filled_m`` with measured pixels only.
    """
    sizes = min(reach, 1.0) * np.arange(1, _NUM_SIZES + 1) / _NUM_SIZES
    reaches = np.append(sizes, reach) if reach > 1 else sizes
    measured = filled_m > 0
    height, width = measured.shape
    before = np.zeros((height, width + 1), np.int32)
    np.cumsum(measured, axis=1, dtype=np.int32, out=before[:, 1:])
    num = np.zeros((height + 1, width + 1), np.int32)
    np.cumsum(before, axis=0, out=num[1:])
    before += num[:-1, -1:]
    column = np.nonzero(measured)[1].astype(np.int32)
    known = _Known(before, num, column, inverse=1 / filled_m[measured].astype(np.float64))
    _fill.over_rows(measured.size, known, spacing_px, reaches, filled_m, tilt)


@inlined
def _any(num, top, bottom, left, right):  # type: ignore[no-untyped-def]
    return num[bottom, right] - num[top, right] - num[bottom, left] + num[top, left] > 0


@inlined
def _surrounded(num, window, row, column):  # type: ignore[no-untyped-def]
    """Return True if a window has measured pixels to the left, to the right, above and below."""
    top, bottom, left, right = window
    return (
        _any(num, top, bottom, left, column)
        and _any(num, top, bottom, column + 1, right)
        and _any(num, top, row, left, right)
        and _any(num, row + 1, bottom, left, right)
    )


@inlined
def _sum_up(known, window, row, column, m):  # type: ignore[no-untyped-def]
    """Fill in the sums of a window's pixels for `plane`; return number, nearest, farthest."""
    # window: its rows, its columns; nearest and farthest are inverse depths
    top, bottom, left, right = window
    reach_v, reach_u = max(row - top, bottom - 1 - row), max(column - left, right - 1 - column)
    num, w_near, w_far = 0, 0.0, np.inf
    m[:] = 0.0
    for r in range(top, bottom):
        for k in range(known.before[r, left], known.before[r, right]):
            w, du, dv = known.inverse[k], known.column[k] - column, r - row
            # It falls to 0 just beyond the reach (px).
            weight = (1 - abs(dv) / (reach_v + 1)) * (1 - abs(du) / (reach_u + 1))
            add_moments(m, weight, du, dv, w)
            num, w_near, w_far = num + 1, max(w_near, w), min(w_far, w)
    return num, w_near, w_far


@inlined
def _spread(known, window, row, column, centre, slope_u, slope_v):  # type: ignore[no-untyped-def]
    """Return the range of the deviations of a window's pixels from a plane, in inverse depth."""
    top, bottom, left, right = window
    low, high = np.inf, -np.inf
    for r in range(top, bottom):
        inverse = centre + (r - row) * slope_v
        for k in range(known.before[r, left], known.before[r, right]):
            off = known.inverse[k] - inverse - (known.column[k] - column) * slope_u
            low, high = min(low, off), max(high, off)
    return high - low


@Kernel
def _fill(first, last, known, spacing_px, reaches, filled_m, tilt):  # type: ignore[no-untyped-def]
    """Fill the empty pixels from ``first`` to ``last`` as in `fill_between`."""
    height, width = filled_m.shape
    m = np.empty(9)
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
            window = (
                max(row - reach_v, 0),
                min(row + reach_v + 1, height),
                max(column - reach_u, 0),
                min(column + reach_u + 1, width),
            )
            if not _surrounded(known.num, window, row, column):
                continue
            num, w_near, w_far = _sum_up(known, window, row, column, m)
            allowed = max(HIDDEN_M, HIDDEN_FRACTION / w_near)
            if num < _MIN_PLANE_PX and 1 / w_far - 1 / w_near > allowed:
                continue
            centre, slope_u, slope_v = plane(m, _RIDGE_PX2)
            spread = _spread(known, window, row, column, centre, slope_u, slope_v)
            if num >= _MIN_PLANE_PX and spread / (centre * centre) > allowed:
                continue
            if centre > 0:
                filled_m[row, column] = 1 / centre
                tilt[row, column, 0], tilt[row, column, 1] = slope_u, slope_v
                break


def fill_stars(record: MapRecord) -> None:
    """Fill holes from the first known pixel, measured or filled, in each of 16 directions.

    At least eight directions must have a known pixel within a spacing of rays, and at most seven
    neighbouring directions none. The surface of each known pixel is extended to the hole. These
    predictions must agree to 10 % of inverse depth. Their mean, weighted by the reciprocal of the
    steps, needs eight tenths of the votes.
    """
    empty = record.filled_m == 0
    pixel = np.flatnonzero(empty)
    predicted_m = np.zeros(len(pixel), np.float32)
    known = Voters(first_known(~empty), inverse_of(record.filled_m), record.tilt)
    _star.over_rows(len(pixel), pixel, known, record.spacing_px, predicted_m)
    record.filled_m.flat[pixel] = predicted_m
    _reject_unconfirmed(record, empty, _STAR_SHARE)


@inlined
def _widest_gap(met):  # type: ignore[no-untyped-def]
    """Return the largest number of neighbouring directions where ``met`` (16,) is False."""
    widest = run = 0
    for d in range(2 * len(met)):
        run = 0 if met[d % len(met)] else run + 1
        widest = max(widest, run)
    return min(widest, len(met))


@Kernel
def _star(first, last, pixel, known, spacing_px, predicted_m):  # type: ignore[no-untyped-def]
    """Predict the depth of empty pixels from the first known pixels around them, 0 for none."""
    width = known.inverse.shape[1]
    met = np.empty(len(DIRECTIONS), np.bool_)
    for p in range(first, last):
        row, column = pixel[p] // width, pixel[p] % width
        reach_px = max(spacing_px[row, column, 0], spacing_px[row, column, 1])
        num, w_near, w_far = 0, 0.0, np.inf
        sum_w, weight = 0.0, 0.0
        for d in range(len(DIRECTIONS)):
            k = np.int64(known.steps[d, row, column])
            du, dv = offset(d, k)
            met[d] = k != NONE and du * du + dv * dv <= reach_px * reach_px
            if met[d]:
                w = extended(known.inverse, known.tilt, row + dv, column + du, du, dv)
                w_near, w_far = max(w_near, w), min(w_far, w)
                sum_w += w / k
                weight += 1 / k
                num += 1
        if num < _STAR_MET or _widest_gap(met) >= _STAR_MET:
            continue
        w = sum_w / weight
        if w_near - w_far <= _STAR_SPREAD * w:
            predicted_m[p] = 1 / w


def measure_spots(record: MapRecord) -> None:
    """Count filled pixels as measured if the laser spot of a measured return covers them.

    The fill must lie on the surface of the return. A covered pixel takes the ``point`` of the
    nearest return, and keeps its filled depth and confidence. Pixels without fill stay empty.
    """
    points, measured = record.points, np.flatnonzero(record.depth_m > 0)
    index_of = np.zeros(len(record.reason), np.int64)  # in the image, by index in the cloud
    index_of[points.rows] = np.arange(len(points.rows))
    point = index_of[record.point.flat[measured]]
    radius_px = np.minimum(FOOTPRINT * points.spacing_px[point, 0], _SPOT_PX)
    filled_m = np.where(record.depth_m == 0, record.filled_m, np.float32(0))
    source = np.full(filled_m.shape, -1)
    nearest, uv = np.full(filled_m.shape, np.inf), points.uv[point]
    _cover(measured, uv, radius_px, record.depth_m, record.tilt, filled_m, source, nearest)
    covered = np.flatnonzero(source >= 0)
    record.depth_m.flat[covered] = record.filled_m.flat[covered]
    record.point.flat[covered] = record.point.flat[source.flat[covered]]


@Kernel
def _cover(pixel, uv, radius_px, depth_m, tilt, filled_m, source_pixel, nearest):  # type: ignore[no-untyped-def]
    """Find for each filled pixel the measured pixel, nearest in the image, whose spot covers it."""
    # filled_m: 0 where no pixel may be covered; source_pixel (H,W): index of the measured pixel, -1
    # at first; nearest (H,W): squared distance to its spot, inf at first
    height, width = filled_m.shape
    for i in range(len(pixel)):
        v, u = pixel[i] // width, pixel[i] % width
        return_m = depth_m[v, u]
        reach = int(radius_px[i] + 0.5)  # the centre of a spot is in its pixel
        for row in range(max(v - reach, 0), min(v + reach + 1, height)):
            for column in range(max(u - reach, 0), min(u + reach + 1, width)):
                z = filled_m[row, column]
                if z == 0:
                    continue
                away = (column - uv[i, 0]) ** 2 + (row - uv[i, 1]) ** 2
                if away > radius_px[i] * radius_px[i] or away >= nearest[row, column]:
                    continue
                inverse = 1 / return_m + (column - u) * tilt[v, u, 0] + (row - v) * tilt[v, u, 1]
                if abs(z * inverse - 1) <= (AGREE_M + AGREE_FRACTION * return_m) * abs(inverse):
                    nearest[row, column] = away
                    source_pixel[row, column] = pixel[i]
