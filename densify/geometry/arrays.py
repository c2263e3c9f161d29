# SPDX-License-Identifier: MIT
"""Name the array types used everywhere, and make tables of columns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

_SHARES = (0.9999, 0.999, 0.99)  # of the points that stay in a grid


def table(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return an (M,) structured array of (M,) columns, by field name, without padding."""
    rows = np.empty(
        len(next(iter(columns.values()))), [(name, c.dtype) for name, c in columns.items()]
    )
    for name, column in columns.items():
        rows[name] = column
    return rows


def bulk(points: NDArray[Any], cell: float, most_cells: int) -> Bool:
    """Return (N,) True for the points (N,D) around which a grid fits into memory.

    These are all points if the box around them has at most ``most_cells`` cells of side ``cell``.
    Otherwise up to 1 % of them, the farthest from their median, are left out, such as a few stray
    returns. If their box is still too large, the points are spread out, and none is left out.
    """
    all_points = np.ones(len(points), bool)
    if not len(points) or _num_cells(points, cell) <= most_cells:
        return all_points
    distance = np.abs(points - np.median(points, axis=0)).max(axis=1)
    for share in _SHARES:
        kept = distance <= np.quantile(distance, share)
        if _num_cells(points[kept], cell) <= most_cells:
            return kept
    return all_points


def _num_cells(points: NDArray[Any], cell: float) -> float:
    return math.prod(float(np.ptp(coordinate)) / cell + 1 for coordinate in points.T)
