# SPDX-License-Identifier: MIT
"""The lidar's speed at the start of a recording, searched in the first sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Sweep

MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
_STEP_M, _STEP_S = 0.5, 0.1  # of the search; in a shorter time smaller in proportion
_NUM_POINTS = 800
_CLOSE_M = 1.0
_RAYS_RAD = 0.01  # between rays: objects along the road are met by the same rays at any speed
_ABOVE_GROUND_M = 0.4


def search_twist(sweeps: Sequence[Sweep]) -> Float:
    """Return the (6,) twist per second at the start, without rotation, by a grid search.

    The velocity is the one that best aligns the points above the ground in the first three sweeps.
    Distances below the gap between rays count as none: a guard rail looks the same from a vehicle
    at rest and from one that follows it. The grid moves the second sweep by steps of 1 m, then of
    0.5 m around the best, or less where the sweeps follow within 0.1 s.
    """
    first_s = (sweeps[1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
    step_m = _STEP_M * min(1.0, first_s / _STEP_S)
    above = [above_ground(s.points) for s in sweeps[:3]]
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(above)):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _NUM_POINTS + 1]]
        ratio = (sweeps[i + 1].stamp_ns - sweeps[i].stamp_ns) * 1e-9 / first_s
        apart_m = _RAYS_RAD * np.linalg.norm(sample, axis=1)
        pairs.append((tree_of(earlier), sample, ratio, apart_m))

    def cost(steps_m: Float) -> Float:
        sums = 1e-3 * np.linalg.norm(steps_m, axis=1)
        for tree, sample, ratio, apart_m in pairs:
            moved = (sample + ratio * steps_m[:, None, :]).reshape(-1, 3)
            distance_m, _ = tree.query(moved, distance_upper_bound=_CLOSE_M, workers=-1)
            distance_m = np.minimum(distance_m, _CLOSE_M).reshape(len(steps_m), -1)
            sums += np.maximum(distance_m - apart_m, 0.0).mean(1)
        return sums

    coarse_m = _grid(np.zeros(2), MAX_SPEED_M_S * first_s, 2 * step_m)
    coarse = coarse_m[np.argmin(cost(coarse_m))]
    fine_m = _grid(coarse[:2], 2 * step_m, step_m)
    return np.append(np.zeros(3), fine_m[np.argmin(cost(fine_m))] / first_s)


def _grid(center: Float, reach_m: float, step_m: float) -> Float:
    """Return (n,3) horizontal motions around a center (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(center[0] + span, center[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def above_ground(points: Float) -> Float:
    """Return the points above the lowest of their 1 m cell: the ground's rings hide the motion."""
    if not len(points):
        return points
    x, y, z = points.T
    row, column = (np.floor(along).astype(np.int64) for along in (x, y))
    row, column = row - row.min(), column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    above = points.take(np.flatnonzero(z > lowest[cell] + _ABOVE_GROUND_M), axis=0)
    return above if len(above) else points
