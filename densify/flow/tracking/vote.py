# SPDX-License-Identifier: MIT
"""Estimate the velocity of a cluster by a vote of the sweeps before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from densify.flow.tracking.candidates import LINK_M
from densify.geometry.clock import Clock
from densify.geometry.compiled import Kernel
from densify.geometry.nearest import bulk, nearest, tree_of
from densify.geometry.types import Float, Int

Bytes = NDArray[np.uint8]

MAX_SPEED_M_S = 38.0
_NEAR_S = 0.1  # time to the nearer batches; the others are twice as far
STEP_M = 0.2  # side of a voxel
_MOST_VOXELS = 1 << 28  # of a sweep, a byte each: 250 m x 250 m x 34 m
FEW_POINTS, _MANY_POINTS = 60, 600
_FINE_S, _FINE_M_S = 0.5, 0.2  # time span and velocity step of the last vote


@dataclass(frozen=True)
class DistanceField:
    """A voxel grid of the distance to the nearest candidate of a sweep."""

    nearness: Bytes  # (X,Y,Z) voxels of 0.2 m: 255 at a candidate, falling to 0 at 0.6 m from it
    low: Float  # (3,) corner of the grid, world
    tree: cKDTree | None  # search tree of the N candidates; None without candidates
    time_s: Float  # (N,) firing times of the candidates

    @staticmethod
    def of(points: Float, time_s: Float) -> DistanceField:
        """Build the field of N candidates from points (N,3, world) and firing times (N,)."""
        if not len(points):
            return DistanceField(np.zeros((1, 1, 1), np.uint8), np.zeros(3), None, time_s)
        inside = points[bulk(points, STEP_M, _MOST_VOXELS)]
        low = inside.min(0) - 2 * LINK_M
        shape = tuple(np.ceil((inside.max(0) + 2 * LINK_M - low) / STEP_M).astype(int) + 1)
        nearness = np.zeros(shape, np.uint8)
        n = int(np.ceil(LINK_M / STEP_M))
        span = np.arange(-n, n + 1)
        offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
        far = np.linalg.norm(offsets, axis=1) * STEP_M / LINK_M
        values = (255 - np.round(255 * far[far < 1])).astype(np.uint8)
        _spread(inside, low, STEP_M, offsets[far < 1], values, nearness)
        return DistanceField(nearness, low, tree_of(points), time_s)

    def raise_to(self, nearness: Bytes, group: Group, velocities: Float) -> None:
        """Raise ``nearness`` (V,N) to the nearness of the moved group to this sweep's candidates.

        Each of N points moves at each of the (V,3) velocities (m/s, world) to the time at which
        this sweep would measure the group. Nearness is 0 to 255.
        """
        if self.tree is None:
            return
        _, row = nearest(self.tree, group.middle[None])  # the firing time depends on the position
        moved = group.middle + (self.time_s[row] - group.middle_s) * velocities
        _, row = nearest(self.tree, moved)
        elapsed_s = self.time_s[row] - group.middle_s
        _look_up.over_rows(
            len(velocities),
            group.points,
            group.late_s,
            velocities,
            elapsed_s,
            self.low,
            1 / STEP_M,
            self.nearness,
            nearness,
        )


@dataclass(frozen=True)
class Group:
    """The N points of a cluster in one batch (consecutive sweeps within 0.1 s)."""

    points: Float  # (N,3) world
    late_s: Float  # (N,) firing times relative to ``middle_s``
    middle_s: float  # mean firing time of the points
    middle: Float  # (3,) mean of the points

    @staticmethod
    def of(points: Float, time_s: Float) -> Group:
        """Build the group from points (N,3, world) and their firing times (N,) in seconds."""
        middle_s = float(time_s.mean())
        return Group(points, time_s - middle_s, middle_s, points.mean(axis=0))

    def thinned(self, max_points: int) -> Group:
        """Return the group with at most ``max_points`` points, evenly chosen."""
        step = len(self.points) // max_points + 1
        points, late_s = (np.ascontiguousarray(a[::step]) for a in (self.points, self.late_s))
        return Group(points, late_s, self.middle_s, self.middle)


def vote(group: Group, n: int, fields: Sequence[Sequence[DistanceField]], clock: Clock) -> Float:
    """Return the horizontal velocity (3,) of a cluster, m/s, that the neighbouring sweeps support.

    At this velocity the group of batch n comes nearest to candidates of other batches. First the
    batches about 0.1 and 0.2 s before and after are compared, in coarse steps of velocity. A flat
    side shows its speed only at its ends, which move by less than a voxel in this short time.
    Therefore batches up to 0.5 s away are compared too, in fine steps. ``fields`` holds, for each
    batch, the distance fields of its sweeps.
    """
    near_s = clock.num_in(_NEAR_S) * clock.period_ns * 1e-9
    coarse_m_s = 2 * STEP_M / near_s
    near_fields = [fields[m] for m in _batches_around(n, near_s, clock)]
    all_fields = near_fields + [
        fields[m] for m in _batches_around(n, max(_FINE_S / 2, near_s), clock)
    ]
    rough_m_s = _best(
        group.thinned(FEW_POINTS), near_fields, _grid(int(MAX_SPEED_M_S / coarse_m_s)) * coarse_m_s
    )
    group = group.thinned(_MANY_POINTS)
    finer_m_s = _best(group, near_fields, rough_m_s + _grid(6) * coarse_m_s / 3)
    num = max(1, round(coarse_m_s / 3 / _FINE_M_S))
    return _best(group, all_fields, finer_m_s + _grid(num) * coarse_m_s / 3 / num)


def _batches_around(n: int, step_s: float, clock: Clock) -> list[int]:
    """Return the existing batches one and two steps of ``step_s`` before and after batch n."""
    asked = [clock.at(n, later_s) for later_s in (-2 * step_s, -step_s, step_s, 2 * step_s)]
    return sorted({m for m in asked if m is not None})


def _best(group: Group, around: Sequence[Sequence[DistanceField]], velocities: Float) -> Float:
    """Return the velocity (3,) among (V,3) that brings the group nearest to candidates."""
    cost = np.zeros(len(velocities))
    for batch in around:
        nearness = np.zeros((len(velocities), len(group.points)), np.uint8)
        for field in batch:
            field.raise_to(nearness, group, velocities)
        cost += 1 - nearness.mean(axis=1) / 255
    return np.asarray(velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))])


def _grid(n: int) -> Float:
    """Return all (V,3) horizontal steps with whole x and y from -n to n."""
    span = np.arange(-n, n + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


@Kernel
def _spread(
    points: Float, low: Float, step: float, offsets: Int, values: Bytes, grid: Bytes
) -> None:
    """Raise the cells of ``grid`` at ``offsets`` (K,3) from points (N,3) to ``values`` (K,)."""
    for i in range(len(points)):
        x, y, z = (
            int((points[i, 0] - low[0]) / step),
            int((points[i, 1] - low[1]) / step),
            int((points[i, 2] - low[2]) / step),
        )
        for k in range(len(offsets)):
            at = x + offsets[k, 0], y + offsets[k, 1], z + offsets[k, 2]
            grid[at] = max(grid[at], values[k])


@Kernel
def _look_up(
    first: int,
    last: int,
    points: Float,
    late_s: Float,
    velocities: Float,
    elapsed_s: Float,
    low: Float,
    cells_per_m: float,
    grid: Bytes,
    nearness: Bytes,
) -> None:
    """Raise ``nearness`` (V,N), in place, to the grid's at N points moved at V velocities."""
    num_x, num_y, num_z = grid.shape
    for v in range(first, last):
        for i in range(len(points)):
            moving_s = elapsed_s[v] - late_s[i]
            x = int((points[i, 0] + velocities[v, 0] * moving_s - low[0]) * cells_per_m)
            y = int((points[i, 1] + velocities[v, 1] * moving_s - low[1]) * cells_per_m)
            z = int((points[i, 2] + velocities[v, 2] * moving_s - low[2]) * cells_per_m)
            if 0 <= x < num_x and 0 <= y < num_y and 0 <= z < num_z:
                nearness[v, i] = max(nearness[v, i], grid[x, y, z])
