# SPDX-License-Identifier: MIT
"""Sweeps in files of columns that nobody described. The meaning of columns is found by their names,
by the values of the first sweep that can be read, and by what densify.yaml says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool
from densify.readers.file_sequence import Returns
from densify.readers.folder.config import SweepFiles
from densify.readers.folder.series import Series
from densify.readers.point_fields import PointLayout
from densify.readers.point_files import read_table

Columns = Mapping[str, NDArray[Any]]

_ASSUMED_HZ = 10.0
_NUM_TRIED = 5  # sweeps, until one can be read


@dataclass(frozen=True)
class SweepColumns:
    """series: the files. settings: what densify.yaml says; config: its path."""

    series: Series
    settings: SweepFiles
    config: Path | None

    def returns(self, frame: int, stamp_ns: int) -> tuple[Path, Returns]:
        """Return a sweep's file and its rows. Raises InputError if the file is damaged or lacks
        columns of the first."""
        path = self.series.paths[frame]
        columns = self._columns(path)
        found, valid = self.layout.returns(columns, path, stamp_ns)
        points = self.settings.scale_m * found.points
        if self.settings.axes is not None:
            points = points @ self.settings.axes.T
        lidar = self._lidar(path, columns, valid)
        origins = self.settings.scanner_origins
        return path, replace(found, points=points, lidar=lidar, scanner_origins=origins)

    @cached_property
    def layout(self) -> PointLayout:
        """Find the meaning of the columns in the first sweep that can be read."""
        frame, columns = self._sample
        path, known = self.series.paths[frame], self.settings
        named = {
            part: name for part in ("intensity", "time", "lidar") if (name := getattr(known, part))
        }
        for part, name in named.items():
            if name not in columns:
                raise InputError(
                    f"{self.config}: sweeps.{part}: got {name!r}, expected a column of "
                    f"{path.name}: {', '.join(columns)}"
                )
        return PointLayout.find(
            columns,
            path,
            self.period_ns,
            (self.series.stamps_ns or {}).get(frame),
            named,
            known.intensity_scale,
            unit=known.time_unit,
            absolute=known.time_is == "absolute" if known.time_is else None,
            reference=known.reference,
        )

    @cached_property
    def period_ns(self) -> int:
        """Return the time from sweep to sweep: by their stamps, or else their rate."""
        stamps_ns = list((self.series.stamps_ns or {}).values())
        if len(stamps_ns) > 1:
            return max(1, int(np.median(np.diff(stamps_ns))))
        return round(1e9 / (self.settings.rate_hz or _ASSUMED_HZ))

    def unused(self) -> list[str]:
        """Return the columns that play no part, with their ranges, for people."""
        return [
            f"{name} ({np.nanmin(column):g} to {np.nanmax(column):g})"
            for name, column in self._sample[1].items()
            if name not in vars(self.layout.fields).values()
        ]

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

    def _columns(self, path: Path) -> Columns:
        """Read all columns of numbers, (N,) each, also those beside the points of an .npz file."""
        table = read_table(path, self.settings.columns)
        beside = {n: a for n, a in table.beside.items() if a.shape == (len(table),)}
        columns = {**table.columns, **beside}
        return {name: c for name, c in columns.items() if c.dtype.kind in "fiu"}

    def _lidar(self, path: Path, columns: Columns, valid: Bool) -> NDArray[np.uint8] | None:
        name, origins = self.layout.fields.lidar, self.settings.scanner_origins
        if not name:
            return None
        numbers = np.where(valid, columns[name], 0)
        most = 255 if origins is None else len(origins) - 1
        if not ((numbers >= 0) & (numbers <= most) & (numbers == np.rint(numbers))).all():
            raise InputError(
                f"{path}: {name}: expected the number of a scanner, 0 to {most}; check "
                f"sweeps.scanner_origins in densify.yaml"
            )
        return numbers.astype(np.uint8)
