# SPDX-License-Identifier: MIT
"""Define what a check takes and returns: a few registered sweeps of the recording, and findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError, SweepError
from densify.geometry.types import Float, LidarSequence, Stretch, Sweep, Trajectory
from densify.readers.timeline import Timeline, remove_unusable_returns
from densify.registration.deskew import deskew
from densify.registration.trajectory import find_trajectory

_NUM_SPOTS = 3  # greatest number of spots of a sample
_NUM_SWEEPS = 5  # number of sweeps of a spot
_STEP_S = 0.1  # time between the sweeps of a spot


class Verdict(IntEnum):
    """The severity of a finding."""

    FINE = 0
    UNKNOWN = 1  # the recording allows no verdict, such as one of a vehicle at rest
    SUSPICIOUS = 2
    WRONG = 3

    def __str__(self) -> str:
        return self.name.lower()


FINE, UNKNOWN, SUSPICIOUS, WRONG = Verdict
GIVE_TIMES = (
    "give them times: a column in the files, or for a scanner that spins the line sweeps: {time: "
    "azimuth} in the densify.yaml of a folder"
)
"""Remedy of sweeps whose points have no times."""

Value = float | int | str | list[float]


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str  # name of the checked property, such as "stamps"
    verdict: Verdict  # severity
    evidence: str  # sentence with the number on which the verdict is based
    # Option or line that corrects the error; empty if the verdict is FINE or UNKNOWN
    remedy: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)  # name (with unit) -> measured number

    def __post_init__(self) -> None:
        if self.verdict < SUSPICIOUS:
            object.__setattr__(self, "remedy", "")


@dataclass(frozen=True)
class Spot:
    """A spot: a few consecutive sweeps at one position in the recording."""

    sweeps: tuple[Sweep, ...]  # raw sweeps, ego vehicle included
    trajectory: Trajectory | None  # poses by odometry; None if registration failed
    failure: str = ""  # reason of the failure

    @staticmethod
    def of(sweeps: tuple[Sweep, ...], settings: RegisterSettings) -> Spot:
        """Return a spot of these sweeps, registered by odometry if possible."""
        if len(sweeps) < 2:
            return Spot(sweeps, None, "one sweep alone cannot be registered")
        try:
            sweeps_in_range = [remove_unusable_returns(sweep, settings) for sweep in sweeps]
            trajectory = find_trajectory(sweeps_in_range, settings)
        except SweepError as error:
            return Spot(sweeps, None, str(error))
        return Spot(sweeps, trajectory)

    @cached_property
    def stretch(self) -> Stretch:
        """The sweeps deskewed, in the world of odometry; empty if registration failed."""
        return Stretch(()) if self.trajectory is None else deskew(self.sweeps, self.trajectory)

    @property
    def middle(self) -> Sweep:
        """The sweep in the middle."""
        return self.sweeps[len(self.sweeps) // 2]

    @property
    def twist(self) -> Float:
        """(6,) velocity (rad/s, m/s) at the middle sweep, lidar frame; 0 if registration failed."""
        if self.trajectory is None:
            return np.zeros(6)
        registered = self.stretch.sweeps[len(self.sweeps) // 2]
        return 0.5 * (registered.twist_before + registered.twist_after)

    @property
    def speed_m_s(self) -> float:
        """Speed at the middle sweep."""
        return float(np.linalg.norm(self.twist[3:]))


@dataclass(frozen=True)
class Sample:
    """The examined sweeps."""

    sequence: LidarSequence  # the recording
    timeline: Timeline  # reference times of all its sweeps
    spots: tuple[Spot, ...]  # groups of consecutive sweeps, ascending in time
    unreadable: dict[int, str]  # frame number -> reason why a chosen sweep could not be read
    settings: RegisterSettings = field(default_factory=RegisterSettings)  # settings of registration

    @staticmethod
    def of(sequence: LidarSequence, settings: RegisterSettings) -> Sample:
        """Read and register spots at start, middle and end; InputError if no sweep is readable."""
        timeline = Timeline.of(sequence)
        unreadable: dict[int, str] = {}
        spots = []
        for frames in choose_frames(timeline):
            sweeps = []
            for frame in frames:
                try:
                    sweeps.append(sequence[frame])
                except InputError as error:
                    unreadable[frame] = str(error)
            if sweeps:
                spots.append(Spot.of(tuple(sweeps), settings))
        if not spots:
            frame, reason = next(iter(unreadable.items()))
            raise InputError(f"{sequence.name}: no sweep can be read; frame {frame}: {reason}")
        return Sample(sequence, timeline, tuple(spots), unreadable, settings)

    @property
    def middles(self) -> list[Sweep]:
        """The middle sweep of each spot."""
        return [spot.middle for spot in self.spots]

    @property
    def lidars(self) -> list[int]:
        """Indices of the scanners."""
        return sorted({int(number) for sweep in self.middles for number in np.unique(sweep.lidar)})

    @property
    def registered(self) -> list[Spot]:
        """Spots whose registration succeeded."""
        return [spot for spot in self.spots if spot.trajectory is not None]

    @property
    def fastest(self) -> Spot:
        """Spot with the highest speed, a registered one if there is any."""
        return max(self.registered or self.spots, key=lambda spot: spot.speed_m_s)

    @property
    def unregistered(self) -> str:
        """Why a check that needs registered sweeps is impossible, "" if it is possible."""
        return "" if self.registered else "no sweeps could be registered"

    def too_slow(self, least_m_s: float) -> str:
        """Return why a check that needs this speed is impossible, "" if it is possible."""
        if self.unregistered or self.fastest.speed_m_s >= least_m_s:
            return self.unregistered
        return (
            f"the vehicle drives at {self.fastest.speed_m_s:.1f} m/s where it was looked at, "
            f"{least_m_s:g} are needed"
        )


def choose_frames(timeline: Timeline) -> list[list[int]]:
    """Return for each of up to 3 spots the frame numbers of up to 5 sweeps about 0.1 s apart."""
    stride = max(1, round(_STEP_S * 1e9 / timeline.period_ns))
    runs = timeline.split_at_holes(timeline.frames)  # without a hole in time
    # Number of sweeps from the first to the last sweep of a spot, both included
    length = min(max(map(len, runs)), stride * (_NUM_SWEEPS - 1) + 1)
    candidates = [
        run[start : start + length : stride]
        for run in runs
        for start in range(len(run) - length + 1)
    ]
    num_spots = min(_NUM_SPOTS, max(1, len(timeline.frames) // length))
    rows = np.rint(np.linspace(0, len(candidates) - 1, num_spots)).astype(int)
    return [candidates[row] for row in np.unique(rows)]
