# SPDX-License-Identifier: MIT
"""Find the meaning of a point cloud's fields by their names, and of times also by their values.

Units differ by a factor of 1000 and a sweep takes about one period, so the span of a sweep's times
tells their unit: Velodyne's ``time`` is in s since the stamp, Ouster's ``t`` and Livox's
``offset_time`` in ns, Hesai's and RoboSense's ``timestamp`` in s since 1970.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32, Int
from densify.readers.file_sequence import Returns

K = TypeVar("K")
Columns = Mapping[str, NDArray[Any]]
"""Fields of a sweep's N points by name, an array (N,) each."""

UNIT_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
REFERENCES = ("start", "middle", "end")

_NAMES = {
    "x": "x",
    "y": "y",
    "z": "z",
    "intensity": "intensity intensities reflectance reflectivity remission i signal amplitude",
    "time": "time t timestamp time_stamp offset_time time_offset timeoffset offset_ns offset_us "
    "time_us time_ns stamp gps_time gpstime",
    "ring": "ring line channel laser_id laser_number laserid beam",
    "lidar": "lidar lidar_id scanner sensor_id scanner_channel",
}
_SHORTEST, _LONGEST = 0.08, 4.0  # least and greatest accepted span of a sweep's times, in periods
_FEWEST_STEPS = 500  # least number of times within a sweep that the digits must distinguish
_NUM_SAMPLED = 5
_SAME_CLOCK_NS = 2_000_000_000
_RELATIVE_NS = 3_000_000_000
_LATEST_NS = 1 << 62  # the year 2116; differences of such times fit 64 bits
_FULL_SCALES = (1.0, 255.0, 65535.0)


def find_fields(names: Collection[str]) -> dict[str, str]:
    """Return the fields by the quantities that they hold, found by usual names in any case."""
    # CloudCompare puts scalar_ before the names of fields.
    lower = {name.lower().removeprefix("scalar_"): name for name in reversed(list(names))}
    field_of_quantity = {}
    for quantity, aliases in _NAMES.items():
        if known := [lower[name] for name in aliases.split() if name in lower]:
            field_of_quantity[quantity] = known[0]
    return field_of_quantity


@dataclass(frozen=True)
class PointTimes:
    """How to convert a field of point times to nanoseconds since the stamp of the sweep."""

    field: str  # name of the field
    unit: str  # unit of the times, one of `UNIT_NS`
    absolute: bool  # True if times count from an epoch, False if from the stamp of the sweep
    other_clock: bool  # True if the epoch of absolute times is not the epoch of the stamps
    # Typical middle of a sweep's times, since its stamp. It is not used with ``other_clock``, where
    # the middle is computed for each sweep.
    middle_ns: int
    reach_ns: int  # largest accepted distance of a time from the middle of its sweep
    # Part of the sweep measured at its stamp, one of `REFERENCES`; "" to use the times as they are
    reference: str

    def offset_ns(self, values: NDArray[Any], stamp_ns: int) -> tuple[Int, Bool]:
        """Return (N,) int64 ns since the stamp, 0 for invalid times, and a mask of valid times."""
        times_ns, is_valid = self._times_ns(values, stamp_ns)
        offset_ns = np.zeros(len(values), np.int64)
        if is_valid.any():
            zero_ns = stamp_ns if self.absolute else 0
            if self.reference or self.other_clock:
                zero_ns = self._reference_ns(times_ns[is_valid])
            offset_ns[is_valid] = times_ns[is_valid] - zero_ns
        return offset_ns, is_valid

    def own_stamp_ns(self, values: NDArray[Any]) -> int | None:
        """Return the stamp (ns) by a sweep's (N,) absolute times, or None if no time is valid."""
        times_ns, is_valid = self._times_ns(values, None)
        return self._reference_ns(times_ns[is_valid]) if is_valid.any() else None

    def _times_ns(self, values: NDArray[Any], stamp_ns: int | None) -> tuple[Int, Bool]:
        """Return (N,) times in ns, and a mask of times within `reach_ns` of the sweep's middle."""
        unit_ns = UNIT_NS[self.unit]
        with np.errstate(invalid="ignore"):
            is_valid: Bool = np.abs(values.astype(np.float64)) < _LATEST_NS / unit_ns
        values = np.where(is_valid, values, 0)
        whole = values.astype(np.int64)  # converted as integers, to keep every digit
        times_ns = whole * unit_ns + np.rint((values - whole) * unit_ns).astype(np.int64)
        middle_ns = self.middle_ns + (stamp_ns or 0) * self.absolute
        if (self.other_clock or stamp_ns is None) and is_valid.any():
            middle_ns = round(_extent(times_ns[is_valid])[0])
        return times_ns, is_valid & (np.abs(times_ns - middle_ns) <= self.reach_ns)

    def _reference_ns(self, times_ns: Int) -> int:
        """Return the part of a sweep's valid times (M,) that `reference` names, else the start."""
        start_ns, end_ns = int(times_ns.min()), int(times_ns.max())
        return {"middle": (start_ns + end_ns) // 2, "end": end_ns}.get(self.reference, start_ns)

    def __str__(self) -> str:
        text = f"{self.field} in {self.unit}, " + ("absolute" if self.absolute else "relative")
        if self.other_clock and not self.reference:
            text += ", by another clock than the stamps: the first point is taken for the stamp's"
        return text + (f", the stamp is the {self.reference}" if self.reference else "")


def _extent(times: NDArray[Any]) -> tuple[float, float]:
    """Return the middle of a sweep's times (N,) and half their span, without outlying times."""
    # The shortest interval that holds half of the times: times farther from its middle than twice
    # its width are outlying.
    times = np.sort(times.astype(np.float64))
    num_half = len(times) // 2
    widths = times[num_half:] - times[: len(times) - num_half]
    begin = int(np.argmin(widths))
    middle = times[begin] + widths[begin] / 2
    reach = 2 * widths[begin]
    inliers = times[np.abs(times - middle) <= reach]
    return float(inliers[0] + inliers[-1]) / 2, float(inliers[-1] - inliers[0]) / 2


def sample_columns(sweeps: Sequence[K], read: Callable[[K], Columns]) -> dict[K, Columns]:
    """Return the columns that ``read`` gives of up to 5 readable sweeps with points, spread out."""
    columns_of_sweep, errors = dict[K, Columns](), list[InputError]()
    for sweep in sweeps[:: max(1, len(sweeps) // _NUM_SAMPLED)][:_NUM_SAMPLED]:
        try:
            columns = read(sweep)
        except InputError as error:
            errors.append(error)
            continue
        if len(next(iter(columns.values()), ())):
            columns_of_sweep[sweep] = columns
    if errors and not columns_of_sweep:
        raise errors[0]
    return columns_of_sweep


class TimeField(NamedTuple):
    """The user's settings of a field of point times. `find_times` detects empty settings."""

    name: str
    unit: str = ""  # one of `UNIT_NS`
    absolute: bool | None = None  # as in `PointTimes`
    reference: str = ""  # as in `PointTimes`


def find_times(
    field: TimeField,
    sweeps: Sequence[NDArray[Any]],
    period_ns: int,
    stamps_ns: Sequence[int] | None,
) -> tuple[PointTimes | None, str]:
    """Return how to convert a field of point times, or None, and a description or the reason.

    Args:
        field: Name of the field, and the user's settings.
        sweeps: Values (N,) of the field in some sweeps.
        period_ns: Time between consecutive sweeps.
        stamps_ns: Stamp of each of these sweeps, None without stamps.
    """
    timed = [row for row, values in enumerate(sweeps) if np.isfinite(values).any()]
    finite = [sweeps[row][np.isfinite(sweeps[row])] for row in timed]
    extents = np.array([_extent(values) for values in finite] or [(0.0, 0.0)])
    middle, reach = np.median(extents, axis=0).tolist()
    span = max((float(np.ptp(values)) for values in finite), default=0.0)
    name, dtype = field.name, sweeps[0].dtype

    # Times that cannot be used: too few digits, all equal, or a span of no unit
    if dtype.kind == "f" and np.spacing(dtype.type(abs(middle))) * _FEWEST_STEPS > span > 0:
        return None, (
            f"{name} has too few digits ({np.finfo(dtype).precision}) to tell times: "
            f"{middle - reach:.10g} to {middle + reach:.10g}"
        )
    if not reach:
        quantifier = "most" if span else "all"
        return None, f"{name} is the same for {quantifier} points, so it does not tell their times"
    unit = field.unit or _unit_of(2 * reach / period_ns)
    if not unit or abs(middle) >= _LATEST_NS / UNIT_NS[unit]:
        return None, (
            f"{name} spans {2 * reach:.6g} in a sweep, which in no unit is about the "
            f"{1e-6 * period_ns:.0f} ms from sweep to sweep; name its unit"
        )
    middles_ns = extents[:, 0] * UNIT_NS[unit]
    middle_ns, reach_ns = middle * UNIT_NS[unit], reach * UNIT_NS[unit]

    # Absolute times are large or advance from sweep to sweep.
    absolute = field.absolute
    if absolute is None:
        advance_ns = float(np.median(np.abs(middles_ns - middle_ns)))
        absolute = abs(middle_ns) > _RELATIVE_NS or advance_ns > period_ns / 2

    # The middle of the times since the stamp
    if absolute and stamps_ns is not None:
        timed_ns = np.array([stamps_ns[row] for row in timed], np.float64)
        middle_ns = float(np.median(middles_ns - timed_ns))
    elif absolute:  # these times become the stamps: count from the stamped part of the sweep
        middle_ns = {"middle": 0, "end": -1}.get(field.reference, 1) * reach_ns
    point_times = PointTimes(
        name,
        unit,
        absolute,
        other_clock=absolute and abs(middle_ns) > _SAME_CLOCK_NS,
        middle_ns=round(middle_ns),
        reach_ns=round(reach_ns) + period_ns,
        reference=field.reference,
    )
    return point_times, str(point_times)


def _unit_of(span_in_periods: float) -> str:
    """Return the unit in which a span, over the period in ns, is 0.08 to 4 periods, else ""."""
    num_periods = {unit: span_in_periods * unit_ns for unit, unit_ns in UNIT_NS.items()}
    return next((unit for unit, num in num_periods.items() if _SHORTEST < num < _LONGEST), "")


def full_scale(intensity: NDArray[Any]) -> float:
    """Return the divisor that scales intensities to 0 to 1: 1, 255, 65535 or their maximum."""
    greatest = float(np.max(intensity, initial=0.0, where=np.isfinite(intensity)))
    return next((scale for scale in _FULL_SCALES if greatest <= scale), greatest)


def rescale(intensity: NDArray[Any], scale: float) -> Float32:
    """Return intensities divided by ``scale``, clipped to 0 to 1, and 0 for NaN and infinity."""
    finite = np.nan_to_num(intensity.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(finite / scale, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class PointLayout:
    """The meaning of the fields in a sensor's sweeps."""

    fields: Mapping[str, str]  # name of the field of each quantity, as in `find_fields`
    times: PointTimes | None  # meaning of the point times, None without usable times
    time_words: str  # description of the times, or the reason why there are none
    intensity_scale: float  # divisor that scales intensities to 0 to 1

    def __str__(self) -> str:
        return ", ".join(f"{quantity} = {name}" for quantity, name in self.fields.items())

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
        """Return the meaning of the fields, found in several sweeps of a sensor.

        Args:
            sweeps: Columns of each sweep by name.
            where: File, with which messages begin.
            period_ns: Time between consecutive sweeps.
            stamps_ns: Stamp of each sweep, None without stamps.
            named: Quantity -> name of its field, where the user states it.
            intensity_scale: Divisor of intensities that the user states, 0 to find it.
            **times: unit, absolute or reference that the user states, as in `TimeField`.
        """
        found = find_fields(sweeps[0]) | dict(named or {})
        fields = {quantity: found[quantity] for quantity in _NAMES if quantity in found}
        missing = [axis for axis in "xyz" if axis not in fields]
        if missing:
            raise InputError(
                f"{where}: no column {', '.join(missing)}: got {', '.join(sweeps[0])}; in a plain "
                f"folder name them in densify.yaml: sweeps: {{columns: [x, y, z, ...]}}"
            )
        alike = [row for row, columns in enumerate(sweeps) if columns.keys() == sweeps[0].keys()]
        point_times, words = None, "none: no column of that kind"
        if "time" in fields:
            values = [sweeps[row][fields["time"]] for row in alike]
            stamps_ns = None if stamps_ns is None else [stamps_ns[row] for row in alike]
            field = TimeField(fields["time"], **times)
            point_times, words = find_times(field, values, period_ns, stamps_ns)
        if "intensity" in fields and not intensity_scale:
            intensity_scale = max(full_scale(sweeps[row][fields["intensity"]]) for row in alike)
        return PointLayout(fields, point_times, words, intensity_scale or 1.0)

    def returns(self, columns: Columns, where: Path | str, stamp_ns: int) -> Returns:
        """Return all N rows of a sweep, invalid ones at 0 0 0.

        Valid rows have a finite position, not 0 0 0, and a time inside the sweep. Raise InputError,
        whose message begins with ``where``, if a column is missing.
        """
        missing = [name for name in self.fields.values() if name not in columns]
        if missing:
            raise InputError(
                f"{where}: no column {missing[0]}, which other sweeps have; got "
                f"{', '.join(columns)}"
            )
        column_of = {quantity: columns[name] for quantity, name in self.fields.items()}
        points = np.column_stack([column_of[axis] for axis in "xyz"]).astype(np.float64)
        valid: Bool = np.logical_and(np.isfinite(points).all(axis=1), points.any(axis=1))
        if "lidar" in column_of:
            valid &= np.isfinite(column_of["lidar"])
        intensity = rescale(column_of.get("intensity", np.zeros(len(points))), self.intensity_scale)
        offset_ns = None
        num_untimed = 0
        if self.times is not None:
            values = column_of["time"][valid]
            if len(values) and (values != values[0]).any():  # else this sweep has no times
                valid_ns, is_in_sweep = self.times.offset_ns(values, stamp_ns)
                offset_ns = np.zeros(len(points), np.int64)
                offset_ns[valid] = valid_ns
                valid[valid] = is_in_sweep
                num_untimed = int((~is_in_sweep).sum())
        points[~valid] = 0
        return Returns(points, intensity, offset_ns, num_untimed=num_untimed)
