# SPDX-License-Identifier: MIT
"""Define the simulated sensors: their scanners, and every pulse of a sweep.

A scan pattern has ``num_pulses(period_s)`` and ``directions(slots)`` in the scanner's axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float, Int


class Slots(NamedTuple):
    """The N pulses of a sweep in the order of time."""

    number: Int  # (N,) int64 index of the pulse, from 0
    share: Float  # (N,) firing time minus the reference time, in periods, -0.5 to 0.5
    # (N,) firing time in seconds since frame 0, for patterns that continue from sweep to sweep
    time_s: Float


@dataclass(frozen=True)
class Spinning:
    """A pattern that spins once a sweep, clockwise from above, forward at the reference time."""

    # Beams in firing order, never two at once: every pulse has an azimuth of its own
    elevation_deg: tuple[float, ...]
    # Firings per second of each beam. A revolution at 20 Hz has half the columns of a revolution at
    # 10 Hz.
    columns_per_s: int
    phase: float = 0.0  # lead in turns over a scanner that faces forward at the reference time

    def num_pulses(self, period_s: float) -> int:
        """Return the number of pulses in a sweep."""
        return int(self.columns_per_s * period_s + 1e-6) * len(self.elevation_deg)

    def directions(self, slots: Slots) -> Float:
        """Return (N,3) unit vectors in the axes of the scanner."""
        azimuth = -2 * np.pi * (slots.share + self.phase)
        beam = slots.number % len(self.elevation_deg)
        return _pointing(azimuth, np.radians(self.elevation_deg)[beam])


@dataclass(frozen=True)
class _Steady:
    """A pattern of ``pulses_per_s`` pulses evenly spaced in time."""

    pulses_per_s: int

    def num_pulses(self, period_s: float) -> int:
        return int(self.pulses_per_s * period_s + 1e-6)


@dataclass(frozen=True)
class Raster(_Steady):
    """A scan pattern that covers a rectangle, line by line, by a fast and a slow mirror."""

    # No two pulses of a sweep have the same elevation.
    width_deg: float  # width of the field of view, with its centre straight ahead
    height_deg: float  # height of the field of view
    lines_per_s: int  # swings of the fast mirror per second, counting each direction

    def directions(self, slots: Slots) -> Float:
        """Return (N,3) unit vectors in the axes of the scanner."""
        line = slots.number * (self.lines_per_s / self.pulses_per_s)
        across = 1 - np.abs(line % 2 - 1)  # 0 to 1 and back
        azimuth = np.radians(self.width_deg) * (0.5 - across)
        return _pointing(azimuth, np.radians(self.height_deg) * -slots.share)


@dataclass(frozen=True)
class Rosette(_Steady):
    """A scan pattern of two equal prisms: a rose that never repeats, as in Livox's scanners."""

    width_deg: float  # diameter of the round field of view
    # Rotation rates of the two prisms. Petals are drawn at the difference of the rates and turn at
    # their sum.
    turns_per_s: tuple[float, float]

    def directions(self, slots: Slots) -> Float:
        """Return (N,3) unit vectors in the axes of the scanner."""
        one, other = (np.pi * rate * slots.time_s for rate in self.turns_per_s)
        off_axis = np.radians(self.width_deg / 2) * np.cos(one - other)
        roll, flat = one + other, np.sin(off_axis)
        return np.stack([np.cos(off_axis), flat * np.cos(roll), flat * np.sin(roll)], axis=1)


def _pointing(azimuth: Float, elevation: Float) -> Float:
    """Return (N,3) unit vectors from (N,) azimuths and (N,) elevations in rad."""
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


@dataclass(frozen=True)
class Scanner:
    """One scanner of a sensor."""

    pattern: Spinning | Raster | Rosette
    max_range_m: float  # greatest range
    range_sigma_m: float  # standard deviation of the range noise
    # (3,) position of the scanner, lidar frame
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """One or several scanners whose returns form one sweep."""

    name: str
    scanners: tuple[Scanner, ...]

    def each(self, field: str) -> Float:
        """Return the values of a field for all S scanners, (S,) or (S,3)."""
        return np.array([getattr(scanner, field) for scanner in self.scanners], np.float64)

    @property
    def origins_m(self) -> Float:
        """(S,3) positions of the scanners, lidar frame."""
        return self.each("origin_m")

    @property
    def azimuth_tells_time(self) -> bool:
        """True if azimuth determines firing time: one scanner that spins about the origin."""
        first = self.scanners[0]
        spins = isinstance(first.pattern, Spinning)
        return len(self.scanners) == 1 and spins and not any(first.origin_m)


def _beams(*parts: NDArray[Any]) -> tuple[float, ...]:
    return tuple(np.concatenate(parts).tolist())


def _widening(first_deg: float, last_deg: float, num: int) -> Float:
    """Return (num,) elevations from next to ``first_deg`` to ``last_deg``, with growing steps."""
    return first_deg + (last_deg - first_deg) * (np.arange(1, num + 1) / num) ** 1.5


_VLP32_DEG = (
    -25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333,
    -3.0, -2.667, -2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0,
    1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0,
)  # fmt: skip
# two blocks of 32 lasers, the upper one with a third of a degree between beams
_HDL64_DEG = _beams(np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.33, 32))
# like the Pandar64: a sixth of a degree apart in the middle, 6 degrees at the lower end
_PANDAR64_DEG = _beams(
    np.array([15.0, 11.0, 8.0, 5.0, 3.0]),
    np.linspace(2.0, -6.0, 49),
    np.linspace(-7.0, -14.0, 8),
    np.array([-19.0, -25.0]),
)
# like the VLS-128: 0.11 degrees apart in the middle, 0.18 beside it, 1.1 at the lower end
_VLS128_DEG = _beams(
    _widening(5.2, 15.0, 14)[::-1],
    np.arange(20, 0, -1) * 0.18 + 1.6,
    np.linspace(1.6, -3.9, 51),
    -3.9 - np.arange(1, 21) * 0.18,
    _widening(-7.5, -25.0, 23),
)
_HDL64 = Spinning(_HDL64_DEG, 20830)
_HDL32 = Spinning(_beams(np.linspace(10.67, -30.67, 32)), 21690)
_VLP16 = Spinning(_beams(np.linspace(15.0, -15.0, 16)), 18000)
_OS128 = Spinning(_beams(np.linspace(22.5, -22.5, 128)), 10240)  # 1024 columns at 10 Hz
_VLS128 = Spinning(_VLS128_DEG, 18000)
_PANDAR64 = Spinning(_PANDAR64_DEG, 18000)
_PANDAR_GT = Raster(400_000, 60.0, 20.0, 1000)
_LIVOX = Rosette(200_000, 70.0, (121.6, -77.7))  # prisms at 7294 and -4664 turns a minute

SENSORS: dict[str, Sensor] = {
    name: Sensor(name, scanners)
    for name, scanners in {
        "hdl64": (Scanner(_HDL64, 100.0, 0.018),),
        "hdl32": (Scanner(_HDL32, 90.0, 0.02),),
        "vlp16": (Scanner(_VLP16, 100.0, 0.025),),
        # as Argoverse 2's: one above the other, half a turn apart
        "dual32": (
            Scanner(Spinning(_VLP32_DEG, 18000), 120.0, 0.022),
            Scanner(Spinning(_VLP32_DEG, 18000, 0.5), 120.0, 0.022, (0.0, 0.0, 0.25)),
        ),
        "os128": (Scanner(_OS128, 120.0, 0.02),),
        "vls128": (Scanner(_VLS128, 150.0, 0.02),),
        # as PandaSet's: one on the roof, and one in front of it, 0.6 m lower, that only looks ahead
        "panda": (
            Scanner(_PANDAR64, 120.0, 0.02, (0.2, -0.2, 0.1)),
            Scanner(_PANDAR_GT, 150.0, 0.02, (1.7, -0.2, -0.5)),
        ),
        # the same two exactly as far apart as on PandaSet's vehicle
        "pandaset": (
            Scanner(_PANDAR64, 120.0, 0.02),
            Scanner(_PANDAR_GT, 150.0, 0.02, (0.58, 0.027, -0.294)),
        ),
        "rosette": (Scanner(_LIVOX, 120.0, 0.02),),
    }.items()
}


@dataclass(frozen=True)
class Firings:
    """The N pulses of a sweep in the order of time."""

    direction: Float  # (N,3) unit vectors, lidar axes
    offset_ns: Int  # (N,) int64 firing time minus the reference time
    lidar: NDArray[np.uint8]  # (N,) uint8 index of the scanner


def firings(sensor: Sensor, time_s: float, period_ns: int) -> Firings:
    """Return all pulses of the sweep that lasts ``period_ns`` around ``time_s``, evenly in time."""
    parts = []
    for index, scanner in enumerate(sensor.scanners):
        num = scanner.pattern.num_pulses(period_ns * 1e-9)
        number = np.arange(num, dtype=np.int64)
        offset_ns = -period_ns // 2 + number * period_ns // num
        share: Float = offset_ns / period_ns
        slots = Slots(number, share, time_s + share * period_ns * 1e-9)
        lidar = np.full(num, index, np.uint8)
        parts.append((scanner.pattern.directions(slots), offset_ns, lidar))
    direction, offset_ns, lidar = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(offset_ns, kind="stable")
    return Firings(direction[order], offset_ns[order], lidar[order])
