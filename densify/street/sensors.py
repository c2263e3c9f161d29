# SPDX-License-Identifier: MIT
"""The scanners: which beams they have, and when each fires."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.types import Float, Int

PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class Sensor:
    """One or two rotating scanners.

    elevation_deg: of one scanner's beams in the order they fire. num_columns: firings of each beam
    per revolution. max_range_m, range_sigma_m: reach and noise. heights_m: of each scanner above
    the first; they turn evenly out of phase.
    """

    name: str
    elevation_deg: tuple[float, ...]
    num_columns: int
    max_range_m: float
    range_sigma_m: float
    heights_m: tuple[float, ...] = (0.0,)

    @property
    def origins_m(self) -> Float:
        """(S,3) where the rays of each scanner start, lidar axes."""
        return np.array([[0.0, 0.0, height_m] for height_m in self.heights_m])


def _upward(*parts: Float) -> tuple[float, ...]:
    return tuple(float(e) for e in np.concatenate(parts))


_VLP32_DEG = (
    -25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333,
    -3.0, -2.667, -2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0,
    1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0,
)  # fmt: skip

SENSORS: dict[str, Sensor] = {
    s.name: s
    for s in (
        # two blocks of 32 lasers, the upper one with a third of a degree between beams
        Sensor(
            "hdl64",
            _upward(np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.33, 32)),
            2083,
            100.0,
            0.018,
        ),
        Sensor("hdl32", _upward(np.linspace(10.67, -30.67, 32)), 2169, 90.0, 0.02),
        Sensor("vlp16", _upward(np.linspace(15.0, -15.0, 16)), 1800, 100.0, 0.025),
        Sensor("dual32", _VLP32_DEG, 1800, 120.0, 0.022, (0.0, 0.25)),
    )
}


def sensor_named(name: str) -> Sensor:
    """Raises InputError for a name that does not exist."""
    if name not in SENSORS:
        raise InputError(f"sensor {name!r}: no such sensor; there are {', '.join(SENSORS)}")
    return SENSORS[name]


@dataclass(frozen=True)
class Firings:
    """The N pulses of a revolution in the order of time.

    direction: (N,3) unit vectors, lidar axes. offset_ns: (N,) int64 from the reference time.
    lidar: (N,) uint8. height_m: (N,) of the scanner above the first one.
    """

    direction: Float
    offset_ns: Int
    lidar: NDArray[np.uint8]
    height_m: Float


def firings(sensor: Sensor) -> Firings:
    """All pulses of one revolution.

    The first scanner turns clockwise seen from above, from looking back through forward at offset
    0 to back again: ``offset = -azimuth / 2π`` of a period. Beams fire one after the other, never
    two at once, so every pulse has its own azimuth.
    """
    beams, scanners = len(sensor.elevation_deg), len(sensor.heights_m)
    slot = np.arange(sensor.num_columns * beams, dtype=np.int64)
    offset_ns = np.tile(-PERIOD_NS // 2 + slot * PERIOD_NS // len(slot), scanners)
    lidar = np.repeat(np.arange(scanners), len(slot))
    azimuth = -2 * np.pi * (offset_ns / PERIOD_NS + lidar / scanners)
    elevation = np.radians(np.tile(sensor.elevation_deg, sensor.num_columns * scanners))
    direction = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    order = np.argsort(offset_ns, kind="stable")
    height_m = np.array(sensor.heights_m)[lidar]
    return Firings(
        direction[order], offset_ns[order], lidar[order].astype(np.uint8), height_m[order]
    )
