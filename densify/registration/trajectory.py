# SPDX-License-Identifier: MIT
"""Poses of consecutive sweeps: the recording's own, or odometry's in two passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from densify.config import RegisterSettings
from densify.registration.deskew import deskew
from densify.registration.odometry import check_overlap, check_plausible, register
from densify.types import Sweep, Trajectory


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
        return recorded
    rough = register(sweeps, settings)
    straight = [s.sweep for s in deskew(sweeps, rough).sweeps]
    return register(straight, settings, rough)
