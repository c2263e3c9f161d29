# SPDX-License-Identifier: MIT
"""The scanners of a recording, measured from its own sweeps: where they stand, in which directions
they look, and how far apart their rays are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.free_space.rings import Layout, aimed, measure
from densify.geometry.arrays import Bool, Float, Float32
from densify.geometry.types import RegisteredSweep

_NUM_SWEEPS = 3  # that a scanner is measured from
_BEAM_RAD = np.deg2rad(1 / 6)  # 3 mrad, as most have
_HOLE_RAD = np.deg2rad(45.0)  # a building may hide as much


class RayGrid(NamedTuple):
    """Cells of about one ray of a sweep each.

    Rows go up: ``row_of`` (B+1,) counts them, a fraction at will, from elevation ``low_rad`` in
    steps of ``bin_rad``. Columns go left from azimuth -pi, all round.
    """

    low_rad: float
    bin_rad: float
    row_of: Float
    num_rows: int
    num_columns: int


@dataclass(frozen=True)
class SensorModel(Layout):
    """One scanner.

    origin_m: (3,) lidar frame, where its rays start.
    axes: (3,3) from the lidar frame's to its own, in which its angles are.
    elevation_rad: (2,) the lowest and the highest ray.
    azimuth_rad: (2,) the rightmost and the leftmost ray; -pi and pi for a view all round, and
        right > left where the view holds the direction backwards.
    """

    origin_m: Float
    axes: Float
    elevation_rad: tuple[float, float]
    azimuth_rad: tuple[float, float]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep], lidar: int) -> SensorModel:
        """Measure a scanner in at most three deskewed sweeps with its returns, evenly spread."""
        holding = [s for s in sweeps if (s.sweep.lidar == lidar).any()]
        middles = (np.arange(_NUM_SWEEPS) + 0.5) * len(holding) / _NUM_SWEEPS
        chosen = [holding[i] for i in np.unique(middles.astype(int))]
        seen = [aimed(s, lidar) for s in chosen]
        elevation = np.concatenate([rays.elevation for rays in seen])
        return SensorModel(
            **vars(measure(seen)),
            origin_m=chosen[0].sweep.origin_m(lidar),
            axes=chosen[0].sweep.axes(lidar),
            elevation_rad=(float(elevation.min()), float(elevation.max())),
            azimuth_rad=_view(np.concatenate([rays.azimuth for rays in seen])),
        )

    @property
    def grid(self) -> RayGrid:
        """Return a row for each ring; for an unordered scanner, cells as small as its rays are
        close where they are closest."""
        low, bin_rad = self.table.low_rad, self.table.bin_rad
        if self.unordered:
            bin_rad = float(np.percentile(self.table.along, 5))
            num_rows = int((self.elevation_rad[1] - low) / bin_rad) + 1
            num_columns = round(2 * np.pi / bin_rad)
            return RayGrid(low, bin_rad, np.arange(num_rows + 1.0), num_rows, num_columns)
        if self.rings_rad is None:
            row_of = np.append(0.0, np.cumsum(bin_rad / self.table.along[:, 0].astype(np.float64)))
        else:
            edges = low + bin_rad * np.arange(len(self.table.along) + 1)
            row_of = 0.5 + np.interp(edges, self.rings_rad, np.arange(len(self.rings_rad)))
        num_columns = round(2 * np.pi / self.azimuth_step_rad)
        return RayGrid(low, bin_rad, row_of, int(row_of[-1]) + 2, num_columns)

    def directions(self, points: Float) -> tuple[Float, Float, Float]:
        """Return azimuth, elevation (rad) and range (m), (N,) each, of points (N,3), lidar frame,
        seen from the scanner."""
        away = points - self.origin_m
        x, y, z = (away if np.array_equal(self.axes, np.eye(3)) else away @ self.axes.T).T
        level = np.hypot(x, y)
        return np.arctan2(y, x), np.arctan2(z, level), np.hypot(level, z)

    def sees(self, azimuth: Float, elevation: Float) -> Bool:
        """Return (N,) True for the directions between its outermost rays."""
        right, left = self.azimuth_rad
        inside = (azimuth - right) % (2 * np.pi) <= (left - right) % (2 * np.pi)
        if left - right >= 2 * np.pi:
            inside[:] = True
        low, high = self.elevation_rad
        return inside & (elevation >= low) & (elevation <= high)

    def gap_m(self, points: Float) -> tuple[Float, Bool]:
        """Return (N,) metres from points (N,3), lidar frame, to the next ring, or to the next ray
        of a scanner without rings, and (N,) True where the scanner sees that way.

        The width of a beam is added: a return may be from anywhere in its spot.
        """
        azimuth, elevation, range_m = self.directions(points)
        gap_rad = self.table.at(azimuth, elevation)[:, 1]
        return range_m * (gap_rad + _BEAM_RAD), self.sees(azimuth, elevation)


@dataclass(frozen=True)
class Sensors:
    """The scanners of a recording, by their number in `densify.geometry.types.Sweep.lidar`."""

    models: Mapping[int, SensorModel]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep]) -> Sensors:
        """Measure every scanner that the deskewed sweeps hold returns of."""
        numbers = {int(n) for s in sweeps for n in np.unique(s.sweep.lidar)}
        return Sensors({n: SensorModel.of(sweeps, n) for n in sorted(numbers)})

    @property
    def origins_m(self) -> Float:
        """Return (S,3) lidar frame, by number; zeros of numbers that no scanner has."""
        origins_m = np.zeros((1 + max(self.models, default=0), 3))
        for number, model in self.models.items():
            origins_m[number] = model.origin_m
        return origins_m

    def gap_m(self, points: Float, lidar: NDArray[np.uint8]) -> Float:
        """Return `SensorModel.gap_m` (N,) of the scanner (N,) that measured each point (N,3)."""
        gap_m = np.zeros(len(points))
        for number, model in self.models.items():
            mine = np.flatnonzero(lidar == number)
            gap_m[mine] = model.gap_m(points[mine])[0]
        return gap_m

    def finest_gap_m(self, points: Float) -> Float:
        """Return the same of the scanner that sees each point most finely; of the coarsest where
        none sees it."""
        gaps_m, sees = zip(*(m.gap_m(points) for m in self.models.values()), strict=True)
        finest = np.where(sees, gaps_m, np.inf).min(axis=0)
        return np.where(np.isfinite(finest), finest, np.max(gaps_m, axis=0))


def _view(azimuth: Float32) -> tuple[float, float]:
    """Return the ends of the widest gap without returns; all round unless that is wider than what
    a building hides."""
    angles = np.unique(azimuth).astype(np.float64)
    gap = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(np.argmax(gap))
    if gap[widest] < _HOLE_RAD:
        return -np.pi, np.pi
    return float(angles[(widest + 1) % len(angles)]), float(angles[widest])
