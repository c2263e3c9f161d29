# SPDX-License-Identifier: MIT
"""Sweeps in files of columns that nobody described. The meaning of columns is found by their names,
by the values of the first sweep that can be read, and by what densify.yaml says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Int
from densify.readers.file_sequence import Returns
from densify.readers.folder.config import SweepFiles
from densify.readers.folder.series import Series
from densify.readers.point_fields import (
    Fields,
    PointTimes,
    find_fields,
    find_times,
    full_scale,
    points_of,
    scaled,
)
from densify.readers.point_files import read_table

Columns = Mapping[str, NDArray[Any]]

_ASSUMED_PERIOD_NS = 100_000_000
_NAMED = ("intensity", "time", "lidar")
_NUM_TRIED = 5  # sweeps, until one can be read


class Layout(NamedTuple):
    """The meaning of the columns of all sweeps. times: None where no column tells them. time_words:
    what was found of times. unused: columns that play no part, with their ranges. period_ns: from
    sweep to sweep; period_words: how it was found, "" where the sweeps have stamps."""

    fields: Fields
    times: PointTimes | None
    time_words: str
    intensity_scale: float
    unused: tuple[str, ...]
    period_ns: int
    period_words: str


@dataclass(frozen=True)
class SweepColumns:
    """series: the files. settings: what densify.yaml says; config: its path."""

    series: Series
    settings: SweepFiles
    config: Path | None

    def returns(self, frame: int, stamp_ns: int) -> tuple[Path, Returns]:
        """Return a sweep's file and its rows. Raises InputError if the file is damaged or lacks
        columns of the first."""
        path, fields = self.series.paths[frame], self.layout.fields
        columns = self._columns(path)
        missing = [n for n in vars(fields).values() if n and n not in columns]
        if missing:
            raise InputError(
                f"{path}: no column {missing[0]}, which other sweeps have; got {', '.join(columns)}"
            )
        points = self.settings.scale_m * points_of(columns, fields)
        if self.settings.axes is not None:
            points = points @ self.settings.axes.T
        intensity = None
        if fields.intensity:
            intensity = scaled(columns[fields.intensity], self.layout.intensity_scale)
        valid = np.logical_and(np.isfinite(points).all(axis=1), points.any(axis=1))
        return path, Returns(
            points,
            intensity,
            self._offset_ns(path, columns, stamp_ns, valid),
            self._lidar(path, columns, valid),
            self.settings.scanner_origins,
        )

    @cached_property
    def layout(self) -> Layout:
        """Find the meaning of the columns in the first sweep that can be read."""
        frame, columns = self._sample
        fields, times, words = self._fields, None, "none: no column of that kind"
        period_ns, period_words = self._period()
        if fields.time:
            stamps_ns = self.series.stamps_ns
            times, words = self._times(columns, period_ns, (stamps_ns or {}).get(frame))
            if times is not None and times.absolute and stamps_ns is None:
                times = replace(times, other_clock=True)  # numbers for stamps are no clock
        scale = self.settings.intensity_scale
        if fields.intensity and not scale:
            scale = full_scale(columns[fields.intensity])
        unused = tuple(
            f"{name} ({np.nanmin(column):g} to {np.nanmax(column):g})"
            for name, column in columns.items()
            if name not in vars(fields).values()
        )
        return Layout(fields, times, words, scale or 1.0, unused, period_ns, period_words)

    def _period(self) -> tuple[int, str]:
        """Return the period by the stamps, the rate given, or 10 Hz; and how it is known."""
        stamps_ns, rate_hz = self.series.stamps_ns, self.settings.rate_hz
        if stamps_ns is not None and len(stamps_ns) > 1:
            return max(1, int(np.median(np.diff(list(stamps_ns.values()))))), ""
        if rate_hz:
            return round(1e9 / rate_hz), f"number, at the {rate_hz:g} Hz of densify.yaml"
        return _ASSUMED_PERIOD_NS, "number, at an assumed 10 Hz; say rate_hz in densify.yaml"

    @cached_property
    def _sample(self) -> tuple[int, Columns]:
        """Read the first sweep that can be read: its number and columns."""
        errors = []
        for number, path in list(self.series.paths.items())[:_NUM_TRIED]:
            try:
                return number, self._columns(path)
            except InputError as error:
                errors.append(error)
        raise errors[0]

    @cached_property
    def _fields(self) -> Fields:
        frame, columns = self._sample
        path = self.series.paths[frame]
        named = {part: name for part in _NAMED if (name := getattr(self.settings, part))}
        for part, name in named.items():
            if name not in columns:
                raise InputError(
                    f"{self.config}: sweeps.{part}: got {name!r}, expected a column of "
                    f"{path.name}: {', '.join(columns)}"
                )
        found = vars(find_fields(columns)) | named
        missing = [axis for axis in "xyz" if not found[axis]]
        if missing:
            raise InputError(
                f"{path}: no column {', '.join(missing)}: got {', '.join(columns)}; name them in "
                f"densify.yaml: sweeps: {{columns: [x, y, z, ...]}}"
            )
        return Fields(**found)

    def _columns(self, path: Path) -> Columns:
        """Read all columns of numbers, (N,) each, also those beside the points of an .npz file."""
        table = read_table(path, self.settings.columns)
        beside = {n: a for n, a in table.beside.items() if a.shape == (len(table),)}
        columns = {**table.columns, **beside}
        return {name: c for name, c in columns.items() if c.dtype.kind in "fiu"}

    def _times(
        self, columns: Columns, period_ns: int, stamp_ns: int | None
    ) -> tuple[PointTimes | None, str]:
        known, field = self.settings, self._fields.time
        absolute = known.time_is == "absolute" if known.time_is else None
        return find_times(
            columns[field], field, period_ns, stamp_ns, known.time_unit, absolute, known.reference
        )

    def _offset_ns(self, path: Path, columns: Columns, stamp_ns: int, valid: Bool) -> Int | None:
        times = self.layout.times
        if times is None:
            return None
        values = columns[times.field]
        if not np.isfinite(values[valid]).all():
            raise InputError(f"{path}: {times.field}: got a time that is not finite beside a point")
        offset_ns = np.zeros(len(values), np.int64)
        offset_ns[valid] = times.offset_ns(values[valid], stamp_ns)
        return offset_ns

    def _lidar(self, path: Path, columns: Columns, valid: Bool) -> NDArray[np.uint8] | None:
        name, origins = self.layout.fields.lidar, self.settings.scanner_origins
        if not name:
            return None
        numbers, most = columns[name][valid], 255 if origins is None else len(origins) - 1
        if not ((numbers >= 0) & (numbers <= most) & (numbers == np.rint(numbers))).all():
            raise InputError(
                f"{path}: {name}: expected the number of a scanner, 0 to {most}; check "
                f"sweeps.scanner_origins in densify.yaml"
            )
        lidar = np.zeros(len(valid), np.uint8)
        lidar[valid] = numbers
        return lidar
