# SPDX-License-Identifier: MIT
"""How the surface around a point is inclined, told by its sweep's neighbouring rays, compiled: see
`densify.depth.patches`."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined

_STEEP = 5.7  # metres farther per metre across, 10 degrees: a surface steeper on one side is a step
_BEND_M = 0.10
_BEND = 0.25  # of the change itself
_AROUND, _MOST_CELLS = 5.0, 20  # spacings within which rays without order have neighbours
_RIDGE = 0.005  # of the neighbours' mean square distance


@Kernel
def look(first, last, points, origins, place, seen):  # type: ignore[no-untyped-def]
    """Points in the directions they were measured: seen (3,N) float32, filled with azimuth,
    elevation (rad) and range (m). points: (N,3) float64; origins: (P,3) where scanners stood;
    place: (N,) int32, at which of them."""
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
    """Row and column of a direction in a `densify.free_space.sensor.RayGrid`."""
    place = (elevation - grid.low_rad) / grid.bin_rad
    k = min(max(int(place), 0), len(grid.row_of) - 2)
    at = grid.row_of[k] + (place - k) * (grid.row_of[k + 1] - grid.row_of[k])
    row = min(max(int(at), 0), grid.num_rows - 1)
    column = int((azimuth + np.pi) * (grid.num_columns / (2 * np.pi)))
    return row, min(max(column, 0), grid.num_columns - 1)


@inlined
def _spacing(azimuth, elevation, table):  # type: ignore[no-untyped-def]
    """Across and along (rad), see `densify.free_space.sensor.RayTable`."""
    row = min(max(int((elevation - table.low_rad) / table.bin_rad), 0), table.along.shape[0] - 1)
    columns = table.along.shape[1]
    column = int((azimuth + np.pi) * (columns / (2 * np.pi))) % columns
    return table.across[row, column], table.along[row, column]


@inlined
def _before(seen, i, j):  # type: ignore[no-untyped-def]
    if seen[2, i] != seen[2, j]:
        return seen[2, i] < seen[2, j]
    if seen[0, i] != seen[0, j]:
        return seen[0, i] < seen[0, j]
    return seen[1, i] < seen[1, j]


@Kernel
def nearest_in_cells(seen, members, grid, cells):  # type: ignore[no-untyped-def]
    """cells: (R,C) int32 of the grid, filled with the nearest of ``members`` (indices) in each, -1
    none. Of equally near ones the direction decides, not the order of the points."""
    cells[:] = -1
    for i in members:
        row, column = _cell(seen[0, i], seen[1, i], grid)
        there = cells[row, column]
        if there < 0 or _before(seen, i, there):
            cells[row, column] = i


@inlined
def _first(cells, row, column, rows, columns):  # type: ignore[no-untyped-def]
    """The point in the first filled cell of those at the given distances, -1 none."""
    for k in range(len(rows)):
        r = row + rows[k]
        if 0 <= r < cells.shape[0]:
            there = cells[r, (column + columns[k]) % cells.shape[1]]
            if there >= 0:
                return there
    return -1


@inlined
def _slope(one, other, step, range_m):  # type: ignore[no-untyped-def]
    """Change of inverse range per radian from the changes on both sides (NaN: none).

    Where both tell of one surface their mean; else the lesser, unless it is a step in depth.
    """
    metres = step * range_m * range_m  # of range per step, by a unit of slope
    if abs(one - other) * metres <= _BEND_M + _BEND * abs(one + other) * metres:
        return 0.5 * (one + other)
    if not abs(one) <= abs(other):  # NaN too
        one = other
    return one if abs(one) * range_m <= _STEEP else 0.0


@inlined
def _change(seen, i, there, axis, across, slope_across):  # type: ignore[no-untyped-def]
    """Slope of inverse range per radian along one angle, that along the other taken off; NaN if
    none."""
    if there < 0:
        return np.nan
    apart = seen[axis, there] - seen[axis, i]
    if axis == 0:
        apart -= 2 * np.pi * np.rint(apart / (2 * np.pi))
    if abs(apart) < 1e-5:
        return np.nan
    beside = seen[across, there] - seen[across, i]
    return (1 / seen[2, there] - 1 / seen[2, i] - slope_across * beside) / apart


@inlined
def _put(i, seen, table, level, rise, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill a point's row from the change of inverse range per radian of azimuth and elevation."""
    azimuth, elevation, range_m = seen[0, i], seen[1, i], seen[2, i]
    across, along = _spacing(azimuth, elevation, table)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    aside = level / max(ce, 1e-3)
    normal[i, 0] = ce * ca / range_m - aside * sa - rise * se * ca
    normal[i, 1] = ce * sa / range_m + aside * ca - rise * se * sa
    normal[i, 2] = se / range_m + rise * ce
    spacing[i, 0] = range_m * across
    spacing[i, 1] = range_m * along


@Kernel
def tangents_on_rings(first, last, members, seen, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """The tangent plane and the spacing of the rays at each of a scanner's points in a sweep, from
    its neighbours on its ring and on those above and below.

    members: (n,) indices of the points, seen: (3,N) of `look`, cells of `nearest_in_cells`. Filled:
    normal (N,3) float32, of any length: the plane is normal · (p - origin) = 1; spacing (N,2)
    float32 metres between neighbouring rays, across and along elevation.

    On a plane the inverse range is normal · direction, so its two derivatives tell the normal.
    """
    right, left = np.array([-2, -1, -3]), np.array([2, 1, 3])
    same = np.zeros(3, np.int64)
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
def tangents_anywhere(first, last, members, seen, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """As `tangents_on_rings`, of rays without order: least squares over the points around, then
    over those that the first plane is right about; a point that half of them are not on one surface
    with faces the scanner. A ridge keeps points on one line from tilting the plane."""
    num_rows, num_columns = cells.shape
    for k in range(first, last):
        i = members[k]
        range_m, flatten = seen[2, i], np.cos(seen[1, i])
        row, column = _cell(seen[0, i], seen[1, i], grid)
        spacing_rad = _spacing(seen[0, i], seen[1, i], table)[1]
        reach = min(1 + int(_AROUND * spacing_rad / grid.bin_rad), _MOST_CELLS)
        level, rise = 0.0, 0.0
        for turn in range(2):
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
            uu, vv = uu + ridge, vv + ridge
            determinant = uu * vv - uv * uv
            level, rise = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
            if 2 * num_kept < num:
                level, rise = 0.0, 0.0
        _put(i, seen, table, level * flatten, rise, normal, spacing)
