# SPDX-License-Identifier: MIT
"""Which points of a cloud a page shows, and in which order they pack well."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Int

_NEAREST_M = 4.0  # within which points are not kept more closely
_FINEST, _COARSEST = 1e-4, 0.5
_NUM_HALVINGS = 10
_TABLE_BITS = 25
_SEED = 0


def thinned(points: Float, moving: Bool, most: int) -> Int:
    """Rows (K,) of at most so many points, ascending: what moves, and of the rest those that look
    apart from the key's place.

    points: (M,3) key frame. moving: (M,). What stands is cut into cells of equal angle, as deep as
    they are wide, and of each one point is kept, whichever comes first by chance (the same chance
    every time). Points on moving things have the room that the others leave, but at least half of
    it.
    """
    if len(points) <= most:
        return np.arange(len(points))
    order = np.random.default_rng(_SEED).permutation(len(points))
    movers, rest = order[moving[order]], order[~moving[order]]
    movers = movers[: max(most // 2, most - len(rest))]
    rest = rest[_apart(points[rest], most - len(movers))]
    return np.sort(np.concatenate([movers, rest]))


def in_space_order(levels: NDArray[np.uint16]) -> Int:
    """(M,) order of (M,3) quantised places in which neighbours follow each other (Morton 1966)."""
    code = np.zeros(len(levels), np.uint64)
    for axis in range(3):
        spread = levels[:, axis].astype(np.uint64)
        for shift, mask in (
            (16, 0x0000FF0000FF),
            (8, 0x00F00F00F00F),
            (4, 0x0C30C30C30C3),
            (2, 0x249249249249),
        ):
            spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
        code |= spread << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _apart(points: Float, most: int) -> Int:
    """Rows of at most so many points in different cells, the smallest cells that allow it."""
    if len(points) <= most:
        return np.arange(len(points))
    points = points.astype(np.float32)
    distance_m = np.maximum(np.linalg.norm(points, axis=1), np.float32(1e-6))
    places = np.stack(
        [
            np.arctan2(points[:, 1], points[:, 0]),
            np.arcsin(points[:, 2] / distance_m),
            np.log(np.maximum(distance_m, _NEAREST_M)),
        ],
        axis=1,
    )
    finest, coarsest = _FINEST, _COARSEST
    for _ in range(_NUM_HALVINGS):
        step = np.sqrt(finest * coarsest)
        if _num_cells(_cells(places, float(step))) > most:
            finest = step
        else:
            coarsest = step
    _, first = np.unique(_cells(places, coarsest), return_index=True)
    return np.sort(first)[:most]


def _cells(places: Float, step: float) -> Int:
    numbers = np.floor(places / step).astype(np.int64) + (1 << 19)
    return (numbers[:, 0] << 42) | (numbers[:, 1] << 21) | numbers[:, 2]


def _num_cells(cells: Int) -> int:
    """About how many differ, much faster than by sorting them."""
    taken = np.zeros(1 << _TABLE_BITS, bool)
    multiplied = cells.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    taken[multiplied >> np.uint64(64 - _TABLE_BITS)] = True
    return int(np.count_nonzero(taken))
