# SPDX-License-Identifier: MIT
"""Groups of points by distance, compiled: single linkage, and what is close to seeds; exact."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float, Int

# Rounding must neither part the points of a cell, whose diagonal is the distance, nor put what is
# closer than a cell's side three cells apart.
_WITHIN, _ABOVE = 1 - 1e-9, 1 + 1e-9
_MANY_CELLS = 1e18


def link(points: Float, distance_m: float) -> tuple[int, Int]:
    """(N,3) -> number of groups and (N,) label, numbered by the groups' first points: points closer
    than ``distance_m`` share one, wherever the origin lies and however the axes are turned.

    All points of a cell with that diagonal are linked, so that only cells are paired, and the cost
    does not grow with the square of the density.
    """
    if not len(points):
        return 0, np.zeros(0, np.int64)
    side_m = distance_m * _WITHIN / np.sqrt(3)
    cells = np.floor((points - points.min(axis=0)) / side_m).astype(np.int64)
    _, first, of_point = np.unique(_numbers(cells), return_index=True, return_inverse=True)
    cells = cells[first]
    # Points of cells farther apart than (2, 2, 1) are farther apart than the distance.
    pairs = cKDTree(cells).query_pairs(3.0 + 1e-9, output_type="ndarray")
    apart = np.abs(cells[pairs[:, 0]] - cells[pairs[:, 1]]).sum(axis=1)
    order = np.argsort(of_point, kind="stable")
    start = np.searchsorted(of_point[order], np.arange(len(cells) + 1))
    parent = np.arange(len(cells))
    nearest_first = pairs[np.argsort(apart, kind="stable")]
    _join(np.ascontiguousarray(points[order], float), start, nearest_first, distance_m**2, parent)
    _, first, label = np.unique(parent[of_point], return_index=True, return_inverse=True)
    renumbered = np.empty(len(first), np.int64)
    renumbered[np.argsort(first)] = np.arange(len(first))
    return len(first), renumbered[label]


def _numbers(cells: Int) -> Int:
    """(N,3), none negative -> (N,) one number for each cell, which sorts as its coordinates do."""
    if np.prod(cells.max(axis=0) + 1.0) > _MANY_CELLS:  # something lies very far away
        ranks = [np.unique(column, return_inverse=True)[1] for column in cells.T]
        cells = np.stack(ranks, axis=1)
    _, wide, high = cells.max(axis=0) + 1
    return np.asarray((cells[:, 0] * wide + cells[:, 1]) * high + cells[:, 2], np.int64)


def close_to_seeds(points: Float, seed: Bool, within_m: float, least_share: float) -> Bool:
    """Which of (N,3) points are closer than ``within_m`` to a seed that counts: one of (N,) of
    which at least so large a share of the points within that distance, itself one, are seeds."""
    close = np.zeros(len(points), bool)
    if not seed.any():
        return close
    cell = np.floor((points - points.min(axis=0)) / (_ABOVE * within_m)).astype(np.int64) + 1
    _, wide, high = cell.max(axis=0) + 2
    key = (cell[:, 0] * wide + cell[:, 1]) * high + cell[:, 2]
    order = np.argsort(key, kind="stable")
    key = key[order]
    start = np.append(np.flatnonzero(np.diff(key, prepend=-1)), len(key))
    cells = key[start[:-1]]
    # The cells around one, three above each other at a time.
    beside = np.array([x * wide + y for x in (-1, 0, 1) for y in (-1, 0, 1)]) * high
    below = start[np.searchsorted(cells, cells[:, None] + beside - 1)]
    above = start[np.searchsorted(cells, cells[:, None] + beside + 1, side="right")]
    sorted_points = np.ascontiguousarray(points[order], float)
    counts, close_in_order = np.zeros(len(points), bool), np.zeros(len(points), bool)
    ranges = start, np.stack([below, above], axis=2)
    _count_seeds(sorted_points, seed[order], *ranges, within_m**2, least_share, counts)
    _spread_seeds(sorted_points, counts, *ranges, within_m**2, close_in_order)
    close[order] = close_in_order
    return close


@inlined
def _squared(points, i, j):  # type: ignore[no-untyped-def]
    dx, dy, dz = (
        points[i, 0] - points[j, 0],
        points[i, 1] - points[j, 1],
        points[i, 2] - points[j, 2],
    )
    return dx * dx + dy * dy + dz * dz


@Kernel
def _count_seeds(points, seed, start, around, squared, least_share, counts):  # type: ignore[no-untyped-def]
    """counts: (N,) bool, set for the seeds that count. start: (C+1,) first point of each cell.
    around: (C,9,2) first and end of the points in and around it, three cells at a time."""
    for cell in range(len(start) - 1):
        for i in range(start[cell], start[cell + 1]):
            if not seed[i]:
                continue
            num, num_seeds = 0, 0
            for k in range(around.shape[1]):
                for j in range(around[cell, k, 0], around[cell, k, 1]):
                    near = _squared(points, i, j) <= squared
                    num += near
                    num_seeds += near & seed[j]
            counts[i] = num_seeds >= least_share * num


@Kernel
def _spread_seeds(points, counts, start, around, squared, close):  # type: ignore[no-untyped-def]
    """close: (N,) bool, set for the points closer to one that counts. The rest as in
    `_count_seeds`."""
    num_before = np.zeros(len(points) + 1, np.int64)
    for i in range(len(points)):
        num_before[i + 1] = num_before[i] + counts[i]
    for cell in range(len(start) - 1):
        for k in range(around.shape[1]):
            first, end = around[cell, k]
            if num_before[first] == num_before[end]:
                continue
            for i in range(start[cell], start[cell + 1]):
                close[i] |= counts[i]
                j = first
                while not close[i] and j < end:
                    close[i] = counts[j] and _squared(points, i, j) < squared
                    j += 1


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
