# SPDX-License-Identifier: MIT
"""Find the meaning of a point cloud's fields by their names, and of times also by their values.

Velodyne's ``time`` are seconds since the stamp, Ouster's ``t`` nanoseconds, Hesai's and RoboSense's
``timestamp`` seconds since 1970, Livox's ``offset_time`` nanoseconds. The span of the times of a
sweep tells the unit, because units differ by a factor of 1000 and a sweep takes about one period.
Points whose time cannot be of their sweep are left out and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32, Int
from densify.readers.file_sequence import Returns

K = TypeVar("K")
Columns = Mapping[str, NDArray[Any]]
"""The fields of a sweep's points by name, (N,) each."""

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
_NUM_SAMPLED = 5
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
        middle_ns: Usual middle of a sweep since its stamp; with another clock each sweep has its
            own.
        reach_ns: Largest distance of a right time from the middle.
        reference: The moment of the sweep at its stamp, one of `REFERENCES`; "" if the times
            say it.
    """

    field: str
    unit: str
    absolute: bool
    other_clock: bool
    middle_ns: int
    reach_ns: int
    reference: str

    def offset_ns(self, values: NDArray[Any], stamp_ns: int) -> tuple[Int, Bool]:
        """Return the times of points since the stamp of their sweep.

        Args:
            values: (N,) of the field.

        Returns:
            (N,) int64, 0 for times that cannot be right, and a mask (N,) of those that can.
        """
        right = self._right(values, stamp_ns)
        offset_ns = np.zeros(len(values), np.int64)
        if right.any():
            near = widened(values[right])
            zero, zero_ns = self._zero(near)
            since_ns = np.rint((near - near.dtype.type(zero)) * UNIT_NS[self.unit])
            is_of_stamp = self.absolute and not self.other_clock and not self.reference
            offset_ns[right] = since_ns.astype(np.int64) + is_of_stamp * (zero_ns - stamp_ns)
        return offset_ns, right

    def own_stamp_ns(self, values: NDArray[Any]) -> int | None:
        """Return the stamp of a sweep with these absolute times (N,), None if no time is finite.

        It is that of the first point, or the moment of `reference`.
        """
        right = self._right(values, None)
        if not right.any():
            return None
        near = widened(values[right])
        return self._zero(near)[1] if self.reference else self._in_ns(near.min())

    def _right(self, values: NDArray[Any], stamp_ns: int | None) -> Bool:
        """Return a mask (N,) of the times within `reach_ns` of the middle of the sweep.

        Args:
            stamp_ns: None for a sweep without a stamp.
        """
        times_ns = values.astype(np.float64) * UNIT_NS[self.unit]
        middle_ns = self.middle_ns + ((stamp_ns or 0) if self.absolute else 0.0)
        if (self.other_clock or stamp_ns is None) and np.isfinite(times_ns).any():
            middle_ns, _ = _extent(times_ns)
        right: Bool = np.abs(times_ns - middle_ns) <= self.reach_ns
        return right

    def _zero(self, near: NDArray[Any]) -> tuple[Any, int]:
        """Return the origin of the offsets of a sweep's right times (M,).

        It is given in the unit of the field, and in nanoseconds.
        """
        low, high = near.min(), near.max()
        if self.reference or self.other_clock:
            share = {"": 0, "start": 0, "middle": 0.5, "end": 1}[self.reference]
            zero = low + near.dtype.type(share * (high - low))
        else:
            zero = near.dtype.type(np.floor(low) if self.absolute else 0)
        return zero, self._in_ns(zero)

    def _in_ns(self, time: Any) -> int:
        """Return a time in nanoseconds, through no float that holds an epoch's nanoseconds."""
        whole = int(time)
        return whole * UNIT_NS[self.unit] + round(float(time - whole) * UNIT_NS[self.unit])

    def __str__(self) -> str:
        text = f"{self.field} in {self.unit}, " + ("absolute" if self.absolute else "relative")
        if self.other_clock and not self.reference:
            text += ", by another clock than the stamps: the first point is taken for the stamp's"
        return text + (f", the stamp is the {self.reference}" if self.reference else "")


def widened(values: NDArray[Any]) -> NDArray[Any]:
    """Return int64 or float64, whichever holds the values."""
    return values.astype(np.float64 if values.dtype.kind == "f" else np.int64)


def _extent(times: NDArray[Any]) -> tuple[float, float]:
    """Return the middle of a sweep's times (N,), and their reach on each side of it.

    Times far from most do not count: farther from the middle of the closest half than twice the
    width of that half.
    """
    times = np.sort(times[np.isfinite(times)].astype(np.float64))
    half = len(times) // 2
    width = times[half:] - times[: len(times) - half]
    first = int(np.argmin(width))
    middle, reach = times[first] + width[first] / 2, 2 * width[first]
    most = times[np.abs(times - middle) <= reach]
    return float(most[0] + most[-1]) / 2, float(most[-1] - most[0]) / 2


def sample_columns(sweeps: Sequence[K], read: Callable[[K], Columns]) -> dict[K, Columns]:
    """Return the columns of a few sweeps with points, from all over a recording.

    Args:
        read: Returns the columns of one sweep.

    Raises:
        InputError: None of the sweeps can be read.
    """
    found, errors = dict[K, Columns](), list[InputError]()
    for sweep in sweeps[:: max(1, len(sweeps) // _NUM_SAMPLED)][:_NUM_SAMPLED]:
        try:
            columns = read(sweep)
        except InputError as error:
            errors.append(error)
            continue
        if len(next(iter(columns.values()), ())):
            found[sweep] = columns
    if errors and not found:
        raise errors[0]
    return found


def find_times(
    sweeps: Sequence[NDArray[Any]],
    field: str,
    period_ns: int,
    stamps_ns: Sequence[int] | None,
    unit: str = "",
    absolute: bool | None = None,
    reference: str = "",
) -> tuple[PointTimes | None, str]:
    """Return how a field tells the times of points, and the finding in words.

    Without a meaning, return None and the reason. The recording decides, not one sweep: the unit is
    that of most sweeps, the extent their median.

    Args:
        sweeps: (N,) of each of some sweeps.
        field: Name of the field.
        period_ns: Time from sweep to sweep.
        stamps_ns: Stamps of these sweeps, None without stamps.
        unit: The unit, "" if unknown.
        absolute: As in `PointTimes`, None if unknown.
        reference: As in `PointTimes`, "" if unknown.
    """
    told = [_unit_of(values, field, period_ns, unit) for values in sweeps]
    units = Counter(found for found, _ in told)
    unit = max(units, key=lambda found: (units[found], found != ""))
    if not unit:
        return None, next(words for found, words in told if not found)
    rows = [row for row, (found, _) in enumerate(told) if found == unit]
    unit_ns = UNIT_NS[unit]
    extents = np.array([_extent(sweeps[row].astype(np.float64) * unit_ns) for row in rows])
    middle_ns, reach_ns = extents.T
    usual_ns = float(np.median(middle_ns))
    if absolute is None:
        advance_ns = float(np.median(np.abs(middle_ns - usual_ns)))
        absolute = abs(usual_ns) > _RELATIVE_NS or advance_ns > period_ns / 2
    if absolute and stamps_ns is not None:
        middle_ns = middle_ns - np.array([stamps_ns[row] for row in rows], np.float64)
        usual_ns = float(np.median(middle_ns))
    elif absolute:  # the stamps are made of these times
        usual_ns = {"middle": 0, "end": -1}.get(reference, 1) * float(np.median(reach_ns))
    found = PointTimes(
        field,
        unit,
        absolute,
        other_clock=absolute and abs(usual_ns) > _SAME_CLOCK_NS,
        middle_ns=round(usual_ns),
        reach_ns=round(float(np.median(reach_ns))) + period_ns,
        reference=reference,
    )
    return found, str(found)


def _unit_of(values: NDArray[Any], field: str, period_ns: int, unit: str) -> tuple[str, str]:
    """Return the unit of a sweep's times (N,), or "" and the reason.

    Args:
        unit: "" to find the one in which they take about a period.
    """
    times = widened(values)
    times = times[np.isfinite(times)]
    middle, reach = _extent(times) if len(times) else (0.0, 0.0)
    span = float(np.ptp(times)) if len(times) else 0.0
    if values.dtype.kind == "f" and np.spacing(values.dtype.type(abs(middle))) * 500 > span > 0:
        digits = np.finfo(values.dtype).precision
        return "", (
            f"{field} has too few digits ({digits}) to tell times: {middle - reach:.10g} to "
            f"{middle + reach:.10g}"
        )
    if not reach:
        most = "most" if span else "all"
        return "", f"{field} is the same for {most} points, so it does not tell their times"
    share = {u: 2 * reach * ns / period_ns for u, ns in UNIT_NS.items()}
    fit = [unit] if unit else [u for u in share if _SHORTEST_SHARE < share[u] < _LONGEST_SHARE]
    if not fit:
        return "", (
            f"{field} spans {2 * reach:.6g} in a sweep, which in no unit is about the "
            f"{1e-6 * period_ns:.0f} ms from sweep to sweep; name its unit"
        )
    return fit[0], ""


def full_scale(intensity: NDArray[Any]) -> float:
    """Return the divisor that scales intensities to 0 to 1.

    It is 1, 255, 65535, or the largest finite intensity.
    """
    greatest = float(np.max(intensity, initial=0.0, where=np.isfinite(intensity)))
    return next((scale for scale in _FULL_SCALES if greatest <= scale), greatest)


def scaled(intensity: NDArray[Any], scale: float) -> Float32:
    """Return intensities of 0 to 1, clipped; 0 where they are not finite."""
    share = np.nan_to_num(intensity.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0) / scale
    return np.clip(share, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class PointLayout:
    """The meaning of the fields of a sensor's sweeps, found in some of them.

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
        sweeps: Sequence[Columns],
        where: Path | str,
        period_ns: int,
        stamps_ns: Sequence[int] | None,
        named: Mapping[str, str] | None = None,
        intensity_scale: float = 0.0,
        **times: Any,
    ) -> PointLayout:
        """Return the layout of the columns (N,) of some sweeps.

        Args:
            stamps_ns: Stamps of these sweeps, None without stamps.
            named: Fields by their part.
            intensity_scale: 0 to find it.
            times: Known properties of the times, see `find_times`.

        Raises:
            InputError: There is no x, y or z.
        """
        fields = Fields(**(vars(find_fields(sweeps[0])) | dict(named or {})))
        missing = [axis for axis in "xyz" if not getattr(fields, axis)]
        if missing:
            raise InputError(
                f"{where}: no column {', '.join(missing)}: got {', '.join(sweeps[0])}; in a plain "
                f"folder name them in densify.yaml: sweeps: {{columns: [x, y, z, ...]}}"
            )
        alike = [row for row, columns in enumerate(sweeps) if columns.keys() == sweeps[0].keys()]
        found, words = None, "none: no column of that kind"
        if fields.time:
            values = [sweeps[row][fields.time] for row in alike]
            stamps_ns = None if stamps_ns is None else [stamps_ns[row] for row in alike]
            found, words = find_times(values, fields.time, period_ns, stamps_ns, **times)
        if fields.intensity and not intensity_scale:
            intensity_scale = max(full_scale(sweeps[row][fields.intensity]) for row in alike)
        return PointLayout(fields, found, words, intensity_scale or 1.0)

    def returns(self, columns: Columns, where: Path | str, stamp_ns: int) -> tuple[Returns, Bool]:
        """Return the rows of a sweep of that stamp, and a mask (N,) of the valid ones.

        A valid row has a finite position and a time that can be right. The others are at 0 0 0.

        Raises:
            InputError: A field of the first sweep is missing.
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
        if self.fields.lidar:
            valid &= np.isfinite(columns[self.fields.lidar])
        intensity, offset_ns, num_untimed = None, None, 0
        if self.fields.intensity:
            intensity = scaled(columns[self.fields.intensity], self.intensity_scale)
        if self.times is not None:
            values = columns[self.times.field][valid]
            if len(values) and (values != values[0]).any():  # else this sweep has no times
                offset_ns = np.zeros(len(points), np.int64)
                offset_ns[valid], right = self.times.offset_ns(values, stamp_ns)
                valid[valid], num_untimed = right, int((~right).sum())
        points[~valid] = 0
        return Returns(points, intensity, offset_ns, num_untimed=num_untimed), valid
