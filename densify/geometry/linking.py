# SPDX-License-Identifier: MIT
"""Group points by single linkage, and find the points close to dense seeds; both exact."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.nearest import is_near, tree_of
from densify.geometry.types import Bool, Float, Int


def link(points: Float, distance_m: float) -> tuple[int, Int]:
    """Return groups of points by single linkage: points closer than ``distance_m`` share a group.

    The points (N,3) are sorted into a grid whose cell diagonal equals the distance, hence all
    points of a cell are linked. Only neighbouring cells are compared, and the cost does not grow
    with the square of the point density. Returns the number of groups G, and (N,) group labels 0 to
    G - 1, numbered by the first point of each group.
    """
    if not len(points):
        return 0, np.zeros(0, np.int64)
    side_m = distance_m / np.sqrt(3)
    cell = np.floor((points - points.min(axis=0)) / side_m).astype(np.int64)
    cells, cell_of_point = np.unique(cell, axis=0, return_inverse=True)
    cell_of_point = cell_of_point.ravel()
    # Points of cells farther apart than (2, 2, 1) are farther apart than the distance.
    pairs = cKDTree(cells).query_pairs(3.0 + 1e-9, output_type="ndarray")
    num_apart = np.abs(cells[pairs[:, 0]] - cells[pairs[:, 1]]).sum(axis=1)
    order = np.argsort(cell_of_point, kind="stable")
    start = np.searchsorted(cell_of_point[order], np.arange(len(cells) + 1))
    parent = np.arange(len(cells))
    nearest_first = pairs[np.argsort(num_apart, kind="stable")]
    _join(np.ascontiguousarray(points[order], float), start, nearest_first, distance_m**2, parent)
    _, first, label = np.unique(parent[cell_of_point], return_index=True, return_inverse=True)
    renumbered = np.empty(len(first), np.int64)
    renumbered[np.argsort(first)] = np.arange(len(first))
    return len(first), renumbered[label]


def close_to_seeds(points: Float, seed: Bool, within_m: float, least_share: float) -> Bool:
    """Return (N,) True for the points (N,3) closer than ``within_m`` to a dense seed.

    A seed, of the mask ``seed`` (N,), is dense if at least ``least_share`` of the points within
    ``within_m`` of it are seeds.
    """
    close, seeds = np.zeros(len(points), bool), points[seed]
    if not len(seeds):
        return close
    near_rows = np.flatnonzero(is_near(tree_of(seeds), points, within_m))
    num_points, num_seeds = (
        tree_of(cloud).query_ball_point(seeds, within_m, return_length=True)
        for cloud in (points[near_rows], seeds)
    )
    dense = seeds[num_seeds >= least_share * num_points]
    if len(dense):
        close[near_rows] = is_near(tree_of(dense), points[near_rows], within_m)
    return close


@Kernel
def _join(points: Float, start: Int, pairs: Int, distance_m2: float, parent: Int) -> None:
    """Link the cells of ``pairs`` that have two points closer than the distance, by union-find."""
    # Cell c owns the points start[c] to start[c + 1] - 1, and parent[c] becomes its root.
    for k in range(len(pairs)):
        a, b = _root(parent, pairs[k, 0]), _root(parent, pairs[k, 1])
        if a != b and _touch(points, start, pairs[k, 0], pairs[k, 1], distance_m2):
            parent[max(a, b)] = min(a, b)
    for c in range(len(parent)):
        parent[c] = _root(parent, c)


@inlined
def _root(parent: Int, cell: int) -> int:
    """Return the root of a cell, and shorten the path to it in ``parent``."""
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@inlined
def _touch(points: Float, start: Int, cell_a: int, cell_b: int, distance_m2: float) -> bool:
    """Return True if two points, one of each cell, are closer than the root of ``distance_m2``."""
    for i in range(start[cell_a], start[cell_a + 1]):
        for j in range(start[cell_b], start[cell_b + 1]):
            dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            dz = points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz < distance_m2:
                return True
    return False
