# SPDX-License-Identifier: MIT
"""Range images, compiled: rays put back to their firing times, and points looked up in cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float32
from densify.geometry.compiled import Kernel, inlined

HIDES = 1000
"""More than all cells of all images hold that are asked together."""
_BLOCK = 128
_PI = np.float32(np.pi)
_HALF_PI = np.float32(0.5 * np.pi)
_HALF = np.float32(0.5)
_ZERO = np.float32(0)
# Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.47: arctan within 1e-5 rad, far
# less than a cell.
_A1, _A3, _A5, _A7, _A9 = (
    np.float32(a) for a in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
)


class Tables(NamedTuple):
    """One scanner's range image, see `densify.free_space.range_image.ScannerImage`."""

    offset_s: Float32
    spread_s: Float32
    settled_s: np.float32
    nearest_m: Float32
    num_filled: NDArray[np.uint8]
    row_edges_rad: Float32
    origin_m: Float32
    axes: Float32
    turned: np.bool_
    twists: Float32


@inlined
def _azimuth(x, y):  # type: ignore[no-untyped-def]
    """Radians, left positive. Its own series: faster than the system's arctan2, and the same with
    every version of it."""
    ax, ay = abs(x), abs(y)
    steep = ay > ax
    ratio = ax / ay if steep else (ay / ax if ax > _ZERO else _ZERO)
    square = ratio * ratio
    angle = ratio * (_A1 + square * (_A3 + square * (_A5 + square * (_A7 + square * _A9))))
    if steep:
        angle = _HALF_PI - angle
    if x < _ZERO:
        angle = _PI - angle
    return -angle if y < _ZERO else angle


@inlined
def _column(azimuth, num_columns):  # type: ignore[no-untyped-def]
    """Columns start behind; what has no direction (NaN) comes to the first one."""
    if not abs(azimuth) <= _PI:
        return np.int32(0)
    # 32 bits: many at once where it is called in a loop.
    column = np.int32((azimuth + _PI) * (np.float32(num_columns) / (_PI + _PI)))
    return column - np.int32(num_columns) if column >= num_columns else column


@inlined
def _row(elevation, edges):  # type: ignore[no-untyped-def]
    """Which interval of the ascending edges, -1 outside."""
    low, high = 0, len(edges) - 1
    if not (elevation >= edges[low] and elevation < edges[high]):
        return -1
    while high - low > 1:
        middle = (low + high) // 2
        if elevation < edges[middle]:
            high = middle
        else:
            low = middle
    return low


@inlined
def _all_from_scanner(x, y, z, size, origin, turned, axes):  # type: ignore[no-untyped-def]
    """`_from_scanner` of the first ``size`` points, in place."""
    for k in range(size):
        x[k], y[k], z[k] = x[k] - origin[0], y[k] - origin[1], z[k] - origin[2]
    if turned:
        for k in range(size):
            x[k], y[k], z[k] = _turn(x[k], y[k], z[k], axes)


@inlined
def _rows(elevation, size, edges, row):  # type: ignore[no-untyped-def]
    """`_row` of the first ``size`` elevations at once: into ``row``, the step of the search outside
    and the elevations inside."""
    last, step = np.int32(len(edges) - 1), np.int32(1)
    row[:size] = 0
    while 2 * step < last:
        step *= np.int32(2)
    while step > 0:
        for k in range(size):
            at = min(row[k] + step, last)
            row[k] = at if elevation[k] >= edges[at] else row[k]
        step //= np.int32(2)
    for k in range(size):
        inside = elevation[k] >= edges[0] and elevation[k] < edges[last]
        row[k] = row[k] if inside else np.int32(-1)


@inlined
def _at_time(x, y, z, time_s, twists):  # type: ignore[no-untyped-def]
    """A point at the reference time -> in the lidar frame at ``time_s``; inverse of deskewing.

    The rotation is taken to second order: within a sweep it stays below 0.1 rad.
    """
    w = 0 if time_s < _ZERO else 1
    rx, ry, rz = twists[w, 0] * time_s, twists[w, 1] * time_s, twists[w, 2] * time_s
    px, py, pz = x - twists[w, 3] * time_s, y - twists[w, 4] * time_s, z - twists[w, 5] * time_s
    tx, ty, tz = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px
    return (
        px - tx + _HALF * (ry * tz - rz * ty),
        py - ty + _HALF * (rz * tx - rx * tz),
        pz - tz + _HALF * (rx * ty - ry * tx),
    )


@inlined
def _turn(x, y, z, R):  # type: ignore[no-untyped-def]
    """Into other axes."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@inlined
def _from_scanner(x, y, z, origin, turned, axes):  # type: ignore[no-untyped-def]
    """A point of the lidar frame from where a scanner stands, in its axes."""
    x, y, z = x - origin[0], y - origin[1], z - origin[2]
    if turned:
        x, y, z = _turn(x, y, z, axes)
    return x, y, z


@Kernel
def aim(begin, end, points, offset_s, origin, axes, turned, twists, rays):  # type: ignore[no-untyped-def]
    """The rays that measured a deskewed scanner's points, seen from it when it fired them.

    points: (N,3) lidar frame at the reference time. offset_s: (N,). origin: (3,) of the scanner.
    axes: (3,3) from the lidar frame's to the scanner's, if turned. twists: (2,6) before and after
    the reference time. rays: (3,N), filled with azimuth and elevation (rad) and range (m). All
    float32.
    """
    for i in range(begin, end):
        x, y, z = _at_time(points[i, 0], points[i, 1], points[i, 2], offset_s[i], twists)
        x, y, z = _from_scanner(x, y, z, origin, turned, axes)
        ground = np.sqrt(x * x + y * y)
        rays[0, i] = _azimuth(x, y)
        rays[1, i] = _azimuth(ground, z)
        rays[2, i] = np.sqrt(ground * ground + z * z)


@Kernel
def fill(rays, row_edges_rad, nearest_m, num_filled):  # type: ignore[no-untyped-def]
    """Rays into cells.

    rays: `densify.free_space.sensor.Aimed`. row_edges_rad: (R+1,) float32. Filled: nearest_m: (R,C)
    float32, nearest range within the 3 x 3 cells around each, inf if none; num_filled: (R,C) uint8,
    how many of those nine hold a return.
    """
    num_rows, num_columns = nearest_m.shape
    cells = np.full((num_rows, num_columns), np.float32(np.inf))
    for i in range(len(rays.azimuth)):
        row, column = _row(rays.elevation[i], row_edges_rad), _column(rays.azimuth[i], num_columns)
        if row >= 0:
            cells[row, column] = min(cells[row, column], rays.range_m[i])
    for row in range(num_rows):
        for column in range(num_columns):
            nearest, filled = np.float32(np.inf), 0
            for r in range(max(row - 1, 0), min(row + 2, num_rows)):
                for c in range(column - 1, column + 2):
                    range_m = cells[r, c - num_columns if c == num_columns else c]
                    nearest = min(nearest, range_m)
                    filled += range_m < np.inf
            nearest_m[row, column], num_filled[row, column] = nearest, filled


@Kernel
def add_times(rays, num_rays, sum_s):  # type: ignore[no-untyped-def]
    """Adds up how many rays each column holds and their firing times: (C,) int64, float64."""
    for i in range(len(rays.azimuth)):
        column = _column(rays.azimuth[i], len(num_rays))
        num_rays[column] += 1
        sum_s[column] += rays.offset_s[i]


@Kernel
def fill_times(rays, row_edges_rad, offset_s, spread_s):  # type: ignore[no-untyped-def]
    """The middle of the first and the last firing time within the 3 x 3 cells around each cell, and
    how far they are from it; (R,C) float32, 0 where none holds a ray."""
    num_rows, num_columns = offset_s.shape
    first = np.full((num_rows, num_columns), np.float32(np.inf))
    last = np.full((num_rows, num_columns), np.float32(-np.inf))
    for i in range(len(rays.azimuth)):
        row, column = _row(rays.elevation[i], row_edges_rad), _column(rays.azimuth[i], num_columns)
        if row >= 0:
            first[row, column] = min(first[row, column], rays.offset_s[i])
            last[row, column] = max(last[row, column], rays.offset_s[i])
    for row in range(num_rows):
        for column in range(num_columns):
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for r in range(max(row - 1, 0), min(row + 2, num_rows)):
                for c in range(column - 1, column + 2):
                    at = c - num_columns if c == num_columns else c
                    low, high = min(low, first[r, at]), max(high, last[r, at])
            if low <= high:
                offset_s[row, column] = _HALF * (low + high)
                spread_s[row, column] = _HALF * (high - low)


@inlined
def _speed(x, y, z, vx, vy, vz, twist):  # type: ignore[no-untyped-def]
    """m/s at which the lidar sees a point with a velocity of its own go by."""
    vx -= twist[3] + twist[1] * z - twist[2] * y
    vy -= twist[4] + twist[2] * x - twist[0] * z
    vz -= twist[5] + twist[0] * y - twist[1] * x
    return np.sqrt(vx * vx + vy * vy + vz * vz)


@Kernel
def see_beyond(begin, end, points, velocity, image, margins, least, beyond):  # type: ignore[no-untyped-def]
    """How much one scanner saw of what lies beyond points: adds to ``beyond`` (N,) int16 how many
    of the 3 x 3 cells around each hold a return, or takes `HIDES` where one of these is not beyond.

    points: (N,3) lidar frame at the reference time; velocity: (N,3) m/s, or (0,3) if none moves.
    image: `Tables`. margins: (2,) metres and share of the range. All float32. least: fewer filled
    cells tell nothing.
    """
    num_columns = image.nearest_m.shape[1]
    moving, by_azimuth = len(velocity) > 0, len(image.offset_s) == 1
    row_edges_rad = image.row_edges_rad
    x, y, z, time_s, elevation = np.empty((5, _BLOCK), np.float32)
    row, column = np.zeros((2, _BLOCK), np.int32)
    # Each point is a long chain of steps; a block of them takes every step side by side.
    for start in range(begin, end, _BLOCK):
        size = min(_BLOCK, end - start)
        for k in range(size):
            x[k], y[k], z[k] = points[start + k, 0], points[start + k, 1], points[start + k, 2]
        _all_from_scanner(x, y, z, size, image.origin_m, image.turned, image.axes)
        for _ in range(2):  # when did the scanner face the point? converges in two steps
            for k in range(size):
                column[k] = _column(_azimuth(x[k], y[k]), num_columns)
            if by_azimuth:
                for k in range(size):
                    time_s[k] = image.offset_s[0, column[k]]
            else:
                for k in range(size):
                    elevation[k] = _azimuth(np.sqrt(x[k] * x[k] + y[k] * y[k]), z[k])
                _rows(elevation, size, row_edges_rad, row)
                for k in range(size):
                    time_s[k] = image.offset_s[max(row[k], 0), column[k]]
            for k in range(size):
                x[k], y[k], z[k] = points[start + k, 0], points[start + k, 1], points[start + k, 2]
            if moving:
                for k in range(size):
                    x[k] += time_s[k] * velocity[start + k, 0]
                    y[k] += time_s[k] * velocity[start + k, 1]
                    z[k] += time_s[k] * velocity[start + k, 2]
            for k in range(size):
                x[k], y[k], z[k] = _at_time(x[k], y[k], z[k], time_s[k], image.twists)
            _all_from_scanner(x, y, z, size, image.origin_m, image.turned, image.axes)
        for k in range(size):
            column[k] = _column(_azimuth(x[k], y[k]), num_columns)
        for k in range(size):
            elevation[k] = _azimuth(np.sqrt(x[k] * x[k] + y[k] * y[k]), z[k])
        _rows(elevation, size, row_edges_rad, row)
        for k in range(size):
            i, ground = start + k, np.sqrt(x[k] * x[k] + y[k] * y[k])
            r, c = row[k], column[k]
            if r < 0 or image.num_filled[r, c] < least:
                continue
            range_m = np.sqrt(ground * ground + z[k] * z[k])
            margin_m = max(margins[0], margins[1] * range_m)
            away_s = abs(image.offset_s[0 if by_azimuth else r, c] - time_s[k])
            if by_azimuth:
                # Where a turning scanner begins and ends its turn it skips or repeats a sector.
                if away_s > image.settled_s:
                    continue
            else:
                away_s += image.spread_s[r, c]
                vx = velocity[i, 0] if moving else _ZERO
                vy = velocity[i, 1] if moving else _ZERO
                vz = velocity[i, 2] if moving else _ZERO
                twist = image.twists[0 if time_s[k] < _ZERO else 1]
                margin_m += away_s * _speed(
                    points[i, 0], points[i, 1], points[i, 2], vx, vy, vz, twist
                )
            if image.nearest_m[r, c] > range_m + margin_m:
                beyond[i] += image.num_filled[r, c]
            else:
                beyond[i] -= HIDES
