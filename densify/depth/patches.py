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
    scanner = (sweep * num_scanners + lidar).astype(np.int32)
    spherical = np.empty((3, len(points)), np.float32)
    _look.over_rows(len(points), points, np.concatenate(origins), scanner, spherical)
    size = np.bincount(scanner, minlength=num_scanners * len(origins))
    members = np.split(np.argsort(scanner, kind="stable"), np.cumsum(size)[:-1])
    for number, model in sensors.models.items():
        grid = model.grid
        cells = np.empty((grid.num_rows, grid.num_columns), np.int32)
        find = _tangents_anywhere if model.unordered else _tangents_on_rings
        for rows in members[number::num_scanners]:
            _nearest_in_cells(spherical, rows, grid, cells)
            rows = rows[wanted[rows]]
            find.over_rows(len(rows), rows, spherical, model.table, grid, cells, normal, spacing_m)
    return Patches(normal, spacing_m)


@Kernel
def _look(first, last, points, origins, scanner, spherical):  # type: ignore[no-untyped-def]
    """Fill ``spherical`` (3,N) with azimuth, elevation (rad) and range (m) of points (N,3)."""
    for i in range(first, last):
        x = points[i, 0] - origins[scanner[i], 0]
        y = points[i, 1] - origins[scanner[i], 1]
        z = points[i, 2] - origins[scanner[i], 2]
        horizontal_m = np.sqrt(x * x + y * y)
        spherical[0, i] = np.arctan2(y, x)
        spherical[1, i] = np.arctan2(z, horizontal_m)
        spherical[2, i] = np.sqrt(horizontal_m * horizontal_m + z * z)


@inlined
def _cell(azimuth, elevation, grid):  # type: ignore[no-untyped-def]
    """Return row and column of a direction in a `densify.free_space.sensor.RayGrid`."""
    at_bin = (elevation - grid.low_rad) / grid.bin_rad
    k = min(max(int(at_bin), 0), len(grid.row_of) - 2)
    at_row = grid.row_of[k] + (at_bin - k) * (grid.row_of[k + 1] - grid.row_of[k])
    row = min(max(int(at_row), 0), grid.num_rows - 1)
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
def _before(spherical, i, j):  # type: ignore[no-untyped-def]
    """Return True if point i is nearer than point j; between equal ranges the direction decides."""
    if spherical[2, i] != spherical[2, j]:
        return spherical[2, i] < spherical[2, j]
    if spherical[0, i] != spherical[0, j]:
        return spherical[0, i] < spherical[0, j]
    return spherical[1, i] < spherical[1, j]


@Kernel
def _nearest_in_cells(spherical, members, grid, cells):  # type: ignore[no-untyped-def]
    """Fill ``cells`` (R,C) with the index of the nearest of the members in each cell, -1 none."""
    cells[:] = -1
    for i in members:
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        nearest = cells[row, column]
        if nearest < 0 or _before(spherical, i, nearest):
            cells[row, column] = i


@inlined
def _first(cells, row, column, rows, columns):  # type: ignore[no-untyped-def]
    """Return the index of the point in the first filled cell at the given offsets, -1 none."""
    for k in range(len(rows)):
        r = row + rows[k]
        if 0 <= r < cells.shape[0]:
            point = cells[r, (column + columns[k]) % cells.shape[1]]
            if point >= 0:
                return point
    return -1


@inlined
def _slope(slope_a, slope_b, step, range_m):  # type: ignore[no-untyped-def]
    """Return the slope of inverse range per radian from its slopes on both sides (NaN: unknown)."""
    metres = step * range_m * range_m  # of range per step, by a unit of slope
    # On one surface the mean, else the lesser slope, or 0 if that is a step in depth; step in rad
    if abs(slope_a - slope_b) * metres <= _BEND_M + _BEND * abs(slope_a + slope_b) * metres:
        return 0.5 * (slope_a + slope_b)
    if not abs(slope_a) <= abs(slope_b):  # NaN too
        slope_a = slope_b
    return slope_a if abs(slope_a) * range_m <= _STEEP else 0.0


@inlined
def _change(spherical, i, j, axis, across, slope_across):  # type: ignore[no-untyped-def]
    """Return the change of inverse range per radian along axis 0 (azimuth) or 1, NaN unknown."""
    if j < 0:
        return np.nan
    apart = spherical[axis, j] - spherical[axis, i]
    if axis == 0:
        apart -= 2 * np.pi * np.rint(apart / (2 * np.pi))
    if abs(apart) < 1e-5:
        return np.nan
    # The change by the other angle is removed.
    beside = spherical[across, j] - spherical[across, i]
    return (1 / spherical[2, j] - 1 / spherical[2, i] - slope_across * beside) / apart


@inlined
def _put(i, spherical, table, slope_u, slope_v, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill in normal and spacing of point i from its slopes of inverse range per radian."""
    azimuth, elevation, range_m = spherical[0, i], spherical[1, i], spherical[2, i]
    across, along = _spacing(azimuth, elevation, table)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    # slope_u: along the azimuth, slope_v: along the elevation
    aside = slope_u / max(ce, 1e-3)
    normal[i, 0] = ce * ca / range_m - aside * sa - slope_v * se * ca
    normal[i, 1] = ce * sa / range_m + aside * ca - slope_v * se * sa
    normal[i, 2] = se / range_m + slope_v * ce
    spacing[i, 0] = range_m * across
    spacing[i, 1] = range_m * along


@Kernel
def _tangents_on_rings(first, last, members, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal (N,3) and spacing (N,2) of members from neighbours on the ring, above, below."""
    right, left = np.array([-2, -1, -3]), np.array([2, 1, 3])
    same = np.array([0, 0, 0])
    up, down = np.array([1, 1, 1, 2]), np.array([-1, -1, -1, -2])
    straight = np.array([0, 1, -1, 0])
    for k in range(first, last):
        i = members[k]
        across, along = _spacing(spherical[0, i], spherical[1, i], table)
        step = across / max(np.cos(spherical[1, i]), 1e-3)
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        slope_a = _change(spherical, i, _first(cells, row, column, same, right), 0, 1, 0.0)
        slope_b = _change(spherical, i, _first(cells, row, column, same, left), 0, 1, 0.0)
        slope_u = _slope(slope_a, slope_b, 2 * step, spherical[2, i])
        slope_u = 0.0 if np.isnan(slope_u) else slope_u
        above = _first(cells, row, column, up, straight)
        below = _first(cells, row, column, down, straight)
        slope_a = _change(spherical, i, above, 1, 0, slope_u)
        slope_b = _change(spherical, i, below, 1, 0, slope_u)
        slope_v = _slope(slope_a, slope_b, along, spherical[2, i])
        _put(i, spherical, table, slope_u, 0.0 if np.isnan(slope_v) else slope_v, normal, spacing)


@Kernel
def _tangents_anywhere(first, last, members, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal and spacing as `_tangents_on_rings`, for a scanner without rings."""
    num_rows, num_columns = cells.shape
    for k in range(first, last):
        i = members[k]
        range_m, flatten = spherical[2, i], np.cos(spherical[1, i])
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        spacing_rad = _spacing(spherical[0, i], spherical[1, i], table)[1]
        reach = min(1 + int(_AROUND * spacing_rad / grid.bin_rad), _MOST_CELLS)
        slope_u, slope_v = 0.0, 0.0
        for turn in range(2):  # a plane to the points around, then to those close to it
            uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
            num, num_kept = 0, 0
            for r in range(max(row - reach, 0), min(row + reach, num_rows - 1) + 1):
                for c in range(column - reach, column + reach + 1):
                    j = cells[r, c % num_columns]
                    if j < 0:
                        continue
                    u = spherical[0, j] - spherical[0, i]
                    u = (u - 2 * np.pi * np.rint(u / (2 * np.pi))) * flatten
                    v, w = spherical[1, j] - spherical[1, i], 1 / spherical[2, j] - 1 / range_m
                    if u == 0 and v == 0 and w == 0:
                        continue  # the point itself, or its equal
                    num += 1
                    off_m = abs(w - slope_u * u - slope_v * v) * range_m * range_m
                    if turn and off_m > _BEND_M + _BEND * abs(w) * range_m * range_m:
                        continue
                    num_kept += 1
                    uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
            ridge = _RIDGE * (uu + vv) + 1e-12
            slope_u, slope_v = slopes(uu + ridge, uv, vv + ridge, uw, vw)
            if 2 * num_kept < num:  # no plane: the patch faces the scanner
                slope_u, slope_v = 0.0, 0.0
        _put(i, spherical, table, slope_u * flatten, slope_v, normal, spacing)
