# SPDX-License-Identifier: MIT
"""Find the meaning of a point cloud's fields by their names, and of times also by their values.

Velodyne's ``time`` are seconds since the stamp, Ouster's ``t`` nanoseconds, Hesai's and RoboSense's
``timestamp`` seconds since 1970, Livox's ``offset_time`` nanoseconds. The span of the times of a
sweep tells the unit, because units differ by a factor of 1000 and a sweep takes about one period.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32, Int
from densify.readers.file_sequence import Returns

UNIT_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
REFERENCES = ("start", "middle", "end")

_NAMES = {
    "x": "x",
    "y": "y",
    "z": "z",
    "intensity": "intensity intensities reflectance reflectivity remission i signal "
    "scalar_intensity amplitude",
    "time": "time t timestamp time_stamp offset_time time_offset timeoffset offset_ns offset_us "
    "time_us time_ns stamp gps_time scalar_time",
    "ring": "ring line channel laser_id laser_number laserid beam scalar_ring",
    "lidar": "lidar lidar_id scanner sensor_id scanner_channel",
}
_SHORTEST_SHARE, _LONGEST_SHARE = 0.08, 4.0  # of a period that the times of a sweep span
_SAME_CLOCK_NS = 2_000_000_000
_RELATIVE_NS = 3_000_000_000
_FULL_SCALES = (1.0, 255.0, 65535.0)


@dataclass(frozen=True)
class Fields:
    """The name of the field for each part, "" for none."""

    x: str = ""
    y: str = ""
    z: str = ""
    intensity: str = ""
    time: str = ""
    ring: str = ""
    lidar: str = ""


def find_fields(names: Collection[str]) -> Fields:
    """Return the fields by their names, in any case. Of several for one part, the first counts."""
    lower = {name.lower(): name for name in reversed(list(names))}
    found = {
        part: next((lower[name] for name in known.split() if name in lower), "")
        for part, known in _NAMES.items()
    }
    return Fields(**found)


@dataclass(frozen=True)
class PointTimes:
    """The meaning of a field of times.

    Attributes:
        unit: A key of `UNIT_NS`.
        absolute: The times count from an epoch, not from the stamp of the sweep.
        other_clock: Absolute times have another epoch than the stamps.
        reference: The moment of the sweep at its stamp, one of `REFERENCES`; "" if the times
            say it.
    """

    field: str
    unit: str
    absolute: bool
    other_clock: bool = False
    reference: str = ""

    def offset_ns(self, values: NDArray[Any], stamp_ns: int) -> Int:
        """Return (N,) int64 times since the stamp of the sweep, of (N,) values of the field."""
        if not len(values):
            return np.zeros(0, np.int64)
        unit_ns = UNIT_NS[self.unit]
        values, zero = widened(values), 0
        if self.absolute and not self.other_clock and not self.reference:
            whole = int(np.floor(values.min()))  # so that no float holds an epoch's nanoseconds
            values, zero = values - values.dtype.type(whole), whole * unit_ns - stamp_ns
        elif self.absolute or self.reference:
            low, high = values.min(), values.max()
            share = {"": 0, "start": 0, "middle": 0.5, "end": 1}[self.reference]
            values = values - (low + values.dtype.type(share * (high - low)))
        return np.rint(values * unit_ns).astype(np.int64) + zero

    def __str__(self) -> str:
        text = f"{self.field} in {self.unit}, " + ("absolute" if self.absolute else "relative")
        if self.other_clock and not self.reference:
            text += ", by another clock than the stamps: the first point is taken for the stamp's"
        return text + (f", the stamp is the {self.reference}" if self.reference else "")


def widened(values: NDArray[Any]) -> NDArray[Any]:
    """Return int64 or float64, whichever holds the values."""
    return values.astype(np.float64 if values.dtype.kind == "f" else np.int64)


def find_times(
    values: NDArray[Any],
    field: str,
    period_ns: int,
    stamp_ns: int | None,
    unit: str = "",
    absolute: bool | None = None,
    reference: str = "",
) -> tuple[PointTimes | None, str]:
    """Return how a field tells the times of points, and the finding in words.

    Without a meaning, return None and the reason.

    Args:
        values: (N,) of one sweep.
        field: Name of the field.
        period_ns: Time from sweep to sweep.
        stamp_ns: Stamp of the sweep, None without one.
        unit: The unit, "" if unknown.
        absolute: As in `PointTimes`, None if unknown.
        reference: As in `PointTimes`, "" if unknown.
    """
    times = widened(values)
    times = times[np.isfinite(times)]
    span = times.max() - times.min() if len(times) else 0
    if not span:
        return None, f"{field} is the same for all points, so it does not tell their times"
    if values.dtype.kind == "f" and np.spacing(np.abs(values).max()) * 500 > span:
        digits = np.finfo(values.dtype).precision
        return None, (
            f"{field} has too few digits ({digits}) to tell times: {times.min():.10g} to "
            f"{times.max():.10g}"
        )
    share = {u: float(span) * ns / period_ns for u, ns in UNIT_NS.items()}
    fit = [unit] if unit else [u for u in share if _SHORTEST_SHARE < share[u] < _LONGEST_SHARE]
    if not fit:
        return None, (
            f"{field} spans {float(span):.6g} in a sweep, which in no unit is about the "
            f"{1e-6 * period_ns:.0f} ms from sweep to sweep; name its unit"
        )
    unit = fit[0]
    away_ns = float(np.abs(times).max()) * UNIT_NS[unit]
    if absolute is None:
        absolute = away_ns > _RELATIVE_NS
    first_ns = int(float(times.min()) * UNIT_NS[unit])
    other = absolute and (stamp_ns is None or abs(first_ns - stamp_ns) > _SAME_CLOCK_NS)
    found = PointTimes(field, unit, absolute, other, reference)
    return found, str(found)


def full_scale(intensity: NDArray[Any]) -> float:
    """Return the divisor that scales intensities to 0 to 1: 1, 255, 65535, or the maximum."""
    greatest = float(np.nanmax(intensity, initial=0.0))
    return next((scale for scale in _FULL_SCALES if greatest <= scale), greatest)


def scaled(intensity: NDArray[Any], scale: float) -> Float32:
    """Return intensities of 0 to 1, clipped; 0 where they are not finite."""
    share = np.nan_to_num(intensity.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0) / scale
    return np.clip(share, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class PointLayout:
    """The meaning of the fields of a sensor's sweeps, found in one of them.

    Attributes:
        times: Meaning of the times, None if no field has them.
        time_words: The finding about times, in words.
        intensity_scale: Intensity of full brightness.
    """

    fields: Fields
    times: PointTimes | None
    time_words: str
    intensity_scale: float

    @staticmethod
    def find(
        columns: Mapping[str, NDArray[Any]],
        where: Path | str,
        period_ns: int,
        stamp_ns: int | None,
        named: Mapping[str, str] | None = None,
        intensity_scale: float = 0.0,
        **times: Any,
    ) -> PointLayout:
        """Return the layout of a sweep's columns (N,).

        Args:
            named: Fields by their part.
            intensity_scale: 0 to find it.
            times: Known properties of the times, see `find_times`.

        Raises:
            InputError: There is no x, y or z.
        """
        fields = Fields(**(vars(find_fields(columns)) | dict(named or {})))
        missing = [axis for axis in "xyz" if not getattr(fields, axis)]
        if missing:
            raise InputError(
                f"{where}: no column {', '.join(missing)}: got {', '.join(columns)}; in a plain "
                f"folder name them in densify.yaml: sweeps: {{columns: [x, y, z, ...]}}"
            )
        found, words = None, "none: no column of that kind"
        if fields.time:
            found, words = find_times(
                columns[fields.time], fields.time, period_ns, stamp_ns, **times
            )
        if fields.intensity and not intensity_scale:
            intensity_scale = full_scale(columns[fields.intensity])
        return PointLayout(fields, found, words, intensity_scale or 1.0)

    def returns(
        self, columns: Mapping[str, NDArray[Any]], where: Path | str, stamp_ns: int
    ) -> tuple[Returns, Bool]:
        """Return the rows of a sweep of that stamp, and a mask (N,) of the valid ones.

        Raises:
            InputError: A field of the first sweep is missing, or a valid point has no time.
        """
        missing = [name for name in vars(self.fields).values() if name and name not in columns]
        if missing:
            raise InputError(
                f"{where}: no column {missing[0]}, which other sweeps have; got "
                f"{', '.join(columns)}"
            )
        axes = (self.fields.x, self.fields.y, self.fields.z)
        points = np.column_stack([columns[name] for name in axes]).astype(np.float64)
        valid: Bool = np.logical_and(np.isfinite(points).all(axis=1), points.any(axis=1))
        intensity, offset_ns = None, None
        if self.fields.intensity:
            intensity = scaled(columns[self.fields.intensity], self.intensity_scale)
        if self.times is not None:
            values = columns[self.times.field][valid]
            if not np.isfinite(values).all():
                raise InputError(
                    f"{where}: {self.times.field}: got a time that is not finite beside a point"
                )
            offset_ns = np.zeros(len(points), np.int64)
            offset_ns[valid] = self.times.offset_ns(values, stamp_ns)
        return Returns(points, intensity, offset_ns), valid
