# SPDX-License-Identifier: MIT
"""Move rays back to their firing times, and look points up in range images, in compiled loops."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined

HIDES = 1000
"""Penalty of a hiding return, above the number of cells of all images whose counts are added."""
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


@inlined
def _azimuth(x, y):  # type: ignore[no-untyped-def]
    """Return the azimuth of (x, y) in radians, positive to the left."""
    # The series is faster than the system's arctan2, and the same with every version of it.
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
    """Return the column of an azimuth, 0 for NaN. Columns start behind the scanner."""
    if not abs(azimuth) <= _PI:
        return np.int32(0)
    # 32 bits, because more of them fit into a vector instruction.
    column = np.int32((azimuth + _PI) * (np.float32(num_columns) / (_PI + _PI)))
    return column - np.int32(num_columns) if column >= num_columns else column


@inlined
def _rows(elevation, size, edges, row):  # type: ignore[no-untyped-def]
    """Fill ``row`` with the interval of the ascending edges of each elevation, -1 outside."""
    # a binary search of many elevations at once, with the steps as the outer loop
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
    """Move a point from the reference time to the lidar frame at ``time_s``: undo deskewing."""
    # The rotation is taken to second order, because within a sweep it stays below 0.1 rad.
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
def _from_scanner(x, y, z, size, origin, R):  # type: ignore[no-untyped-def]
    """Move ``size`` points from the lidar frame to the scanner's origin and axes R, in place."""
    for k in range(size):
        x[k], y[k], z[k] = x[k] - origin[0], y[k] - origin[1], z[k] - origin[2]
    if R[0, 0] + R[1, 1] + R[2, 2] < 3:
        for k in range(size):
            x[k], y[k], z[k] = (
                R[0, 0] * x[k] + R[0, 1] * y[k] + R[0, 2] * z[k],
                R[1, 0] * x[k] + R[1, 1] * y[k] + R[1, 2] * z[k],
                R[2, 0] * x[k] + R[2, 1] * y[k] + R[2, 2] * z[k],
            )


@Kernel
def aim(begin, end, points, offset_s, origin, axes, twists, rays):  # type: ignore[no-untyped-def]
    """Fill ``rays`` (3,N) with azimuth and elevation (rad) and range (m) of a scanner's points.

    Each deskewed point is moved to the scanner's frame at its firing time. All arrays are float32.

    Args:
        points: (N,3) positions in metres, lidar frame at the reference time.
        offset_s: (N,) firing times in seconds after the reference time.
        origin: (3,) position of the scanner in the lidar frame.
        axes: (3,3) rotation from the lidar frame to the scanner's axes.
        twists: (2,6) twist of the lidar before and after the reference time.
    """
    x, y, z = np.empty((3, _BLOCK), np.float32)
    for start in range(begin, end, _BLOCK):
        size = min(_BLOCK, end - start)
        for k in range(size):
            i = start + k
            x[k], y[k], z[k] = _at_time(
                points[i, 0], points[i, 1], points[i, 2], offset_s[i], twists
            )
        _from_scanner(x, y, z, size, origin, axes)
        for k in range(size):
            horizontal_m = np.sqrt(x[k] * x[k] + y[k] * y[k])
            rays[0, start + k] = _azimuth(x[k], y[k])
            rays[1, start + k] = _azimuth(horizontal_m, z[k])
            rays[2, start + k] = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])


@inlined
def _speed(x, y, z, vx, vy, vz, twist):  # type: ignore[no-untyped-def]
    """Return the speed in m/s of a point relative to the lidar."""
    vx -= twist[3] + twist[1] * z - twist[2] * y
    vy -= twist[4] + twist[2] * x - twist[0] * z
    vz -= twist[5] + twist[0] * y - twist[1] * x
    return np.sqrt(vx * vx + vy * vy + vz * vz)


@inlined
def _face(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column):  # type: ignore[no-untyped-def]
    """Move ``size`` points to the time at which the scanner faced them, which is found too."""
    # Two rounds from the position at the reference time converge.
    num_columns, by_azimuth = image.nearest_m.shape[1], len(image.offset_s) == 1
    time_s[:size] = _ZERO
    for round in range(3):
        for k in range(size):
            i, t = start + k, time_s[k]
            if len(velocity) > 0:
                x[k], y[k], z[k] = _at_time(
                    points[i, 0] + t * velocity[i, 0], points[i, 1] + t * velocity[i, 1],
                    points[i, 2] + t * velocity[i, 2], t, image.twists,
                )  # fmt: skip
            else:
                x[k], y[k], z[k] = _at_time(
                    points[i, 0], points[i, 1], points[i, 2], t, image.twists
                )
        _from_scanner(x, y, z, size, image.origin_m, image.axes)
        for k in range(size):
            column[k] = _column(_azimuth(x[k], y[k]), num_columns)
        if round == 2 or not by_azimuth:
            for k in range(size):
                elevation[k] = _azimuth(np.sqrt(x[k] * x[k] + y[k] * y[k]), z[k])
            _rows(elevation, size, image.row_edges_rad, row)
        if round < 2:
            for k in range(size):
                time_s[k] = image.offset_s[0 if by_azimuth else max(row[k], 0), column[k]]


@Kernel
def see_beyond(begin, end, points, velocity, image, margins, min_filled, beyond):  # type: ignore[no-untyped-def]
    """Add to ``beyond`` (N,) int16 the number of returns of one scanner beyond each point.

    Counted are the filled cells among the 3 x 3 cells around a point, if they are at least
    ``min_filled``. If any of their returns is not beyond the point, `HIDES` is subtracted instead.
    All other arrays are float32.

    Args:
        points: (N,3) positions in metres, lidar frame at the reference time.
        velocity: (N,3) velocities in m/s, or (0,3) if all points are static.
        image: Range image, `densify.free_space.range_image.ScannerImage`.
        margins: (2,) least distance of a return beyond a point: metres and share of the range.
    """
    moving, by_azimuth = len(velocity) > 0, len(image.offset_s) == 1
    settled_s = np.float32(image.settled_s)
    x, y, z, time_s, elevation = np.empty((5, _BLOCK), np.float32)
    row, column = np.empty((2, _BLOCK), np.int32)
    # Each point needs a long chain of steps. A block of points takes every step in parallel.
    for start in range(begin, end, _BLOCK):
        size = min(_BLOCK, end - start)
        _face(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column)
        for k in range(size):
            i, horizontal_m = start + k, np.sqrt(x[k] * x[k] + y[k] * y[k])
            r, c = row[k], column[k]
            if r < 0 or image.num_filled[r, c] < min_filled:
                continue
            range_m = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])
            margin_m = max(margins[0], margins[1] * range_m)
            away_s = abs(image.offset_s[0 if by_azimuth else r, c] - time_s[k])
            if by_azimuth:
                # Between two turns a spinning scanner skips or repeats a sector.
                if away_s > settled_s:
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
