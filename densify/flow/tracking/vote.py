# SPDX-License-Identifier: MIT
"""How fast a group of points moves, by the votes of the sweeps before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from densify.clock import Clock
from densify.kernels.clouds import missed, spread
from densify.types import Float

_MAX_SPEED_M_S = 38.0
_VOTE_NEAR_S = 0.1  # the nearer of the sweeps asked; the farther ones are twice as far
_VOTE_STEP_M = 0.2
_VOTE_REACH_M = 0.6
_VOTE_POINTS = 60
_FINE_S, _FINE_M_S = 0.5, 0.2  # asked last, so far away and in such steps


@dataclass(frozen=True)
class DistanceField:
    """How near the nearest candidate is on a voxel grid: 255 there, 0 beyond the reach.

    Zeros take no memory until something is written beside them; a field is mostly zeros.
    """

    nearness: NDArray[np.uint8]
    low: Float

    @staticmethod
    def of(points: Float) -> DistanceField:
        step, reach = _VOTE_STEP_M, _VOTE_REACH_M
        if not len(points):
            return DistanceField(np.zeros((1, 1, 1), np.uint8), np.zeros(3))
        low = points.min(0) - 2 * reach
        shape = tuple(np.ceil((points.max(0) + 2 * reach - low) / step).astype(int) + 1)
        nearness = np.zeros(shape, np.uint8)
        n = int(np.ceil(reach / step))
        span = np.arange(-n, n + 1)
        offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
        far = np.linalg.norm(offsets, axis=1) * step / reach
        values = (255 - np.round(255 * far[far < 1])).astype(np.uint8)
        spread(points, low, step, offsets[far < 1], values, nearness)
        return DistanceField(nearness, low)

    def __call__(self, points: Float, shifts: Float) -> Float:
        """(N,3), (V,3) metres -> (V,) mean distance of the points, moved by each of the shifts, to
        the nearest candidate, as a share of the reach."""
        mean = np.empty(len(shifts))
        missed.over_rows(
            len(shifts), points, shifts, self.low, 1 / _VOTE_STEP_M, self.nearness, mean
        )
        return mean / 255


def vote(points: Float, i: int, fields: Sequence[DistanceField], clock: Clock) -> Float:
    """(3,) m/s in the plane: where the group that sweep i saw is in four sweeps at once, about 0.1
    and 0.2 s before and after, or as near to that as the rate allows.

    Along a flat side only its ends tell how fast it slides, by less than a voxel in so short a
    time, and aligned with what it covers it slides on as it was started. So they are asked again
    within 0.5 s.
    """
    near_s = clock.num_in(_VOTE_NEAR_S) * clock.period_ns * 1e-9
    coarse = 2 * _VOTE_STEP_M / near_s
    near = _sweeps_around(i, near_s, clock)
    n = int(_MAX_SPEED_M_S / coarse)
    rough = _best(points, i, fields, clock, near, _grid(n) * coarse, _VOTE_POINTS)
    finer = rough + _grid(6) * coarse / 3
    found = _best(points, i, fields, clock, near, finer, 10 * _VOTE_POINTS)
    n = max(1, round(coarse / 3 / _FINE_M_S))
    finest = found + _grid(n) * coarse / 3 / n
    both = near + _sweeps_around(i, max(_FINE_S / 2, near_s), clock)
    return _best(points, i, fields, clock, both, finest, 10 * _VOTE_POINTS)


def _sweeps_around(i: int, step_s: float, clock: Clock) -> list[int]:
    """The sweeps one and two steps before and after sweep i, as far as there are any."""
    asked = [clock.at(i, later_s) for later_s in (-2 * step_s, -step_s, step_s, 2 * step_s)]
    return sorted({j for j in asked if j is not None})


def _best(
    points: Float,
    i: int,
    fields: Sequence[DistanceField],
    clock: Clock,
    around: Sequence[int],
    velocities: Float,
    num_points: int,
) -> Float:
    """Which of (V,3) m/s brings some of the points nearest to what these sweeps saw."""
    sample = points[:: len(points) // num_points + 1]
    cost = np.zeros(len(velocities))
    for j in around:
        shift = velocities * (clock.time_s[j] - clock.time_s[i])
        cost += fields[j](sample, shift)
    return np.asarray(velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))])


def _grid(n: int) -> Float:
    span = np.arange(-n, n + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
