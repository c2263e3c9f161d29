# SPDX-License-Identifier: MIT
"""Sweeps laid one after the other on all that the last second measured, point to plane.

Point to point (`densify.registration.odometry`), sweeps are matched with the pattern in which those
before were scanned, which goes along with the vehicle and pulls it: poses of 64 rings come out
1 cm off, of 32 rings 1.3 cm, a rosette that turns 7 degrees from sweep to sweep takes the poses
with it. A second of sweeps together shows surfaces, whose normals do not depend on how they were
scanned (Chen, Medioni, "Object modelling by registration of multiple range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.types import Float, Int, Sweep, Trajectory
from densify.registration.alignment import Surface, lay_on_planes, subsample
from densify.registration.deskew import placed
from densify.registration.odometry import searched_twist

_REACH_NS = 1_050_000_000
_NUM_IN_REACH = 10  # sweeps; of more every second one, third, ...
_START_NS = 850_000_000  # in which the speed at the start is found
_NUM_START = 3  # sweeps that make the first surfaces, placed as expected
_NUM_POINTS = 15_000  # of a sweep
_VOXEL_M = 0.25
# Of one ring's points alone the normal is that of their noise, which leans towards the scanner:
# the road ahead, where only nearer rings were seen before, then tips the vehicle by .03 degrees a
# sweep. Neighbours have to reach the next rings.
_NUM_NEIGHBORS, _NUM_NEIGHBORS_OF_FEW = 20, 50
# In turn. Narrow at the end, since a point beyond all that was seen has no partner.
_MATCH_M = (0.5, 0.2)
_MATCH_GUESSED_M = (0.9, *_MATCH_M)  # constant velocity is up to 0.3 m off after 0.1 s
_MOST_M = 0.3  # off another odometry; farther, wrong partners are as near as right ones
_HOLD = 0.01  # along highways one plane in fifty tells


def refine(sweeps: Sequence[Sweep], rough: Trajectory) -> Trajectory:
    """The trajectory with each sweep laid on those before it, the first ones on those after them.

    sweeps: raw, of all its frames. A sweep that would go on otherwise than by ``rough`` by more
    than 0.3 m goes on so. The first pose stays.
    """

    def expected(i: int, _: Float) -> Float:
        return _twist(rough.T_world_lidar, rough.stamp_ns, i)

    if len(sweeps) < 2:
        return rough
    row = _Row(sweeps, _NUM_NEIGHBORS, _MATCH_M, _MOST_M)
    T_first_lidar = row.laid(expected(1, np.zeros(6)), expected)
    return replace(rough, T_world_lidar=rough.T_world_lidar[0] @ T_first_lidar)


def register_on_surfaces(
    sweeps: Sequence[Sweep], settings: RegisterSettings, measured: Sequence[Float | None]
) -> Trajectory:
    """Poses of sweeps of few points, without other odometry, see
    `densify.registration.odometry.register`.

    sweeps: raw, ascending in time. measured: (3,) m/s of each, see
    `densify.registration.doppler.measured_velocity`. Each is searched for where the vehicle would
    be if it kept its velocity, or went as fast as was measured: along a road where nothing else
    tells, that decides. The first second is registered twice, from `searched_twist`, which is some
    metres per second off, and from the twist found by that.
    """

    def expected(i: int, before: Float) -> Float:
        return _as_measured(before, measured[i - 1 : i + 1])

    row = _Row(sweeps, _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
    twist = np.zeros(6)
    if len(sweeps) > 1:
        known = all(velocity is not None for velocity in measured[:2])
        twist = _as_measured(twist, measured[:2]) if known else searched_twist(sweeps, settings)
        num = int(np.searchsorted(row.stamp_ns, row.stamp_ns[0] + _START_NS, side="right"))
        start = _Row(sweeps[:num], _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
        T = start.laid(twist, expected)
        twist = _twist(T, row.stamp_ns, min(_NUM_START + 1, len(T) - 1))
    return Trajectory(tuple(s.frame for s in sweeps), row.stamp_ns, row.laid(twist, expected))


class _Row:
    """Sweeps that are laid on each other, ascending in time."""

    def __init__(
        self,
        sweeps: Sequence[Sweep],
        num_neighbors: int,
        match_m: Sequence[float],
        most_m: float = np.inf,
    ) -> None:
        """num_neighbors: that tell a normal. match_m: nothing farther apart is taken for the same,
        in turn. most_m: a sweep that lies farther from where it is expected is put there."""
        self._sweeps = [subsample(sweep, _NUM_POINTS) for sweep in sweeps]
        self.stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
        self._num_neighbors, self._match_m, self._most_m = num_neighbors, match_m, most_m
        self._T: Float = np.tile(np.eye(4), (len(sweeps), 1, 1))
        self._points: list[Float] = []  # of those placed so far, in the world

    def laid(self, twist: Float, expected: Callable[[int, Float], Float]) -> Float:
        """``T_first_lidar`` (S,4,4).

        twist: (6,) per second at the start. expected: twist from sweep i - 1 to i, if it was the
        given one before.
        """
        num = len(self._sweeps)
        num_start = min(_NUM_START, num // 2)
        self._points = [_straight(self._sweeps[0], twist)]
        for i in range(1, num):
            twist = expected(i, twist)
            T_guess = self._T[i - 1] @ poses.exp(twist * self._seconds(i))
            before = range(i - 1, self._first(i) - 1, -1) if i >= num_start else ()
            twist = self._lay(i, i, T_guess, twist, before)
        if num > 2:
            twist = _twist(self._T, self.stamp_ns, num_start + 1)
            for i in range(num_start - 1, -1, -1):
                twist = expected(i + 1, twist)
                T_guess = self._T[i + 1] @ poses.exp(-twist * self._seconds(i + 1))
                twist = self._lay(i, i + 1, T_guess, twist, range(i + 1, self._last(i) + 1))
        return np.stack([np.eye(4), *(poses.inverse(self._T[0]) @ T for T in self._T[1:])])

    def _lay(self, i: int, step: int, T_guess: Float, twist: Float, on: Iterable[int]) -> Float:
        """Lay sweep i, expected there, on others, and return the twist from sweep ``step`` - 1 to
        ``step``. on: none to leave it there."""
        self._T[i], near = T_guess, list(on)
        if near:
            chosen = near[:: max(1, round(len(near) / _NUM_IN_REACH))]
            around = np.concatenate([self._points[j] for j in chosen])
            in_guess = poses.transform(poses.inverse(T_guess), around)
            surface = Surface.of(in_guess, _VOXEL_M, self._num_neighbors)
            T_guess_lidar, first = np.eye(4), twist
            for match_m in self._match_m:
                source = poses.transform(T_guess_lidar, _straight(self._sweeps[i], twist))
                moved, _ = lay_on_planes(surface, source, _VOXEL_M, match_m, _HOLD)
                T_guess_lidar = moved @ T_guess_lidar
                self._T[i] = T_guess @ T_guess_lidar
                twist = _twist(self._T, self.stamp_ns, step)
            if np.linalg.norm(T_guess_lidar[:3, 3]) > self._most_m:
                self._T[i], twist = T_guess, first
        points = poses.transform(self._T[i], _straight(self._sweeps[i], twist))
        self._points[i : i + 1] = [points]
        return twist

    def _seconds(self, i: int) -> float:
        """From the sweep before to sweep i."""
        return float(self.stamp_ns[i] - self.stamp_ns[i - 1]) * 1e-9

    def _first(self, i: int) -> int:
        """The first sweep that sweep i is laid on."""
        return min(int(np.searchsorted(self.stamp_ns, self.stamp_ns[i] - _REACH_NS)), i - 1)

    def _last(self, i: int) -> int:
        """The last one that lies so near after it."""
        end = int(np.searchsorted(self.stamp_ns, self.stamp_ns[i] + _REACH_NS, side="right"))
        return max(end - 1, i + 1)


def _as_measured(twist: Float, measured: Sequence[Float | None]) -> Float:
    """The (6,) twist per second with the mean of the measured velocities, where all are known."""
    known = [velocity for velocity in measured if velocity is not None]
    return np.append(twist[:3], np.mean(known, axis=0)) if len(known) == len(measured) else twist


def _straight(sweep: Sweep, twist: Float) -> Float:
    """Its points (N,3), deskewed."""
    return placed(sweep, np.eye(4), twist, twist).sweep.points


def _twist(T_world_lidar: Float, stamp_ns: Int, i: int) -> Float:
    """(6,) per second from the sweep before to sweep i."""
    T = poses.inverse(T_world_lidar[i - 1]) @ T_world_lidar[i]
    return poses.log(T) / ((stamp_ns[i] - stamp_ns[i - 1]) * 1e-9)
