# SPDX-License-Identifier: MIT
"""Measure the scanners of a recording in its sweeps: position, field of view, ray spacing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.free_space.rays import Layout, aim_rays, measure_layout
from densify.geometry.types import Bool, Float, Float32, RegisteredSweep

_NUM_SWEEPS = 3  # number of sweeps in which a scanner is measured
_BEAM_RAD = np.deg2rad(1 / 6)  # 3 mrad, the width of most beams
_HOLE_RAD = np.deg2rad(45.0)  # widest range of azimuth without returns that a building can cause


class RayGrid(NamedTuple):
    """Directions in cells of about one ray each; columns go left from azimuth -pi, rows up."""

    low_rad: float  # lowest elevation of the first bin
    bin_rad: float  # height of a bin of elevation
    row_of: Float  # (B+1,) number of rows below each border of a bin, may be a fraction
    num_rows: int
    num_columns: int


@dataclass(frozen=True)
class SensorModel(Layout):
    """One scanner, with its pattern of rays."""

    origin_m: Float  # (3,) origin of its rays, lidar frame
    axes: Float  # (3,3) rotation from the lidar frame to the scanner's axes
    elevation_rad: tuple[float, float]  # (2,) elevations of the lowest and the highest ray
    # (2,) azimuths of the rightmost and the leftmost ray: -pi and pi for an all-round view, right >
    # left if the view includes the backward direction
    azimuth_rad: tuple[float, float]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep], lidar: int) -> SensorModel:
        """Return the scanner with number ``lidar``, measured in up to three deskewed sweeps."""
        with_returns = [
            registered for registered in sweeps if (registered.sweep.lidar == lidar).any()
        ]
        # The middle sweep of each third of them
        middles = (np.arange(_NUM_SWEEPS) + 0.5) * len(with_returns) / _NUM_SWEEPS
        sampled = [with_returns[index] for index in np.unique(middles.astype(int))]
        rays_of_sweep = [aim_rays(registered, lidar) for registered in sampled]
        elevation = np.concatenate([rays.elevation for rays in rays_of_sweep])
        azimuth = np.concatenate([rays.azimuth for rays in rays_of_sweep])
        return SensorModel(
            **vars(measure_layout(rays_of_sweep)),
            origin_m=sampled[0].sweep.origin_m(lidar),
            axes=sampled[0].sweep.axes(lidar),
            elevation_rad=(float(elevation.min()), float(elevation.max())),
            azimuth_rad=_find_view(azimuth),
        )

    @property
    def grid(self) -> RayGrid:
        """The grid: a row for each ring or line, or square cells for unordered rays."""
        if self.unordered:
            return self._grid_of_unordered()
        low_rad, bin_rad = self.table.low_rad, self.table.bin_rad
        row_of = self._rows_of_lines() if self.rings_rad is None else self._rows_of(self.rings_rad)
        num_columns = round(2 * np.pi / self.azimuth_step_rad)
        # The row at the last border, counted from 0, and one row for directions above it
        num_rows = int(row_of[-1]) + 2
        return RayGrid(low_rad, bin_rad, row_of, num_rows, num_columns)

    def _grid_of_unordered(self) -> RayGrid:
        """Return a grid with one row for each bin, and cells as small as the closest rays."""
        # The densest 5 % of the directions are left out: their spacing is measured in few returns.
        side_rad = float(np.percentile(self.table.elevation_gap_rad, 5))
        low_rad = self.table.low_rad
        num_rows = int((self.elevation_rad[1] - low_rad) / side_rad) + 1
        num_columns = round(2 * np.pi / side_rad)
        return RayGrid(low_rad, side_rad, np.arange(num_rows + 1.0), num_rows, num_columns)

    def _rows_of_lines(self) -> Float:
        """Return the (B+1,) number of lines below each border of a bin of elevation."""
        num_lines = self.table.bin_rad / self.table.elevation_gap_rad[:, 0].astype(np.float64)
        return np.append(0.0, np.cumsum(num_lines))

    def _rows_of(self, rings_rad: Float) -> Float:
        """Return the (B+1,) number of rows below each border of a bin, one row for each ring."""
        borders_rad = self.table.low_rad + self.table.bin_rad * np.arange(
            len(self.table.elevation_gap_rad) + 1
        )
        # A ring lies in the middle of its row, half a row above the row's lower border.
        rows: Float = 0.5 + np.interp(borders_rad, rings_rad, np.arange(len(rings_rad)))
        return rows

    def directions(self, points: Float) -> tuple[Float, Float, Float]:
        """Return (N,) azimuth, elevation (rad, scanner's axes) and range (m) from the scanner.

        ``points`` (N,3) are in the lidar frame.
        """
        ray = points - self.origin_m
        is_turned = not np.array_equal(self.axes, np.eye(3))
        x, y, z = (ray @ self.axes.T if is_turned else ray).T
        horizontal_m = np.hypot(x, y)
        return np.arctan2(y, x), np.arctan2(z, horizontal_m), np.hypot(horizontal_m, z)

    def sees(self, azimuth: Float, elevation: Float) -> Bool:
        """Return (N,) True for directions, in radians, within the scanner's field of view."""
        right, left = self.azimuth_rad
        # Both angles are counted to the left from the right end.
        in_view = (azimuth - right) % (2 * np.pi) <= (left - right) % (2 * np.pi)
        if left - right >= 2 * np.pi:  # all round, where the width modulo 2 pi is 0
            in_view[:] = True
        low, high = self.elevation_rad
        return in_view & (elevation >= low) & (elevation <= high)

    def gap_m(self, points: Float) -> tuple[Float, Bool]:
        """Return (N,) metres from points, lidar frame, to the next ring or ray; (N,) in view."""
        azimuth, elevation, range_m = self.directions(points)
        gap_rad = self.table.at(azimuth, elevation)[:, 1]
        return range_m * (gap_rad + _BEAM_RAD), self.sees(azimuth, elevation)


@dataclass(frozen=True)
class Sensors:
    """The scanners of a recording, by their number in `densify.geometry.types.Sweep.lidar`."""

    models: Mapping[int, SensorModel]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep]) -> Sensors:
        """Return all scanners, measured in the deskewed sweeps."""
        numbers = {
            int(number) for registered in sweeps for number in np.unique(registered.sweep.lidar)
        }
        return Sensors({number: SensorModel.of(sweeps, number) for number in sorted(numbers)})

    @property
    def origins_m(self) -> Float:
        """The (S,3) origins by scanner number, lidar frame; zeros for numbers without a scanner."""
        origins_m = np.zeros((1 + max(self.models, default=0), 3))
        for number, model in self.models.items():
            origins_m[number] = model.origin_m
        return origins_m

    def gap_m(self, points: Float, lidar: NDArray[np.uint8]) -> Float:
        """Return (N,) metres from points, lidar frame, to the next ring of their scanner (N,)."""
        gap_m = np.zeros(len(points))
        for number, model in self.models.items():
            rows = np.flatnonzero(lidar == number)
            gap_m[rows] = model.gap_m(points[rows])[0]
        return gap_m

    def finest_gap_m(self, points: Float) -> Float:
        """Return the least (N,) ring spacing of the scanners that have points (N,3) in view.

        Points, in the lidar frame, that no scanner has in view get the largest spacing.
        """
        gaps_m, in_view = zip(*(model.gap_m(points) for model in self.models.values()), strict=True)
        finest_m = np.where(in_view, gaps_m, np.inf).min(axis=0)
        return np.where(np.isfinite(finest_m), finest_m, np.max(gaps_m, axis=0))


def _find_view(azimuth: Float32) -> tuple[float, float]:
    """Return the right and the left end of the field of view, radians, of rays (N,)."""
    angles = np.unique(azimuth).astype(np.float64)
    gap_rad = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(np.argmax(gap_rad))
    if gap_rad[widest] < _HOLE_RAD:  # a building can cause it: the view is all round
        return -np.pi, np.pi
    # The view begins to the left of the widest gap, and ends at the gap's right side.
    return float(angles[(widest + 1) % len(angles)]), float(angles[widest])
