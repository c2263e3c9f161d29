# SPDX-License-Identifier: MIT
"""Firing patterns: where a scanner's pulses point, and how many there are in a sweep.

A scanner fires at a constant rate, so a sweep of half the period has half the pulses. Angles are
in lidar axes: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from densify.geometry.types import Float, Int


class Slots(NamedTuple):
    """The N pulses of a sweep in the order of time. number: (N,) int64 from 0. share: (N,) when
    each fires, in periods from the reference time, -0.5 to 0.5. time_s: (N,) the same in seconds
    since frame 0, for patterns that run on from sweep to sweep."""

    number: Int
    share: Float
    time_s: Float


class Pattern(Protocol):
    """How one scanner fires."""

    def num_pulses(self, period_s: float) -> int:
        """Pulses in a sweep that lasts so long."""
        ...

    def directions(self, slots: Slots) -> Float:
        """(N,3) unit vectors, axes of the scanner."""
        ...


@dataclass(frozen=True)
class Spinning:
    """Turns clockwise seen from above, once in a sweep, and faces forward at the reference time.

    elevation_deg: of the beams in the order they fire. Beams fire one after the other, never two
    at once, so every pulse has an azimuth of its own. columns_per_s: firings of each beam; at
    20 Hz a revolution has half the columns that it has at 10 Hz. phase: turns by which it is ahead
    of a scanner that faces forward at the reference time.
    """

    elevation_deg: tuple[float, ...]
    columns_per_s: int
    phase: float = 0.0

    def num_pulses(self, period_s: float) -> int:
        return int(self.columns_per_s * period_s + 1e-6) * len(self.elevation_deg)

    def directions(self, slots: Slots) -> Float:
        azimuth = -2 * np.pi * (slots.share + self.phase)
        beam = slots.number % len(self.elevation_deg)
        return _pointing(azimuth, np.radians(self.elevation_deg)[beam])


@dataclass(frozen=True)
class Raster:
    """A fast mirror swings from side to side while a slow one goes from top to bottom, once in a
    sweep. No two pulses of a sweep share an elevation.

    width_deg, height_deg: the field of view, its middle straight ahead. lines_per_s: swings, each
    to one side.
    """

    width_deg: float
    height_deg: float
    lines_per_s: int
    pulses_per_s: int

    def num_pulses(self, period_s: float) -> int:
        return int(self.pulses_per_s * period_s + 1e-6)

    def directions(self, slots: Slots) -> Float:
        line = slots.number * (self.lines_per_s / self.pulses_per_s)
        across = 1 - np.abs(line % 2 - 1)  # 0 to 1 and back
        azimuth = np.radians(self.width_deg) * (0.5 - across)
        return _pointing(azimuth, np.radians(self.height_deg) * -slots.share)


@dataclass(frozen=True)
class Rosette:
    """Two prisms of equal power that turn at different rates draw a rose around the forward axis,
    which goes on from sweep to sweep and does not repeat (as in Livox's scanners).

    width_deg: of the round field of view. turns_per_s: of the two prisms; their difference is how
    often a petal is drawn, their sum how fast petals turn.
    """

    width_deg: float
    turns_per_s: tuple[float, float]
    pulses_per_s: int

    def num_pulses(self, period_s: float) -> int:
        return int(self.pulses_per_s * period_s + 1e-6)

    def directions(self, slots: Slots) -> Float:
        one, other = (np.pi * rate * slots.time_s for rate in self.turns_per_s)
        off_axis = np.radians(self.width_deg / 2) * np.cos(one - other)
        roll = one + other
        return np.stack(
            [
                np.cos(off_axis),
                np.sin(off_axis) * np.cos(roll),
                np.sin(off_axis) * np.sin(roll),
            ],
            axis=1,
        )


def _pointing(azimuth: Float, elevation: Float) -> Float:
    """(N,) rad each -> (N,3) unit vectors."""
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
