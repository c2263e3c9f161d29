# SPDX-License-Identifier: MIT
"""How fast a group of points moves, by the votes of the sweeps before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from densify.geometry.clock import Clock
from densify.geometry.clouds import look_up, spread
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Float

_MAX_SPEED_M_S = 38.0
_VOTE_NEAR_S = 0.1  # the nearer of the sweeps asked; the farther ones are twice as far
_VOTE_STEP_M = 0.2
_VOTE_REACH_M = 0.6
_VOTE_POINTS = 60
_TIMES_ASKED = 3  # when a sweep measures a place depends on where that is
_FINE_S, _FINE_M_S = 0.5, 0.2  # asked last, so far away and in such steps


@dataclass(frozen=True)
class DistanceField:
    """How near the nearest candidate of a sweep is on a voxel grid: 255 there, 0 beyond the reach.

    Zeros take no memory until something is written beside them; a field is mostly zeros.
    tree, time_s: the candidates, and when each was measured.
    """

    nearness: NDArray[np.uint8]
    low: Float
    tree: BoxTree | None
    time_s: Float

    @staticmethod
    def of(points: Float, time_s: Float) -> DistanceField:
        step, reach = _VOTE_STEP_M, _VOTE_REACH_M
        if not len(points):
            return DistanceField(np.zeros((1, 1, 1), np.uint8), np.zeros(3), None, time_s)
        low = points.min(0) - 2 * reach
        shape = tuple(np.ceil((points.max(0) + 2 * reach - low) / step).astype(int) + 1)
        nearness = np.zeros(shape, np.uint8)
        n = int(np.ceil(reach / step))
        span = np.arange(-n, n + 1)
        offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
        far = np.linalg.norm(offsets, axis=1) * step / reach
        values = (255 - np.round(255 * far[far < 1])).astype(np.uint8)
        spread(points, low, step, offsets[far < 1], values, nearness)
        return DistanceField(nearness, low, BoxTree(points), time_s)

    def raise_to(self, found: NDArray[np.uint8], group: Group, velocities: Float) -> None:
        """Raise ``found`` (V,N), in place, to how near the group's points come to the candidates
        with each of (V,3) velocities, when the sweep measures what is there."""
        if self.tree is None:
            return
        elapsed_s = np.zeros(len(velocities))
        for _ in range(_TIMES_ASKED):
            _, row = self.tree.nearest(group.middle + elapsed_s[:, None] * velocities)
            elapsed_s = self.time_s[row] - group.middle_s
        self.look_up(found, group.points, group.late_s, velocities, elapsed_s)

    def look_up(
        self,
        found: NDArray[np.uint8],
        points: Float,
        late_s: Float,
        velocities: Float,
        elapsed_s: Float,
    ) -> None:
        """The same of (N,3) points that have moved for ``elapsed_s`` (V,), ``late_s`` (N,) less."""
        look_up.over_rows(
            len(velocities),
            points,
            late_s,
            velocities,
            elapsed_s,
            self.low,
            1 / _VOTE_STEP_M,
            self.nearness,
            found,
        )


@dataclass(frozen=True)
class Group:
    """What one look saw of something: (N,3) world, when each point was measured after the mean of
    all (N,), that mean, and the middle of the points (3,)."""

    points: Float
    late_s: Float
    middle_s: float
    middle: Float

    @staticmethod
    def of(points: Float, time_s: Float) -> Group:
        middle_s = float(time_s.mean())
        return Group(points, time_s - middle_s, middle_s, points.mean(axis=0))

    def some(self, most: int) -> Group:
        """Some of the points, evenly; in a row, so that nothing is compiled for strides too."""
        step = len(self.points) // most + 1
        points, late_s = (np.ascontiguousarray(a[::step]) for a in (self.points, self.late_s))
        return replace(self, points=points, late_s=late_s)


def vote(group: Group, n: int, fields: Sequence[Sequence[DistanceField]], clock: Clock) -> Float:
    """(3,) m/s in the plane: where the group that look n saw is in four looks at once, about 0.1
    and 0.2 s before and after, or as near to that as the rate allows.

    fields: of the sweeps of each look. clock: of the looks.

    Along a flat side only its ends tell how fast it slides, by less than a voxel in so short a
    time, and aligned with what it covers it slides on as it was started. So they are asked again
    within 0.5 s. A scanner measures what passes it earlier or later in each turn: all points have
    times of their own.
    """
    near_s = clock.num_in(_VOTE_NEAR_S) * clock.period_ns * 1e-9
    coarse = 2 * _VOTE_STEP_M / near_s
    near = [fields[m] for m in _looks_around(n, near_s, clock)]
    both = near + [fields[m] for m in _looks_around(n, max(_FINE_S / 2, near_s), clock)]
    rough = _best(group.some(_VOTE_POINTS), near, grid(int(_MAX_SPEED_M_S / coarse)) * coarse)
    group = group.some(10 * _VOTE_POINTS)
    found = _best(group, near, rough + grid(6) * coarse / 3)
    num = max(1, round(coarse / 3 / _FINE_M_S))
    return _best(group, both, found + grid(num) * coarse / 3 / num)


def _looks_around(n: int, step_s: float, clock: Clock) -> list[int]:
    """The looks one and two steps before and after look n, as far as there are any."""
    asked = [clock.at(n, later_s) for later_s in (-2 * step_s, -step_s, step_s, 2 * step_s)]
    return sorted({m for m in asked if m is not None})


def _best(group: Group, around: Sequence[Sequence[DistanceField]], velocities: Float) -> Float:
    """Which of (V,3) m/s brings the group nearest to what these looks saw."""
    cost = np.zeros(len(velocities))
    for look in around:
        nearness = np.zeros((len(velocities), len(group.points)), np.uint8)
        for field in look:
            field.raise_to(nearness, group, velocities)
        cost += 1 - nearness.mean(axis=1) / 255
    return np.asarray(velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))])


def grid(n: int) -> Float:
    """(V,3) all steps in the plane of up to n along x and y."""
    span = np.arange(-n, n + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
