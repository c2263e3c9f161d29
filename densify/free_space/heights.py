# SPDX-License-Identifier: MIT
"""Grids of heights, compiled: see `densify.free_space.height_map`."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Float, Int


@inlined
def _cell(points, i, low_m, cell_m):  # type: ignore[no-untyped-def]
    return int((points[i, 0] - low_m[0]) / cell_m), int((points[i, 1] - low_m[1]) / cell_m)


@Kernel
def two_lowest(points: Float, low_m: Float, cell_m: float, lowest: Float, second: Float) -> None:
    """Lower the two lowest different heights of each cell to those of the points, in place.

    points: (N,3), none outside the grid. low_m: (2,) the grid's corner. lowest, second: (X,Y), inf
    where there is none.
    """
    for i in range(len(points)):
        x, y = _cell(points, i, low_m, cell_m)
        z = points[i, 2]
        if z < lowest[x, y]:
            lowest[x, y], second[x, y] = z, lowest[x, y]
        elif lowest[x, y] < z < second[x, y]:
            second[x, y] = z


@Kernel
def heights_under(
    first: int,
    last: int,
    points: Float,
    low_m: Float,
    cell_m: float,
    heights_m: Float,
    ground_m: Float,
) -> None:
    """ground_m: (N,), filled: the heights (X,Y) of the cells' centres, linear between them, at the
    points (N,2) or (N,3); beyond the grid as at its edge. The rest as in `two_lowest`."""
    end_x, end_y = heights_m.shape[0] - 1, heights_m.shape[1] - 1
    for i in range(first, last):
        x = min(max((points[i, 0] - low_m[0]) / cell_m - 0.5, 0.0), float(end_x))
        y = min(max((points[i, 1] - low_m[1]) / cell_m - 0.5, 0.0), float(end_y))
        left, near = int(x), int(y)
        right, far = min(left + 1, end_x), min(near + 1, end_y)
        x, y = x - left, y - near
        ground_m[i] = (
            heights_m[left, near] * (1 - x) * (1 - y)
            + heights_m[left, far] * (1 - x) * y
            + heights_m[right, near] * x * (1 - y)
            + heights_m[right, far] * x * y
        )


@Kernel
def add_near(
    points: Float,
    over_m: Float,
    within_m: float,
    low_m: Float,
    cell_m: float,
    number: Int,
    total_m: Float,
) -> None:
    """Count, and add up, in place, the heights (N,) ``over_m`` within ``within_m`` of 0, by cell.

    number, total_m: (X,Y). The rest as in `two_lowest`.
    """
    for i in range(len(points)):
        if np.abs(over_m[i]) < within_m:
            x, y = _cell(points, i, low_m, cell_m)
            number[x, y] += 1
            total_m[x, y] += over_m[i]
