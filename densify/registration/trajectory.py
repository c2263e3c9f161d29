# SPDX-License-Identifier: MIT
"""Poses of consecutive sweeps: the recording's own, or odometry's, laid on their neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError, SweepError, UnfitSweepError, UnplacedSweepError
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.types import Float, Int, Sweep, Trajectory
from densify.registration.deskew import deskew
from densify.registration.doppler import measured_velocity
from densify.registration.odometry import (
    check_measured,
    check_number_of_points,
    check_overlap,
    check_plausible,
    check_stamps,
    register,
)
from densify.registration.surfaces import refine, register_on_surfaces
from densify.registration.upright import upright

_MANY_POINTS = 30_000  # in a sweep; fewer are matched with the pattern they were scanned in


class LeftOut(NamedTuple):
    """Why a sweep is not used. unreadable: it could not be read; else it was not registered,
    because of what it holds if unfit."""

    reason: str
    unreadable: bool
    unfit: bool = False

    def error(self, frame: int) -> InputError | SweepError:
        """What to raise where nothing can be made without the sweep."""
        if self.unreadable:
            return InputError(self.reason)
        return (UnfitSweepError if self.unfit else UnplacedSweepError)(self.reason, frame)


@dataclass(frozen=True)
class Registration:
    """pieces: poses of neighbouring sweeps, each piece with a world of its own; the sweeps before
    the block that odometry started with are among them. bad: frame -> why it is left out."""

    pieces: tuple[Trajectory, ...]
    bad: Mapping[int, LeftOut]


def find_trajectory(
    sweeps: Sequence[Sweep], settings: RegisterSettings, recorded: Trajectory | None = None
) -> Trajectory:
    """Where the lidar was at every sweep.

    sweeps: raw, ascending in time. recorded: the recording's own poses of them, which are checked
    and taken; None to find them by odometry, point to point, and then lay each sweep on the
    surfaces of those before it (`densify.registration.surfaces`).

    Raises SweepError naming the frame where the poses cannot be right, InputError where radial
    velocities cannot.
    """
    if recorded is not None:
        check_plausible(recorded, settings)
        check_overlap(sweeps, recorded, settings)
        found = recorded
    else:
        check_number_of_points(sweeps, settings)
        check_stamps([s.frame for s in sweeps], _stamps_ns(sweeps))
        many = bool(np.median([len(sweep) for sweep in sweeps]) >= _MANY_POINTS)
        measured = [measured_velocity(sweep) for sweep in sweeps]
        if many and any(velocity is None for velocity in measured):
            odometry, straight = _by_points(sweeps, settings)
            found = refine(sweeps, odometry)
        else:
            if measured[0] is not None:
                check_measured(sweeps, measured[0], settings)
            found = register_on_surfaces(sweeps, settings, measured)
            straight = [s.sweep for s in deskew(sweeps, found).sweeps]
        check_plausible(found, settings)
        check_overlap(straight, found, settings)
    return replace(found, R_level_lidar=upright(sweeps))


def _by_points(
    sweeps: Sequence[Sweep], settings: RegisterSettings
) -> tuple[Trajectory, list[Sweep]]:
    """Odometry for many points in two passes, whose first finds the motion that bends raw sweeps;
    and the sweeps deskewed by that."""
    rough = _rough(sweeps, settings)
    straight = [s.sweep for s in deskew(sweeps, rough).sweeps]
    return _fine(straight, rough, settings), straight


def _rough(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Trajectory:
    """The first pass, of raw sweeps: those taken together are not laid on each other, as if they
    were one raw sweep that takes longer."""
    stamp_ns = _stamps_ns(sweeps)
    together = [list(rows) for rows in Clock(stamp_ns).batches()]
    if len(together) in (1, len(sweeps)):
        return register(sweeps, settings)
    groups = [[sweeps[i] for i in rows] for rows in together]
    joined = [_joined(group, np.concatenate([s.points for s in group])) for group in groups]
    return _between(register(joined, settings), tuple(s.frame for s in sweeps), stamp_ns)


def _fine(sweeps: Sequence[Sweep], rough: Trajectory, settings: RegisterSettings) -> Trajectory:
    """The second pass, of deskewed sweeps: those taken together are laid on each other."""
    stamp_ns = _stamps_ns(sweeps)
    together = [list(rows) for rows in Clock(stamp_ns).batches()]
    if len(together) in (1, len(sweeps)):
        return register(sweeps, settings, rough)
    frames = tuple(sweeps[rows[0]].frame for rows in together)
    start = _between(rough, frames, np.array([_middle_ns(stamp_ns[rows]) for rows in together]))
    joined = []
    for rows, T_world_joined in zip(together, start.T_world_lidar, strict=True):
        T_joined_lidar = poses.inverse(T_world_joined) @ rough.T_world_lidar[rows]
        points = [
            poses.transform(T, sweeps[i].points) for i, T in zip(rows, T_joined_lidar, strict=True)
        ]
        joined.append(_joined([sweeps[i] for i in rows], np.concatenate(points)))
    return _between(register(joined, settings, start), rough.frames, stamp_ns)


def _joined(sweeps: Sequence[Sweep], points: Float) -> Sweep:
    """All their points as one sweep, in the middle of their reference times."""
    num = len(points)
    return Sweep(
        sweeps[0].frame,
        _middle_ns(_stamps_ns(sweeps)),
        points,
        np.zeros(num, np.float32),
        None,
        np.zeros(num, np.uint8),
        np.arange(num, dtype=np.int64),
    )


def _between(known: Trajectory, frames: tuple[int, ...], stamp_ns: Int) -> Trajectory:
    """The poses at other times, at constant velocity between those known and beyond."""
    T_world_lidar = []
    for time_ns in stamp_ns:
        later = int(np.searchsorted(known.stamp_ns, time_ns, side="right"))
        k = min(max(later, 1), len(known.stamp_ns) - 1) - 1
        a_ns, b_ns = known.stamp_ns[k : k + 2]
        a, b = known.T_world_lidar[k : k + 2]
        T_world_lidar.append(poses.interpolate(a, b, (time_ns - a_ns) / (b_ns - a_ns)))
    return Trajectory(frames, stamp_ns, np.stack(T_world_lidar))


def _middle_ns(stamp_ns: Int) -> int:
    return int(stamp_ns[0] + (stamp_ns[-1] - stamp_ns[0]) // 2)


def _stamps_ns(sweeps: Sequence[Sweep]) -> Int:
    return np.array([s.stamp_ns for s in sweeps], np.int64)
