# SPDX-License-Identifier: MIT
"""Find nearest neighbours by SciPy's k-d tree, and thin point clouds by a grid."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry.types import Bool, Float, Float32, Int


def tree_of(points: Float) -> cKDTree:
    """Return the k-d tree of (M,d) points, optimised for fast construction and few queries."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest(tree: cKDTree, queries: Float, within_m: float = np.inf) -> tuple[Float, Int]:
    """Return (N,) distances to the nearest points of the tree, and (N,) rows of these points.

    They are inf and -1 for a query (N,d) without a point closer than ``within_m``.
    """
    distance_m, tree_row = tree.query(queries, distance_upper_bound=within_m)
    row = np.asarray(tree_row, np.int64)
    row[row == tree.n] = -1
    return np.asarray(distance_m), row


def nearest_k(tree: cKDTree, queries: Float, k: int) -> tuple[Float, Int]:
    """Return (N,k) ascending distances to the k nearest points (or all), and their rows."""
    distance_m, row = tree.query(queries, np.arange(1, min(k, tree.n) + 1))
    return np.asarray(distance_m), np.asarray(row, np.int64)


def is_near(tree: cKDTree, queries: Float, within_m: float) -> Bool:
    """Return (N,) True for (N,d) queries with a point of the tree closer than ``within_m``."""
    return np.isfinite(tree.query(queries, distance_upper_bound=within_m)[0])


def thinned(points: Float | Float32, order: Int, step: float, max_per_cell: int) -> Int:
    """Thin points (N,3) by a grid, and return the rows of the points that are kept, ascending.

    The rows ``order`` (K,) are the candidates, the preferred ones first. Each cell of side ``step``
    keeps up to ``max_per_cell`` of them. The box around the points has at most 2^63 / N cells.
    """
    cell = np.zeros(len(points), np.int64)
    for x in points.T:
        index = ((x - x.min(initial=np.inf)) / step).astype(np.int64)
        cell *= index.max(initial=0) + 1
        cell += index
    bits = len(order).bit_length()  # the lower bits say the place in the order
    ranked = np.sort((cell[order] << bits) + np.arange(len(order)))
    cell, kept = ranked >> bits, np.ones(len(ranked), bool)
    kept[max_per_cell:] = cell[max_per_cell:] != cell[:-max_per_cell]
    return np.sort(order[ranked[kept] & ((1 << bits) - 1)])
