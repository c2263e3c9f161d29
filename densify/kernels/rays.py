# SPDX-License-Identifier: MIT
"""Range images, compiled: rays put back to their firing times, and points looked up in cells."""

from __future__ import annotations

import numpy as np

from densify.kernels import Kernel, inlined

_BLOCK = 128
_SETTLED_S = np.float32(0.01)
_PI = np.float32(np.pi)
_HALF_PI = np.float32(0.5 * np.pi)
_HALF = np.float32(0.5)
_ZERO = np.float32(0)
# Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.47: arctan within 1e-5 rad, far
# less than a cell.
_A1, _A3, _A5, _A7, _A9 = (
    np.float32(a) for a in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
)


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
        return 0
    column = int((azimuth + _PI) * (np.float32(num_columns) / (_PI + _PI)))
    return column - num_columns if column >= num_columns else column


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


@Kernel
def aim(begin, end, points, offset_s, origin, twists, rays):  # type: ignore[no-untyped-def]
    """The rays that measured a deskewed scanner's points, seen from it when it fired them.

    points: (N,3) lidar frame at the reference time. offset_s: (N,). origin: (3,) of the scanner.
    twists: (2,6) before and after the reference time. rays: (3,N), filled with azimuth and
    elevation (rad) and range (m). All float32.
    """
    for i in range(begin, end):
        x, y, z = _at_time(points[i, 0], points[i, 1], points[i, 2], offset_s[i], twists)
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
        ground = np.sqrt(x * x + y * y)
        rays[0, i] = _azimuth(x, y)
        rays[1, i] = _azimuth(ground, z)
        rays[2, i] = np.sqrt(ground * ground + z * z)


@Kernel
def fill(rays, offset_s, row_edges_rad, nearest_m, num_filled, num_rays, sum_s):  # type: ignore[no-untyped-def]
    """Rays into cells.

    rays: (3,N) of `aim`, offset_s: (N,), row_edges_rad: (R+1,), all float32. Filled:
    nearest_m: (R,C) float32, nearest range within the 3 x 3 cells around each, inf if none;
    num_filled: (R,C) uint8, how many of those nine hold a return; num_rays: (C,) int64 and
    sum_s: (C,) float64, of the offsets.
    """
    num_rows, num_columns = nearest_m.shape
    cells = np.full((num_rows, num_columns), np.float32(np.inf))
    for i in range(len(offset_s)):
        row, column = _row(rays[1, i], row_edges_rad), _column(rays[0, i], num_columns)
        num_rays[column] += 1
        sum_s[column] += offset_s[i]
        if row >= 0:
            cells[row, column] = min(cells[row, column], rays[2, i])
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
def see_through(  # type: ignore[no-untyped-def]
    begin,
    end,
    points,
    velocity,
    offset_s,
    nearest_m,
    num_filled,
    row_edges_rad,
    origin,
    twists,
    margins,
    min_filled,
    free,
):
    """Marks in ``free`` (N,) bool the points where one scanner certainly saw free space.

    points: (N,3) lidar frame at the reference time; velocity: (N,3) m/s, or (0,3) if none moves.
    offset_s: (C,) when the scanner faced each column. nearest_m, num_filled: (R,C) as `fill` leaves
    them. margins: (2,) metres and share of the range. The rest as in `aim`; floats are float32.
    """
    num_columns = nearest_m.shape[1]
    moving = len(velocity) > 0
    x, y, z, time_s = np.empty((4, _BLOCK), np.float32)
    column = np.empty(_BLOCK, np.int64)
    # Each point is a long chain of steps; a block of them takes every step side by side.
    for start in range(begin, end, _BLOCK):
        size = min(_BLOCK, end - start)
        for k in range(size):
            x[k] = points[start + k, 0] - origin[0]
            y[k] = points[start + k, 1] - origin[1]
        for _ in range(2):  # when did the scanner face the point? converges in two steps
            for k in range(size):
                column[k] = _column(_azimuth(x[k], y[k]), num_columns)
            for k in range(size):
                i, t = start + k, offset_s[column[k]]
                px, py, pz = points[i, 0], points[i, 1], points[i, 2]
                if moving:
                    px += t * velocity[i, 0]
                    py += t * velocity[i, 1]
                    pz += t * velocity[i, 2]
                px, py, pz = _at_time(px, py, pz, t, twists)
                x[k], y[k], z[k], time_s[k] = px - origin[0], py - origin[1], pz - origin[2], t
        for k in range(size):
            column[k] = _column(_azimuth(x[k], y[k]), num_columns)
        for k in range(size):
            ground = np.sqrt(x[k] * x[k] + y[k] * y[k])
            row = _row(_azimuth(ground, z[k]), row_edges_rad)
            # Where a turning scanner begins and ends its revolution it skips or repeats a sector.
            settled = abs(offset_s[column[k]] - time_s[k]) < _SETTLED_S
            if row < 0 or not settled or num_filled[row, column[k]] < min_filled:
                continue
            range_m = np.sqrt(ground * ground + z[k] * z[k])
            margin_m = max(margins[0], margins[1] * range_m)
            if nearest_m[row, column[k]] > range_m + margin_m:
                free[start + k] = True
