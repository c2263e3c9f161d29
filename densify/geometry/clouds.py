# SPDX-License-Identifier: MIT
"""Clouds thinned to a number of points in each cell of a grid."""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float, Float32, Int


def thinned(points: Float | Float32, order: Int, step: float, most: int) -> Int:
    """The rows, ascending, of (N,3) points that are left if each cell of a grid keeps the first
    ``most`` of its points in that ``order``.

    step: side of a cell. Rows that are not in the order are left out.
    """
    low = points.min(axis=0, initial=np.inf).astype(np.float64)
    cell = ((points.take(order, axis=0) - low) / step).astype(np.int64)
    _, cell = np.unique(cell @ [1 << 42, 1 << 21, 1], return_inverse=True)
    by_cell = np.argsort(cell, kind="stable")
    start = np.append(0, np.cumsum(np.bincount(cell)))[cell[by_cell]]
    first = by_cell[np.arange(len(by_cell)) - start < most]
    return np.sort(order[first])
