# SPDX-License-Identifier: MIT
"""Random numbers that belong to places, compiled: see `densify.street.materials`."""

from __future__ import annotations

import numpy as np

from densify.geometry.arrays import Float, Int
from densify.geometry.compiled import Kernel, inlined

_ALONG, _ACROSS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)
_MIX = np.uint64(0xBF58476D1CE4E5B9)
_FAR, _NEAR, _SPARE = np.uint64(32), np.uint64(29), np.uint64(11)


@inlined
def _number(i, j):  # type: ignore[no-untyped-def]
    h = (np.uint64(i) * _ALONG) ^ (np.uint64(j) * _ACROSS)
    h ^= h >> _NEAR
    h *= _MIX
    h ^= h >> _FAR
    return (h >> _SPARE) / 2.0**53


@Kernel
def of_cells(cell: Int, number: Float) -> None:
    """number: (N,), filled: in [0, 1), of each cell (N,2)."""
    for n in range(len(cell)):
        number[n] = _number(cell[n, 0], cell[n, 1])


@Kernel
def between_cells(uv: Float, cell_m: float, number: Float) -> None:
    """number: (N,), filled: in [0, 1), smooth over cells of that size, at uv (N,2)."""
    for n in range(len(uv)):
        x, y = uv[n, 0] / cell_m, uv[n, 1] / cell_m
        i, j = np.int64(np.floor(x)), np.int64(np.floor(y))
        x, y = x - i, y - j
        x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
        low, high = _number(i, j), _number(i, j + 1)
        low += (_number(i + 1, j) - low) * x
        high += (_number(i + 1, j + 1) - high) * x
        number[n] = low + (high - low) * y
