# SPDX-License-Identifier: MIT
"""Register sweeps point to plane on the surfaces of the last second.

Point-to-point registration (`densify.registration.odometry`) matches a sweep with the scan pattern
of earlier sweeps, which moves with the vehicle. This biases the poses by 1 cm with 64 rings and by
1.3 cm with 32. A rosette pattern that turns 7 degrees a sweep turns the poses with it. The sweeps
of one second together give surface normals that do not depend on the pattern (Chen, Medioni,
"Object modelling by registration of multiple range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, Sweep, Trajectory
from densify.registration.alignment import Surface, align_with_planes, subsample
from densify.registration.deskew import deskew_sweep
from densify.registration.odometry import search_twist

_REACH_NS = 1_050_000_000
_NUM_IN_REACH = 10  # sweeps of the last second; a larger number is thinned evenly
_START_NS = 850_000_000  # time in which the start speed is found
_NUM_START = 3  # sweeps of the first surfaces, at their expected poses
_NUM_POINTS = 15_000  # number of points of a sweep
_VOXEL_M = 0.25
# Neighbours must include the next rings. Points of one ring give normals of noise, which lean
# towards the scanner and tilt the vehicle by 0.03 degrees a sweep.
_NUM_NEIGHBORS, _NUM_NEIGHBORS_OF_FEW = 20, 50
# One distance per round. The last is narrow, because points outside the target have no match.
_MATCH_M = (0.5, 0.2)
_MATCH_GUESSED_M = (0.9, *_MATCH_M)  # constant velocity is up to 0.3 m off after 0.1 s
_MOST_M = 0.3  # from the odometry; at larger distances false matches are as near as correct ones
_HOLD = 0.01  # along highways one plane in fifty constrains the motion


def refine(sweeps: Sequence[Sweep], rough: Trajectory) -> Trajectory:
    """Return the trajectory with each raw sweep aligned with the sweeps of the second before it.

    The first sweeps are aligned with the sweeps after them. A sweep that would move by more than
    0.3 m from ``rough`` keeps its pose. The first pose does not change.

    Args:
        sweeps: Raw sweeps, ascending in time.
        rough: Trajectory of these sweeps, by odometry.
    """

    def expected(i: int, _: Float) -> Float:
        return poses.twist_to(rough.T_world_lidar, rough.stamp_ns, i)

    if len(sweeps) < 2:
        return rough
    row = _SweepRow(sweeps, _NUM_NEIGHBORS, _MATCH_M, _MOST_M)
    T_first_lidar = row.register(expected(1, np.zeros(6)), expected)
    return replace(rough, T_world_lidar=rough.T_world_lidar[0] @ T_first_lidar)


def register_on_surfaces(sweeps: Sequence[Sweep]) -> Trajectory:
    """Return the trajectory of sparse raw sweeps, ascending in time, without other odometry.

    Each sweep starts at constant velocity. The first second is registered twice. The first time
    starts from `search_twist`, which is some metres per second off, the second time from the
    velocity found.
    """

    def expected(_: int, before: Float) -> Float:
        return before

    row = _SweepRow(sweeps, _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
    twist = np.zeros(6)
    if len(sweeps) > 1:
        twist = search_twist(row.stamp_ns, [s.points for s in sweeps])
        num = int(np.searchsorted(row.stamp_ns, row.stamp_ns[0] + _START_NS, side="right"))
        start = _SweepRow(sweeps[:num], _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
        T = start.register(twist, expected)
        twist = poses.twist_to(T, row.stamp_ns, min(_NUM_START + 1, len(T) - 1))
    frames = tuple(s.frame for s in sweeps)
    return Trajectory(frames, row.stamp_ns, row.register(twist, expected))


class _SweepRow:
    """Raw sweeps, ascending in time, that are aligned with each other."""

    def __init__(
        self,
        sweeps: Sequence[Sweep],
        num_neighbors: int,
        match_m: Sequence[float],
        most_m: float = np.inf,
    ) -> None:
        """Prepare the sweeps.

        Args:
            num_neighbors: Number of neighbouring points that give a normal.
            match_m: Greatest distance in metres between corresponding points, for each round.
            most_m: Greatest correction in metres; a sweep that needs more keeps its prediction.
        """
        self._sweeps = [subsample(sweep, _NUM_POINTS) for sweep in sweeps]
        self.stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
        self._num_neighbors, self._match_m, self._most_m = num_neighbors, match_m, most_m
        self._T: Float = np.tile(np.eye(4), (len(sweeps), 1, 1))
        self._points: list[Float] = []  # of the sweeps aligned so far, in the world

    def register(self, twist: Float, expected: Callable[[int, Float], Float]) -> Float:
        """Return ``T_first_lidar`` (S,4,4) of the S sweeps.

        twist: (6,) initial velocity (rad/s, m/s). expected: function that predicts the velocity
        from sweep i - 1 to i, given i and the previous velocity.
        """
        num, stamp_ns = len(self._sweeps), self.stamp_ns
        num_start = min(_NUM_START, num // 2)
        self._points = [_deskewed(self._sweeps[0], twist)]
        for i in range(1, num):
            twist = expected(i, twist)
            T_guess = self._T[i - 1] @ poses.exp(twist * self._seconds(i))
            first = min(int(np.searchsorted(stamp_ns, stamp_ns[i] - _REACH_NS)), i - 1)
            before = range(i - 1, first - 1, -1) if i >= num_start else ()
            twist = self._place(i, i, T_guess, twist, before)
        if num > 2:
            twist = poses.twist_to(self._T, stamp_ns, num_start + 1)
            for i in range(num_start - 1, -1, -1):
                twist = expected(i + 1, twist)
                T_guess = self._T[i + 1] @ poses.exp(-twist * self._seconds(i + 1))
                end = int(np.searchsorted(stamp_ns, stamp_ns[i] + _REACH_NS, side="right"))
                twist = self._place(i, i + 1, T_guess, twist, range(i + 1, max(end, i + 2)))
        return np.stack([np.eye(4), *(poses.inverse(self._T[0]) @ T for T in self._T[1:])])

    def _place(self, i: int, step: int, T_guess: Float, twist: Float, on: Iterable[int]) -> Float:
        """Align sweep i with others, and return the velocity from sweep ``step`` - 1 to ``step``.

        T_guess: predicted pose. twist: predicted (6,) velocity. on: indices of the other sweeps,
        nearest first; if empty the sweep keeps its prediction.
        """
        self._T[i], near = T_guess, list(on)
        if near:
            chosen = near[:: max(1, round(len(near) / _NUM_IN_REACH))]
            around = np.concatenate([self._points[j] for j in chosen])
            in_guess = poses.transform(poses.inverse(T_guess), around)
            surface = Surface.of(in_guess, _VOXEL_M, self._num_neighbors)
            T_guess_lidar, first = np.eye(4), twist
            for match_m in self._match_m:
                source = poses.transform(T_guess_lidar, _deskewed(self._sweeps[i], twist))
                moved = align_with_planes(surface, source, _VOXEL_M, match_m, _HOLD)
                T_guess_lidar = moved @ T_guess_lidar
                self._T[i] = T_guess @ T_guess_lidar
                twist = poses.twist_to(self._T, self.stamp_ns, step)
            if np.linalg.norm(T_guess_lidar[:3, 3]) > self._most_m:
                self._T[i], twist = T_guess, first
        points = poses.transform(self._T[i], _deskewed(self._sweeps[i], twist))
        self._points[i : i + 1] = [points]
        return twist

    def _seconds(self, i: int) -> float:
        """Return the time from sweep i - 1 to sweep i in seconds."""
        return float(self.stamp_ns[i] - self.stamp_ns[i - 1]) * 1e-9


def _deskewed(sweep: Sweep, twist: Float) -> Float:
    """Return the (N,3) points deskewed by a (6,) velocity (rad/s, m/s), lidar frame."""
    return deskew_sweep(sweep, np.eye(4), twist, twist).sweep.points
