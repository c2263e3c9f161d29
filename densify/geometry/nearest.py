# SPDX-License-Identifier: MIT
"""Find nearest neighbours of points, thin points by a grid, and group them by distance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.compiled import Kernel, inlined


def tree_of(points: Float) -> cKDTree:
    """Return the k-d tree of points (M,d), optimised for fast construction and few queries."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest(tree: cKDTree, queries: Float, within_m: float = np.inf) -> tuple[Float, Int]:
    """Return distances (N,) from queries (N,d) to the nearest points of the tree, and their rows.

    A query without a point closer than ``within_m`` has the distance inf and the row -1.
    """
    distance_m, tree_row = tree.query(queries, distance_upper_bound=within_m)
    row = np.asarray(tree_row, np.int64)
    row[row == tree.n] = -1
    return np.asarray(distance_m), row


def nearest_k(tree: cKDTree, queries: Float, k: int) -> tuple[Float, Int]:
    """Return ascending distances (N,k) from queries (N,d) to the k nearest points, and the rows."""
    distance_m, row = tree.query(queries, np.arange(1, min(k, tree.n) + 1))
    return np.asarray(distance_m), np.asarray(row, np.int64)


def is_near(tree: cKDTree, queries: Float, within_m: float) -> Bool:
    """Return a mask (N,) of the queries (N,d) with a point of the tree closer than ``within_m``."""
    return np.isfinite(tree.query(queries, distance_upper_bound=within_m)[0])


def thinned(points: Float | Float32, order: Int, step: float, max_per_cell: int) -> Int:
    """Return the ascending rows of the points that stay after thinning by a grid.

    Args:
        points: (N,3) coordinates. The box around them has at most 2^63 / N cells.
        order: (K,) rows of the candidates, the preferred ones first.
        step: Side of a cell, in the unit of the points.
        max_per_cell: Greatest number of points that a cell keeps.
    """
    cell = np.zeros(len(points), np.int64)
    for coordinate in points.T:
        index = ((coordinate - coordinate.min(initial=np.inf)) / step).astype(np.int64)
        cell *= index.max(initial=0) + 1
        cell += index
    # Candidates are sorted by one number: the cell in its upper bits, the rank in its lower bits.
    rank_bits = len(order).bit_length()
    sorted_keys = np.sort((cell[order] << rank_bits) + np.arange(len(order)))
    sorted_cell = sorted_keys >> rank_bits
    rank = sorted_keys & ((1 << rank_bits) - 1)
    # A candidate is too many if the one max_per_cell before it is in the same cell.
    stays = np.ones(len(sorted_keys), bool)
    stays[max_per_cell:] = sorted_cell[max_per_cell:] != sorted_cell[:-max_per_cell]
    return np.sort(order[rank[stays]])


def bulk(points: NDArray[Any], cell: float, most_cells: int) -> Bool:
    """Return a mask of the points around which a grid fits into memory: (N,), True if kept.

    All points are kept if the box around them is small enough. Otherwise up to 1 % of them, the
    farthest from their median, are left out, such as a few stray returns. If the box is still too
    large, the points are spread out, and none is left out.

    Args:
        points: (N,D) coordinates.
        cell: Side of a cell of the grid, in the unit of the points.
        most_cells: Greatest number of cells.
    """
    all_points = np.ones(len(points), bool)
    if not len(points) or _num_cells(points, cell) <= most_cells:
        return all_points
    distance = np.abs(points - np.median(points, axis=0)).max(axis=1)
    for share in (0.9999, 0.999, 0.99):
        stays = distance <= np.quantile(distance, share)
        if _num_cells(points[stays], cell) <= most_cells:
            return stays
    return all_points


def _num_cells(points: NDArray[Any], cell: float) -> float:
    """Return the number of cells, not rounded, of the box around points (N,D)."""
    return math.prod(float(np.ptp(coordinate)) / cell + 1 for coordinate in points.T)


def link(points: Float, distance_m: float) -> tuple[int, Int]:
    """Group points by single linkage: points closer than ``distance_m`` share a group.

    The points are sorted into a grid whose cell diagonal equals the distance, hence all points of a
    cell are linked. Only neighbouring cells are compared, and the cost does not grow with the
    square of the point density.

    Args:
        points: (N,3) positions in metres.
        distance_m: Distance below which two points are linked.

    Returns:
        num_groups: Number of groups G.
        label: (N,) group of each point, 0 to G - 1, numbered by the first point of each group.
    """
    if not len(points):
        return 0, np.zeros(0, np.int64)
    side_m = distance_m / np.sqrt(3)
    cell = np.floor((points - points.min(axis=0)) / side_m).astype(np.int64)
    cells, cell_of_point = np.unique(cell, axis=0, return_inverse=True)
    cell_of_point = cell_of_point.ravel()

    # Pairs of cells, the nearest first, because these link most points. Points of cells (2, 2, 2)
    # apart are at least the distance apart. Cells (2, 2, 1) apart have length 3.
    pairs = cKDTree(cells).query_pairs(3.0 + 1e-9, output_type="ndarray")
    num_apart = np.abs(cells[pairs[:, 0]] - cells[pairs[:, 1]]).sum(axis=1)
    nearest_first = pairs[np.argsort(num_apart, kind="stable")]

    # Points in the order of their cells, and the row at which each cell begins
    order = np.argsort(cell_of_point, kind="stable")
    start = np.searchsorted(cell_of_point[order], np.arange(len(cells) + 1))
    root = np.arange(len(cells))
    _join(np.ascontiguousarray(points[order], float), start, nearest_first, distance_m**2, root)

    _, first_point, label = np.unique(root[cell_of_point], return_index=True, return_inverse=True)
    renumbered = np.empty(len(first_point), np.int64)
    renumbered[np.argsort(first_point)] = np.arange(len(first_point))
    return len(first_point), renumbered[label]


def close_to_seeds(points: Float, seed: Bool, within_m: float, least_share: float) -> Bool:
    """Return a mask (N,), True for points closer than ``within_m`` to a dense seed.

    Args:
        points: (N,3) positions in metres.
        seed: (N,) True for seeds.
        within_m: Radius around a seed.
        least_share: Least share of seeds among the points around a dense seed.
    """
    is_close = np.zeros(len(points), bool)
    if not seed.any():
        return is_close
    low, high = points[seed].min(axis=0) - within_m, points[seed].max(axis=0) + within_m
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    # Points are sorted by cells as large as the radius, numbered along z first: the cells around a
    # seed are nine ranges of points. A border of empty cells keeps columns apart.
    cell = ((points[rows] - low) / within_m).astype(np.int64) + 1
    shape = cell.max(axis=0) + 2
    number = np.ravel_multi_index(tuple(cell.T), tuple(shape))
    order = np.argsort(number, kind="stable")
    rows, number = rows[order], number[order]
    columns = shape[2] * np.array([x * shape[1] + y for x in (-1, 0, 1) for y in (-1, 0, 1)])
    column = number[seed[rows]][:, None] + columns
    begin = np.searchsorted(number, column - 1)
    end = np.searchsorted(number, column + 1, side="right")
    is_close_in_order = np.zeros(len(rows), bool)
    _mark_around_dense_seeds(
        points[rows], seed[rows], begin, end, within_m**2, least_share, is_close_in_order
    )
    is_close[rows] = is_close_in_order
    return is_close


@Kernel
def _mark_around_dense_seeds(points, seed, begin, end, within_m2, least_share, is_close):  # type: ignore[no-untyped-def]
    """Mark points (N,3) around dense seeds; seed s is compared with its ranges (S,9) of points."""
    s = -1
    for i in range(len(points)):
        if not seed[i]:
            continue
        s += 1
        num_points = num_seeds = 0
        for r in range(begin.shape[1]):
            for k in range(begin[s, r], end[s, r]):
                is_around = _squared_m2(points, i, k) <= within_m2
                num_points += is_around
                num_seeds += is_around & seed[k]
        if num_seeds >= least_share * num_points:
            for r in range(begin.shape[1]):
                for k in range(begin[s, r], end[s, r]):
                    is_close[k] |= _squared_m2(points, i, k) < within_m2


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
            if _squared_m2(points, i, j) < distance_m2:
                return True
    return False


@inlined
def _squared_m2(points: Float, i: int, j: int) -> float:
    """Return the squared distance between rows i and j of points (N,3)."""
    dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
    dz = points[i, 2] - points[j, 2]
    return dx * dx + dy * dy + dz * dz
