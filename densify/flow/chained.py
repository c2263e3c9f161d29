# SPDX-License-Identifier: MIT
"""Chain the flow between neighbouring sweeps, k -> k±1 -> … -> target, to flow over many sweeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from densify.geometry import poses
from densify.geometry.nearest import nearest_k, tree_of
from densify.geometry.types import Float, FlowField, Int, Stretch

_NUM_NEIGHBORS = 3
_LINE_M = 0.05  # points with less scatter about a line count as on the line
_MAX_GAP_M = 0.5


@dataclass(frozen=True)
class ChainedMotion:
    """Motion of a stretch, chained from flow between neighbouring sweeps: a `Motion`."""

    stretch: Stretch  # consecutive registered sweeps
    # Function that returns the flow of sweep index i to index j = i ± 1, in the lidar frame of
    # sweep i. It is called on demand, once for each (i, j).
    step: Callable[[int, int], FlowField]
    _found: dict[tuple[int, int], FlowField] = field(default_factory=dict, repr=False)

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of all points of sweep ``frame`` to the reference time of ``target``.

        The flow excludes ego-motion and is in the lidar frame of ``frame``. At each sweep on the
        way, points of an object take the object's rigid motion there, plus the mean deviation of
        the nearest points. Points without an object take the mean flow of the nearest moving
        points. A point is lost if its object has no points in the next sweep, or if no moving point
        is within 0.5 m.
        """
        here, there = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        return self._flow(here, there)

    def _flow(self, here: int, there: int) -> FlowField:
        num_sweeps = len(self.stretch.sweeps)
        if here == there and num_sweeps > 1:  # a step to a neighbour has the moving points
            step = self._flow(here, here + 1 if here + 1 < num_sweeps else here - 1)
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
        """Chain the flow of sweep i to its neighbour ``near`` with the flow ``onward`` there."""
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
            gap_m, nearest = nearest_k(tree_of(known_at[theirs]), arrived, _NUM_NEIGHBORS)
            weight = 1 / (gap_m + 1e-3)
            weight /= weight.sum(axis=1, keepdims=True)
            flow, rest = np.zeros_like(arrived), onward.displacement[theirs]
            if instance >= 0:
                T = _object_motion(known_at[theirs], known_at[theirs] + rest)
                flow = poses.transform(T, arrived) - arrived
                rest = known_at[theirs] + rest - poses.transform(T, known_at[theirs])
            else:
                lost[mine[gap_m[:, 0] > _MAX_GAP_M]] = True
            R_there_here = T_there_here[:3, :3]
            displacement[mine] += (flow + _mean(rest, nearest, weight)) @ R_there_here
            if onward.velocity_m_s is not None:
                theirs_m_s = onward.velocity_m_s[theirs]
                velocity_m_s[mine] = _mean(theirs_m_s, nearest, weight) @ R_there_here
        return replace(step, displacement=displacement, lost=lost, velocity_m_s=velocity_m_s)


def _object_motion(source: Float, target: Float) -> Float:
    """Return the (4,4) rigid motion that best moves points (N,3) to target positions (N,3)."""
    if np.linalg.matrix_rank(source - source.mean(axis=0), tol=_LINE_M) < 2:
        # fewer than three points, or points on a line: a pure translation
        T = np.eye(4)
        T[:3, 3] = (target - source).mean(axis=0)
        return T
    return poses.fit_rigid(source, target)


def _mean(values: Float, rows: Int, weight: Float) -> Float:
    """Return the (N,3) means of values (M,3) at rows (N,k), with weights (N,k) that sum to 1."""
    return np.asarray(np.einsum("nk,nkj->nj", weight, values[rows]))
