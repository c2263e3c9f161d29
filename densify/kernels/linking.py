# SPDX-License-Identifier: MIT
"""Groups of points linked by distance, compiled: single linkage, exact."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.kernels import Kernel, inlined
from densify.types import Float, Int

_WITHIN = 1 - 1e-9  # a cell's points must be linked even where rounding makes its diagonal longer


def link(points: Float, distance_m: float) -> tuple[int, Int]:
    """(N,3) -> number of groups and (N,) label, numbered by the groups' first points: points closer
    than ``distance_m`` share one, wherever the origin lies and however the axes are turned.

    All points of a cell with that diagonal are linked, so that only cells are paired, and the cost
    does not grow with the square of the density.
    """
    if not len(points):
        return 0, np.zeros(0, np.int64)
    side_m = distance_m * _WITHIN / np.sqrt(3)
    cells = np.floor((points - points.min(axis=0)) / side_m)
    cells, of_point = np.unique(cells, axis=0, return_inverse=True)
    of_point = of_point.ravel()
    # Points of cells farther apart than (2, 2, 1) are farther apart than the distance.
    pairs = cKDTree(cells).query_pairs(3.0 + 1e-9, output_type="ndarray")
    apart = np.abs(cells[pairs[:, 0]] - cells[pairs[:, 1]]).sum(axis=1)
    order = np.argsort(of_point, kind="stable")
    start = np.searchsorted(of_point[order], np.arange(len(cells) + 1))
    parent = np.arange(len(cells))
    nearest_first = pairs[np.argsort(apart, kind="stable")]
    _join(np.ascontiguousarray(points[order], float), start, nearest_first, distance_m**2, parent)
    _, first, label = np.unique(parent[of_point], return_index=True, return_inverse=True)
    number = np.empty(len(first), np.int64)
    number[np.argsort(first)] = np.arange(len(first))
    return len(first), number[label.ravel()]


@Kernel
def _join(points: Float, start: Int, pairs: Int, squared: float, parent: Int) -> None:
    """Give the cells whose points are linked one root in ``parent`` (C,), each its own at first.

    points: (N,3) by cell, those of cell c from ``start[c]`` to ``start[c + 1]``. pairs: (P,2) of
    cells that may be linked. squared: of the distance.
    """
    for k in range(len(pairs)):
        a, b = _root(parent, pairs[k, 0]), _root(parent, pairs[k, 1])
        if a != b and _touch(points, start, pairs[k, 0], pairs[k, 1], squared):
            parent[max(a, b)] = min(a, b)
    for c in range(len(parent)):
        parent[c] = _root(parent, c)


@inlined
def _root(parent: Int, cell: int) -> int:
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@inlined
def _touch(points: Float, start: Int, one: int, other: int, squared: float) -> bool:
    """Whether two points of the cells are closer than the distance."""
    for i in range(start[one], start[one + 1]):
        for j in range(start[other], start[other + 1]):
            dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            dz = points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz < squared:
                return True
    return False
