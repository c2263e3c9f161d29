# SPDX-License-Identifier: MIT
"""Compute the surface patch of each accumulated point.

A patch is as large as the spacing of the neighbouring rays of its own sweep, and tangent to the
neighbouring points. On a plane the inverse range is normal · direction, so its derivatives by
azimuth and elevation give the normal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from densify.depth.neighbours import slopes
from densify.free_space.sensor import Sensors
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Cloud, Float, Patches

_STEEP = 5.7  # greatest slope, 10 degrees of incidence; a steeper surface on one side is a step
_BEND_M, _BEND = 0.10, 0.25  # greatest change of the slope, in metres and as a share
_AROUND, _MOST_CELLS = 5.0, 20  # radius of neighbours of unordered rays: spacings, most cells
_RIDGE = 0.005  # share of the mean square distance of the neighbours


def patches(
    cloud: Cloud, sensors: Sensors, origins: Mapping[int, Float], wanted: Bool | None = None
) -> Patches:
    """Return the surface patches of a cloud.

    A patch is tangent to the neighbouring returns of the same scanner and sweep. If the neighbours
    are on no single surface, the patch faces the scanner.

    Args:
        origins: (S,3) origins of the scanners, key sweep's lidar frame, by frame number.
        wanted: (M,) True for points in view of a camera, None for all. Other points get zeros.
    """
    frames, inverse = np.unique(cloud.frame, return_inverse=True)
    sweep: NDArray[np.int32] = inverse.ravel().astype(np.int32)
    if wanted is None:
        wanted = np.ones(len(cloud), bool)
    origin = [origins[int(f)] for f in frames]
    return tangents(cloud.rigid_points, cloud.lidar, sweep, wanted, sensors, origin)


def tangents(
    points: Float,
    lidar: NDArray[np.uint8],
    sweep: NDArray[np.int32],
    wanted: Bool,
    sensors: Sensors,
    origins: Sequence[Float],
) -> Patches:
    """Return the patches of M points, with zeros for points that are not ``wanted`` (M,).

    A point p is on the tangent plane if normal · (p - origin) = 1. Spacings are metres between
    neighbouring rays, along the azimuth and along the elevation.

    Args:
        lidar: (M,) number of the scanner of each point.
        sweep: (M,) index of each point's sweep in ``origins``.
        origins: (S,3) origins of the scanners for each sweep, in the frame of the points.
    """
    normal = np.zeros((len(points), 3), np.float32)
    spacing_m = np.zeros((len(points), 2), np.float32)
    if not len(points):
        return Patches(normal, spacing_m)
    num_scanners = len(origins[0])
    place = (sweep * num_scanners + lidar).astype(np.int32)
    seen = np.empty((3, len(points)), np.float32)
    _look.over_rows(len(points), points, np.concatenate(origins), place, seen)
    size = np.bincount(place, minlength=num_scanners * len(origins))
    members = np.split(np.argsort(place, kind="stable"), np.cumsum(size)[:-1])
    for number, model in sensors.models.items():
        grid = model.grid
        cells = np.empty((grid.num_rows, grid.num_columns), np.int32)
        find = _tangents_anywhere if model.unordered else _tangents_on_rings
        for mine in members[number::num_scanners]:
            _nearest_in_cells(seen, mine, grid, cells)
            mine = mine[wanted[mine]]
            find.over_rows(len(mine), mine, seen, model.table, grid, cells, normal, spacing_m)
    return Patches(normal, spacing_m)


@Kernel
def _look(first, last, points, origins, place, seen):  # type: ignore[no-untyped-def]
    """Fill ``seen`` (3,N) with azimuth, elevation (rad) and range (m) of points (N,3)."""
    for i in range(first, last):
        x = points[i, 0] - origins[place[i], 0]
        y = points[i, 1] - origins[place[i], 1]
        z = points[i, 2] - origins[place[i], 2]
        level = np.sqrt(x * x + y * y)
        seen[0, i] = np.arctan2(y, x)
        seen[1, i] = np.arctan2(z, level)
        seen[2, i] = np.sqrt(level * level + z * z)


@inlined
def _cell(azimuth, elevation, grid):  # type: ignore[no-untyped-def]
    """Return row and column of a direction in a `densify.free_space.sensor.RayGrid`."""
    place = (elevation - grid.low_rad) / grid.bin_rad
    k = min(max(int(place), 0), len(grid.row_of) - 2)
    at = grid.row_of[k] + (place - k) * (grid.row_of[k + 1] - grid.row_of[k])
    row = min(max(int(at), 0), grid.num_rows - 1)
    column = int((azimuth + np.pi) * (grid.num_columns / (2 * np.pi)))
    return row, min(max(column, 0), grid.num_columns - 1)


@inlined
def _spacing(azimuth, elevation, table):  # type: ignore[no-untyped-def]
    """Return the angles (rad) to the next ray along azimuth and elevation, from a `RayTable`."""
    row = min(max(int((elevation - table.low_rad) / table.bin_rad), 0), table.along.shape[0] - 1)
    columns = table.along.shape[1]
    column = int((azimuth + np.pi) * (columns / (2 * np.pi))) % columns
    return table.across[row, column], table.along[row, column]


@inlined
def _before(seen, i, j):  # type: ignore[no-untyped-def]
    """Return True if point i is nearer than point j; between equal ranges the direction decides."""
    if seen[2, i] != seen[2, j]:
        return seen[2, i] < seen[2, j]
    if seen[0, i] != seen[0, j]:
        return seen[0, i] < seen[0, j]
    return seen[1, i] < seen[1, j]


@Kernel
def _nearest_in_cells(seen, members, grid, cells):  # type: ignore[no-untyped-def]
    """Fill ``cells`` (R,C) with the index of the nearest of the members in each cell, -1 none."""
    cells[:] = -1
    for i in members:
        row, column = _cell(seen[0, i], seen[1, i], grid)
        there = cells[row, column]
        if there < 0 or _before(seen, i, there):
            cells[row, column] = i


@inlined
def _first(cells, row, column, rows, columns):  # type: ignore[no-untyped-def]
    """Return the index of the point in the first filled cell at the given offsets, -1 none."""
    for k in range(len(rows)):
        r = row + rows[k]
        if 0 <= r < cells.shape[0]:
            there = cells[r, (column + columns[k]) % cells.shape[1]]
            if there >= 0:
                return there
    return -1


@inlined
def _slope(one, other, step, range_m):  # type: ignore[no-untyped-def]
    """Return the slope of inverse range per radian from its slopes on both sides (NaN: unknown)."""
    metres = step * range_m * range_m  # of range per step, by a unit of slope
    # On one surface the mean, else the lesser slope, or 0 if that is a step in depth; step in rad
    if abs(one - other) * metres <= _BEND_M + _BEND * abs(one + other) * metres:
        return 0.5 * (one + other)
    if not abs(one) <= abs(other):  # NaN too
        one = other
    return one if abs(one) * range_m <= _STEEP else 0.0


@inlined
def _change(seen, i, there, axis, across, slope_across):  # type: ignore[no-untyped-def]
    """Return the change of inverse range per radian along axis 0 (azimuth) or 1, NaN unknown."""
    if there < 0:
        return np.nan
    apart = seen[axis, there] - seen[axis, i]
    if axis == 0:
        apart -= 2 * np.pi * np.rint(apart / (2 * np.pi))
    if abs(apart) < 1e-5:
        return np.nan
    # The change by the other angle is removed.
    beside = seen[across, there] - seen[across, i]
    return (1 / seen[2, there] - 1 / seen[2, i] - slope_across * beside) / apart


@inlined
def _put(i, seen, table, level, rise, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill in normal and spacing of point i from its slopes of inverse range per radian."""
    azimuth, elevation, range_m = seen[0, i], seen[1, i], seen[2, i]
    across, along = _spacing(azimuth, elevation, table)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    # level: slope along the azimuth, rise: along the elevation
    aside = level / max(ce, 1e-3)
    normal[i, 0] = ce * ca / range_m - aside * sa - rise * se * ca
    normal[i, 1] = ce * sa / range_m + aside * ca - rise * se * sa
    normal[i, 2] = se / range_m + rise * ce
    spacing[i, 0] = range_m * across
    spacing[i, 1] = range_m * along


@Kernel
def _tangents_on_rings(first, last, members, seen, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal (N,3) and spacing (N,2) of members from neighbours on the ring, above, below."""
    right, left = np.array([-2, -1, -3]), np.array([2, 1, 3])
    same = np.array([0, 0, 0])
    up, down = np.array([1, 1, 1, 2]), np.array([-1, -1, -1, -2])
    straight = np.array([0, 1, -1, 0])
    for k in range(first, last):
        i = members[k]
        across, along = _spacing(seen[0, i], seen[1, i], table)
        step = across / max(np.cos(seen[1, i]), 1e-3)
        row, column = _cell(seen[0, i], seen[1, i], grid)
        one = _change(seen, i, _first(cells, row, column, same, right), 0, 1, 0.0)
        other = _change(seen, i, _first(cells, row, column, same, left), 0, 1, 0.0)
        level = _slope(one, other, 2 * step, seen[2, i])
        level = 0.0 if np.isnan(level) else level
        above = _first(cells, row, column, up, straight)
        below = _first(cells, row, column, down, straight)
        one, other = _change(seen, i, above, 1, 0, level), _change(seen, i, below, 1, 0, level)
        rise = _slope(one, other, along, seen[2, i])
        _put(i, seen, table, level, 0.0 if np.isnan(rise) else rise, normal, spacing)


@Kernel
def _tangents_anywhere(first, last, members, seen, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal and spacing as `_tangents_on_rings`, for a scanner without rings."""
    num_rows, num_columns = cells.shape
    for k in range(first, last):
        i = members[k]
        range_m, flatten = seen[2, i], np.cos(seen[1, i])
        row, column = _cell(seen[0, i], seen[1, i], grid)
        spacing_rad = _spacing(seen[0, i], seen[1, i], table)[1]
        reach = min(1 + int(_AROUND * spacing_rad / grid.bin_rad), _MOST_CELLS)
        level, rise = 0.0, 0.0
        for turn in range(2):  # a plane to the points around, then to those close to it
            uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
            num, num_kept = 0, 0
            for r in range(max(row - reach, 0), min(row + reach, num_rows - 1) + 1):
                for c in range(column - reach, column + reach + 1):
                    j = cells[r, c % num_columns]
                    if j < 0:
                        continue
                    u = seen[0, j] - seen[0, i]
                    u = (u - 2 * np.pi * np.rint(u / (2 * np.pi))) * flatten
                    v, w = seen[1, j] - seen[1, i], 1 / seen[2, j] - 1 / range_m
                    if u == 0 and v == 0 and w == 0:
                        continue  # the point itself, or its equal
                    num += 1
                    off_m = abs(w - level * u - rise * v) * range_m * range_m
                    if turn and off_m > _BEND_M + _BEND * abs(w) * range_m * range_m:
                        continue
                    num_kept += 1
                    uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
            ridge = _RIDGE * (uu + vv) + 1e-12
            level, rise = slopes(uu + ridge, uv, vv + ridge, uw, vw)
            if 2 * num_kept < num:  # no plane: the patch faces the scanner
                level, rise = 0.0, 0.0
        _put(i, seen, table, level * flatten, rise, normal, spacing)
