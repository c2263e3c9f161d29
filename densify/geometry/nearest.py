# SPDX-License-Identifier: MIT
"""Find nearest neighbours by SciPy's tree, and thin clouds by a grid."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry.types import Bool, Float, Float32, Int


def tree_of(points: Float) -> cKDTree:
    """Return the tree of (M,d) points, built fast for few searches."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest(tree: cKDTree, queries: Float, within_m: float = np.inf) -> tuple[Float, Int]:
    """Return (N,) distances to the nearest point and (N,) its row.

    Beyond ``within_m`` they are inf and -1.

    Args:
        queries: (N,d).
    """
    distance_m, row = tree.query(queries, distance_upper_bound=within_m)
    distance_m = np.asarray(distance_m)
    return distance_m, np.where(np.isfinite(distance_m), row, -1).astype(np.int64)


def nearest_k(tree: cKDTree, queries: Float, k: int) -> tuple[Float, Int]:
    """Return (N,k) distances to the nearest points, nearest first, and (N,k) their rows.

    Args:
        queries: (N,d).
        k: Is cut to the number of points.
    """
    distance_m, row = tree.query(queries, np.arange(1, min(k, tree.n) + 1))
    return np.asarray(distance_m), np.asarray(row, np.int64)


def is_near(tree: cKDTree, queries: Float, within_m: float) -> Bool:
    """Return (N,) True for the (N,d) queries closer to a point than ``within_m``."""
    return np.isfinite(tree.query(queries, distance_upper_bound=within_m)[0])


def thinned(points: Float | Float32, order: Int, step: float, most: int) -> Int:
    """Return the rows, ascending, of (N,3) points after thinning by a grid.

    Each cell keeps the first ``most`` of its points.

    Args:
        order: Rows in the order of preference. Other rows are dropped.
        step: Side of a cell.
    """
    low = points.min(axis=0, initial=np.inf).astype(np.float64)
    cell = ((points.take(order, axis=0) - low) / step).astype(np.int64)
    _, cell = np.unique(cell @ [1 << 42, 1 << 21, 1], return_inverse=True)
    by_cell = np.argsort(cell, kind="stable")
    start = np.append(0, np.cumsum(np.bincount(cell)))[cell[by_cell]]
    first = by_cell[np.arange(len(by_cell)) - start < most]
    return np.sort(order[first])
