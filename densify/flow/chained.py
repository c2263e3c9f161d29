# SPDX-License-Identifier: MIT
"""Chaining: flow between neighbouring sweeps becomes flow over many, k -> k±1 -> … -> target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry import poses
from densify.geometry.types import Float, FlowField, Int, Stretch

_NUM_NEIGHBORS = 3
MAX_GAP_M = 0.5


@dataclass(frozen=True)
class ChainedMotion:
    """What moves in a stretch by flows between neighbours: a `Motion`.

    step: makes the flow of sweep number i to number j = i ± 1; each is asked for once, when needed.
    max_gap_m: a moved point farther than this from all moving points of the next sweep is lost.
    """

    stretch: Stretch
    step: Callable[[int, int], FlowField]
    max_gap_m: float = MAX_GAP_M
    _found: dict[tuple[int, int], FlowField] = field(default_factory=dict, repr=False)

    def flow(self, frame: int, target: int) -> FlowField:
        """Flow of every point of a sweep to another sweep's reference time; both by frame number.

        The flow of the next sweep is looked up at the moved point: an object's points all share its
        rigid motion there plus what the nearest of them deviate from it; a point without an object
        takes the mean of the nearest moving ones. A point is lost where its object has no points
        in the next sweep, or no moving point lies within ``max_gap_m``. Points that do not move
        stay exactly where they are.
        """
        here, there = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        return self._flow(here, there)

    def _flow(self, here: int, there: int) -> FlowField:
        if here == there and len(self.stretch.sweeps) > 1:
            # What moves in a sweep itself, and how fast, a step to a neighbour tells.
            step = self._flow(here, here + 1 if here + 1 < len(self.stretch.sweeps) else here - 1)
            return replace(step, displacement=np.zeros_like(step.displacement))
        if here == there:
            return FlowField.zero(len(self.stretch.sweeps[here].sweep))
        if (here, there) not in self._found:
            near = here + (1 if there > here else -1)
            if near == there:
                found = self._with_velocity(self.step(here, there), here, there)
            else:
                found = self._follow(here, near, self._flow(near, there))
            self._found[here, there] = found
        return self._found[here, there]

    def _with_velocity(self, step: FlowField, here: int, there: int) -> FlowField:
        stamps_ns = [self.stretch.sweeps[i].sweep.stamp_ns for i in (here, there)]
        velocity_m_s = step.displacement / ((stamps_ns[1] - stamps_ns[0]) * 1e-9)
        return replace(step, velocity_m_s=velocity_m_s)

    def _follow(self, i: int, near: int, onward: FlowField) -> FlowField:
        """One step of sweep i, then the flow of the nearer sweep from there on."""
        step = self._flow(i, near)
        here, there = self.stretch.sweeps[i], self.stretch.sweeps[near]
        T_there_here = self.stretch.T_target_source(there.frame, here.frame)
        displacement, lost = step.displacement.copy(), step.lost.copy()
        velocity_m_s = np.zeros_like(displacement)
        known_at = there.sweep.points + onward.total - onward.displacement
        for instance in np.unique(step.instance[step.moving]):
            mine = np.flatnonzero(step.moving & (step.instance == instance))
            theirs = np.flatnonzero(onward.moving & ~onward.lost & (onward.instance == instance))
            if not len(theirs):
                lost[mine] = True
                continue
            arrived = poses.transform(T_there_here, here.sweep.points[mine] + step.total[mine])
            gap_m, nearest, weight = _nearest(arrived, known_at[theirs])
            flow, rest = np.zeros_like(arrived), onward.displacement[theirs]
            if instance >= 0:
                R, t = _rigid_fit(known_at[theirs], known_at[theirs] + rest)
                flow = arrived @ R.T + t - arrived
                rest = rest - (known_at[theirs] @ R.T + t - known_at[theirs])
            else:
                lost[mine[gap_m > self.max_gap_m]] = True
            flow = flow + np.einsum("nk,nkj->nj", weight, rest[nearest])
            displacement[mine] += flow @ T_there_here[:3, :3]  # back into this sweep's lidar frame
            if onward.velocity_m_s is not None:
                theirs_m_s = onward.velocity_m_s[theirs][nearest]
                velocity = np.einsum("nk,nkj->nj", weight, theirs_m_s)
                velocity_m_s[mine] = velocity @ T_there_here[:3, :3]
        return replace(step, displacement=displacement, lost=lost, velocity_m_s=velocity_m_s)


def _nearest(at: Float, points: Float) -> tuple[Float, Int, Float]:
    """(N,3), (M,3) -> distance (N,) to the nearest point, rows (N,k) of the k nearest, weights."""
    k = min(_NUM_NEIGHBORS, len(points))
    distance, nearest = cKDTree(points).query(at, k)
    distance = np.reshape(distance, (len(at), k))
    weight = 1 / (distance + 1e-3)
    weight /= weight.sum(1, keepdims=True)
    return distance[:, 0], np.reshape(nearest, (len(at), k)), weight


def _rigid_fit(source: Float, target: Float) -> tuple[Float, Float]:
    """Least-squares rotation and translation (Kabsch 1976); a translation for fewer than 3 points
    or points on a line."""
    a, b = source.mean(0), target.mean(0)
    x = source - a
    if len(source) < 3 or np.linalg.matrix_rank(x, tol=0.05) < 2:
        return np.eye(3), b - a
    U, _, Vt = np.linalg.svd(x.T @ (target - b))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    R = Vt.T @ D @ U.T
    return R, b - R @ a
