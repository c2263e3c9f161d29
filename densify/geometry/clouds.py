# SPDX-License-Identifier: MIT
"""Clouds thinned to a number of points in each cell of a grid."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel
from densify.geometry.types import Float, Float32, Int


def thinned(points: Float | Float32, order: Int, step: float, most: int) -> Int:
    """The rows, ascending, of (N,3) points that are left if each cell of a grid keeps the first
    ``most`` of its points in that ``order``.

    step: side of a cell. Rows that are not in the order are left out.
    """
    size = 1 << max(4, int(2 * len(points)).bit_length())
    cells, counts = np.full(size, -1, np.int64), np.zeros(size, np.uint8)
    keep = np.zeros(len(points), bool)
    if len(points):
        low = points.min(axis=0).astype(np.float64)
        _thin(points, order, low, step, most, cells, counts, keep)
    return np.flatnonzero(keep)


@Kernel
def _thin(points, order, low, step, most, cells, counts, keep):  # type: ignore[no-untyped-def]
    """cells, counts: a table of 2^k places, by open addressing."""
    mask = len(cells) - 1
    for i in order:
        x = int((points[i, 0] - low[0]) / step)
        y = int((points[i, 1] - low[1]) / step)
        z = int((points[i, 2] - low[2]) / step)
        cell = (x << 42) | (y << 21) | z
        at = (cell ^ (cell >> 29)) * np.int64(-7046029254386353131)
        at = (at ^ (at >> 32)) & mask
        while cells[at] != cell and cells[at] >= 0:
            at = (at + 1) & mask
        cells[at] = cell
        if counts[at] < most:
            counts[at] += 1
            keep[i] = True
