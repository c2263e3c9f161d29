# SPDX-License-Identifier: MIT
"""Poses of consecutive sweeps: the recording's own, or odometry's in two passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.registration.deskew import deskew
from densify.registration.odometry import check_overlap, check_plausible, register
from densify.registration.upright import upright
from densify.types import Sweep, Trajectory

_ROUGH_STEP_S = (
    0.1  # within less the rings on the ground, that go with the scanner, hide its motion
)


class LeftOut(NamedTuple):
    """Why a sweep is not used. unreadable: it could not be read; else not registered."""

    reason: str
    unreadable: bool


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
    and taken; None to register the sweeps in two passes, whose first finds the motion that bends
    raw sweeps.

    Raises SweepError naming the frame where the poses cannot be right.
    """
    if recorded is not None:
        check_plausible(recorded, settings)
        check_overlap(sweeps, recorded, settings)
        found = recorded
    else:
        rough = _rough(sweeps, settings)
        straight = [s.sweep for s in deskew(sweeps, rough).sweeps]
        found = register(straight, settings, rough)
    return replace(found, R_level_lidar=upright(sweeps))


def _rough(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Trajectory:
    """The first pass, over sweeps no closer in time than it can tell them apart, with the poses
    between them at constant velocity."""
    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
    usual_s = float(np.median(np.diff(stamp_ns))) * 1e-9 if len(sweeps) > 1 else _ROUGH_STEP_S
    stride = max(1, round(_ROUGH_STEP_S / usual_s))
    if stride == 1:
        return register(sweeps, settings)
    last = len(sweeps) - 1
    rows = np.array(sorted({*range(0, last, stride), last}))
    sparse = register([sweeps[row] for row in rows], settings)
    T_world_lidar = []
    for i, time_ns in enumerate(stamp_ns):
        k = min(int(np.searchsorted(rows, i, side="right")), len(rows) - 1) - 1
        a_ns, b_ns = sparse.stamp_ns[k : k + 2]
        a, b = sparse.T_world_lidar[k : k + 2]
        T_world_lidar.append(poses.interpolate(a, b, (time_ns - a_ns) / (b_ns - a_ns)))
    return Trajectory(tuple(s.frame for s in sweeps), stamp_ns, np.stack(T_world_lidar))
