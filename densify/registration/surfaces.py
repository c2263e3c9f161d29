# SPDX-License-Identifier: MIT
"""Odometry for sweeps of few points: each laid point to plane on all that the last second measured.

Point to point (`densify.registration.odometry`), few points are matched with the pattern in which
the sweeps before were scanned: poses of sixteen rings come out 2 cm off, and a rosette that turns
7 degrees from sweep to sweep takes the poses with it. A second of sweeps together shows surfaces,
and their normals do not depend on how they were scanned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.registration.alignment import Surface, lay_on_planes, subsample
from densify.registration.deskew import placed
from densify.registration.odometry import searched_twist
from densify.types import Float, Int, Sweep, Trajectory

_BEFORE_NS = 1_050_000_000
_NUM_BEFORE = 10  # sweeps; of more every second one, third, ...
_START_NS = 850_000_000  # in which the speed at the start is found
_NUM_START = 3  # sweeps that make the first surfaces, placed by that speed
_NUM_POINTS = 15_000  # of a sweep
_VOXEL_M = 0.25
_MATCH_M = (0.9, 0.6, 0.3)  # in turn; a guess at constant velocity is up to 0.3 m off after 0.1 s
_HOLD = 0.01


def register_on_surfaces(
    sweeps: Sequence[Sweep], settings: RegisterSettings, measured: Sequence[Float | None]
) -> Trajectory:
    """Poses of sweeps by lidar odometry, see `densify.registration.odometry.register`.

    sweeps: raw, ascending in time. measured: (3,) m/s of each, see
    `densify.registration.doppler.measured_velocity`. Each is searched for where the vehicle would
    be if it kept its velocity, or went as fast as was measured: along a road where nothing else
    tells, that decides. The first second is registered twice, from `searched_twist`, which is some
    metres per second off, and from the twist found by that.
    """
    chosen = [subsample(sweep, _NUM_POINTS) for sweep in sweeps]
    frames = tuple(s.frame for s in sweeps)
    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
    twist = np.zeros(6)
    if len(sweeps) > 1:
        start = slice(int(np.searchsorted(stamp_ns, stamp_ns[0] + _START_NS, side="right")))
        known = all(velocity is not None for velocity in measured[:2])
        twist = _as_measured(twist, measured[:2]) if known else searched_twist(sweeps, settings)
        T = _follow(chosen[start], stamp_ns[start], twist, measured)
        twist = _twist(T, stamp_ns, min(_NUM_START + 1, len(T) - 1))  # between two that were laid
    return Trajectory(frames, stamp_ns, np.stack(_follow(chosen, stamp_ns, twist, measured)))


def _as_measured(twist: Float, measured: Sequence[Float | None]) -> Float:
    """The (6,) twist per second with the mean of the measured velocities, where all are known."""
    known = [velocity for velocity in measured if velocity is not None]
    return np.append(twist[:3], np.mean(known, axis=0)) if len(known) == len(measured) else twist


def _follow(
    sweeps: Sequence[Sweep], stamp_ns: Int, twist: Float, measured: Sequence[Float | None]
) -> list[Float]:
    """``T_world_lidar`` of each sweep, from the (6,) twist per second at the start."""
    T_world_lidar = [np.eye(4)]
    points = [_straight(sweeps[0], twist)]  # in the world
    num_start = min(_NUM_START, len(sweeps) - 1)
    for i in range(1, len(sweeps)):
        twist = _as_measured(twist, measured[i - 1 : i + 1])
        T_guess = T_world_lidar[-1] @ poses.exp(twist * (stamp_ns[i] - stamp_ns[i - 1]) * 1e-9)
        T_world_lidar.append(T_guess)
        if i >= num_start:
            before = np.concatenate([points[j] for j in _before(stamp_ns, i)])
            surface = Surface.of(poses.transform(poses.inverse(T_guess), before), _VOXEL_M)
            T_guess_lidar = np.eye(4)
            for match_m in _MATCH_M:
                source = poses.transform(T_guess_lidar, _straight(sweeps[i], twist))
                moved, _ = lay_on_planes(surface, source, _VOXEL_M, match_m, _HOLD)
                T_guess_lidar = moved @ T_guess_lidar
                T_world_lidar[-1] = T_guess @ T_guess_lidar
                twist = _twist(T_world_lidar, stamp_ns, i)
        points.append(poses.transform(T_world_lidar[-1], _straight(sweeps[i], twist)))
    return T_world_lidar


def _straight(sweep: Sweep, twist: Float) -> Float:
    """Its points (N,3), deskewed."""
    return placed(sweep, np.eye(4), twist, twist).sweep.points


def _before(stamp_ns: Int, i: int) -> Int:
    """The sweeps that sweep i is laid on, the last one at the least."""
    first = min(int(np.searchsorted(stamp_ns, stamp_ns[i] - _BEFORE_NS)), i - 1)
    near = np.arange(i - 1, first - 1, -1)
    return near[:: max(1, round(len(near) / _NUM_BEFORE))]


def _twist(T_world_lidar: Sequence[Float], stamp_ns: Int, i: int) -> Float:
    """(6,) per second from the sweep before to sweep i."""
    T = poses.inverse(T_world_lidar[i - 1]) @ T_world_lidar[i]
    return poses.log(T) / ((stamp_ns[i] - stamp_ns[i - 1]) * 1e-9)
