# SPDX-License-Identifier: MIT
"""How each scanner of a recording samples directions, measured from its own sweeps: how far apart
its rays are in any direction, where its rings lie, and in what order it fires.

Every return is put back to the moment it was fired and seen from where its scanner stood then:
only there do the returns of a turning scanner lie on rings. Three kinds are told apart:

    rings       the elevations of the returns stand in sharp peaks
    lines       they do not, but along the azimuth the returns follow at even steps: lasers that do
                not share an origin, whose near returns smear
    unordered   neither, or the firing time does not go with the azimuth (solid state, rosettes)

Rings and lines have a spacing for each elevation, measured between neighbouring rings before any
are merged; unordered scanners one for each direction, from how many returns of a sweep fall there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config.errors import InputError
from densify.free_space import rings as measure
from densify.free_space.rays import aim
from densify.geometry.arrays import Bool, Float, Float32
from densify.geometry.types import RegisteredSweep

_NUM_SWEEPS = 3  # that a scanner is measured from
_MANY_POINTS = 15_000
_SECTOR_RAD = np.deg2rad(5.0)
FEW_POINTS = 200  # too few to measure anything
_DEFAULT_RAD = (np.deg2rad(0.18), np.deg2rad(0.40))  # a 64-beam scanner's
_BEAM_RAD = np.deg2rad(1 / 6)  # 3 mrad, as most have
_RING_BIN_RAD, _LINE_BIN_RAD, _CELL_RAD = np.deg2rad([0.02, 0.5, 1.0])
_BEYOND_RAD = np.deg2rad(1.0)
_MIN_EVEN_SHARE = 0.5
_MIN_GAPS, _MIN_GAPS_PER_BIN = 100, 30
_MIN_COUNT = 24  # returns that tell a density
_WINDOWS = (1, 3, 5, 9, 17, 33)  # cells
_HOLE_RAD = np.deg2rad(45.0)


class Aimed(NamedTuple):
    """One scanner's rays at their firing times, from where it stood: azimuth, elevation (rad),
    range (m), and seconds after the sweep's reference time; (N,) float32."""

    azimuth: Float32
    elevation: Float32
    range_m: Float32
    offset_s: Float32


def aimed(registered: RegisteredSweep, lidar: int) -> Aimed:
    """The rays of one scanner, whose points deskewing has moved, back at their firing times."""
    sweep = registered.sweep
    mine, points, offset_ns = sweep.lidar == lidar, sweep.points, sweep.offset_ns
    if not mine.all():
        rows = np.flatnonzero(mine)
        points = points.take(rows, axis=0)
        offset_ns = None if offset_ns is None else offset_ns[rows]
    offset_s = np.zeros(len(points), np.float32)
    if offset_ns is not None:
        offset_s = (offset_ns * 1e-9).astype(np.float32)
    seen = np.empty((3, len(points)), np.float32)
    aim.over_rows(
        len(points),
        points.astype(np.float32),
        offset_s,
        sweep.origin_m(lidar).astype(np.float32),
        sweep.axes(lidar).astype(np.float32, order="C"),
        np.stack([registered.twist_before, registered.twist_after]).astype(np.float32),
        seen,
    )
    return Aimed(seen[0], seen[1], seen[2], offset_s)


def some_sectors(rays: Aimed) -> Aimed:
    """Rows of every fourth sector: they tell as much of a view all round."""
    if len(rays.azimuth) > _MANY_POINTS:
        some = np.floor(rays.azimuth / _SECTOR_RAD) % 4 == 0
        if some.mean() > 0.1:
            return Aimed(*(column[some] for column in rays))
    return rays


def in_lines(rays: Aimed) -> bool:
    """Return True if returns of one elevation follow at even steps in the order of time."""
    _, even = measure.even_step(rays.azimuth, rays.elevation)
    return even >= _MIN_EVEN_SHARE and measure.firing_order(rays.azimuth, rays.offset_s).by_azimuth


class RayTable(NamedTuple):
    """Angles (rad) between neighbouring rays, (B,C) float32 each: ``across`` along the azimuth and
    ``along`` the elevation.

    Row b is about the elevations from ``low_rad + b * bin_rad``, the outermost about all beyond;
    column c about the azimuths from ``-pi + c * 2 pi / C``. C is 1 where they do not matter.
    """

    low_rad: float
    bin_rad: float
    across: Float32
    along: Float32

    def at(self, azimuth: NDArray[np.floating], elevation: NDArray[np.floating]) -> Float:
        """(N,2) across and along in these directions."""
        rows, columns = self.along.shape
        row = np.clip((elevation - self.low_rad) / self.bin_rad, 0, rows - 1).astype(np.int64)
        column = ((azimuth + np.pi) * (columns / (2 * np.pi))).astype(np.int64) % columns
        return np.stack([self.across[row, column], self.along[row, column]], 1).astype(np.float64)


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
class SensorModel:
    """One scanner.

    origin_m: (3,) lidar frame, where its rays start. axes: (3,3) from the lidar frame's to its own,
    in which its angles are. rings_rad: (K,) true elevation of every ring,
    ascending, however close they lie; None where there are no distinct rings. unordered: nor are
    there lines. azimuth_step_rad: between rays of a ring or line; of an unordered scanner between
    rays where most are. elevation_rad: (2,) the lowest and the highest ray. azimuth_rad: (2,) the
    rightmost and the leftmost; -pi and pi for a view all round, and right > left where the view
    holds the direction backwards. order: in which it fires. table: of spacings.
    """

    origin_m: Float
    axes: Float
    rings_rad: Float | None
    unordered: bool
    azimuth_step_rad: float
    elevation_rad: tuple[float, float]
    azimuth_rad: tuple[float, float]
    order: measure.Order
    table: RayTable

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep], lidar: int) -> SensorModel:
        """Measured from at most three of the sweeps that hold returns of this scanner, evenly
        spread. sweeps: deskewed. Raises InputError where none has any."""
        holding = [s for s in sweeps if (s.sweep.lidar == lidar).any()]
        if not holding:
            raise InputError(
                f"lidar {lidar}: no returns of that scanner in {len(sweeps)} sweeps; expected a "
                f"number that Sweep.lidar holds"
            )
        middles = (np.arange(_NUM_SWEEPS) + 0.5) * len(holding) / _NUM_SWEEPS
        chosen = [holding[i] for i in np.unique(middles.astype(int))]
        seen = [aimed(s, lidar) for s in chosen]
        some = [some_sectors(rays) for rays in seen]
        elevation = np.concatenate([rays.elevation for rays in seen])
        rings, unordered = None, False
        if len(elevation) < FEW_POINTS:
            step_rad, table = _DEFAULT_RAD[0], _uniform_table(*_DEFAULT_RAD)
        else:
            rings = measure.find_rings(np.concatenate([rays.elevation for rays in some]))
            unordered = rings is None and not in_lines(some[0])
            step_rad = float(np.median([_step_rad(rays, rings) for rays in some]))
            if rings is not None:
                table = _table_of_rings(rings, step_rad)
            elif unordered:
                table = density_table(seen)
                step_rad = float(np.median(table.at(seen[0].azimuth, seen[0].elevation)[:, 0]))
            else:
                table = _table_of_lines(seen, step_rad)
        return SensorModel(
            origin_m=chosen[0].sweep.origin_m(lidar),
            axes=chosen[0].sweep.axes(lidar),
            rings_rad=rings,
            unordered=unordered,
            azimuth_step_rad=step_rad,
            elevation_rad=(float(elevation.min()), float(elevation.max())),
            azimuth_rad=_view(np.concatenate([rays.azimuth for rays in seen])),
            order=measure.firing_order(seen[0].azimuth, seen[0].offset_s),
            table=table,
        )

    @property
    def grid(self) -> RayGrid:
        """A row for each ring; of an unordered scanner cells as small as its rays are close where
        they are closest."""
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
        """(N,3) lidar frame -> azimuth, elevation (rad) and range (m), (N,) each, from its
        origin."""
        away = points - self.origin_m
        x, y, z = (away if np.array_equal(self.axes, np.eye(3)) else away @ self.axes.T).T
        level = np.hypot(x, y)
        return np.arctan2(y, x), np.arctan2(z, level), np.hypot(level, z)

    def sees(self, azimuth: Float, elevation: Float) -> Bool:
        """(N,) whether these directions lie between its outermost rays."""
        right, left = self.azimuth_rad
        inside = (azimuth - right) % (2 * np.pi) <= (left - right) % (2 * np.pi)
        if left - right >= 2 * np.pi:
            inside[:] = True
        low, high = self.elevation_rad
        return inside & (elevation >= low) & (elevation <= high)


@dataclass(frozen=True)
class Sensors:
    """The scanners of a recording, by their number in `densify.geometry.types.Sweep.lidar`."""

    models: Mapping[int, SensorModel]

    @property
    def scattered(self) -> bool:
        """Return True if no scanner has rings or lines, so each sweep hits other places."""
        return all(model.unordered for model in self.models.values())

    @property
    def origins_m(self) -> Float:
        """(S,3) lidar frame, by number; zeros of numbers that no scanner has."""
        origins_m = np.zeros((1 + max(self.models, default=0), 3))
        for number, model in self.models.items():
            origins_m[number] = model.origin_m
        return origins_m

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep]) -> Sensors:
        """Every scanner that the deskewed sweeps hold returns of."""
        numbers = {int(n) for s in sweeps for n in np.unique(s.sweep.lidar)}
        return Sensors({n: SensorModel.of(sweeps, n) for n in sorted(numbers)})

    def gap_m(self, points: Float, lidar: NDArray[np.uint8]) -> Float:
        """(N,3) lidar frame, (N,) -> (N,) metres from each point to the next ring of the scanner
        that measured it, or the next ray of one without rings. The width of a beam is added: a
        return may be from anywhere in its spot."""
        gap_m = np.zeros(len(points))
        for number, model in self.models.items():
            mine = np.flatnonzero(lidar == number)
            gap_m[mine] = _gap_m(model, points[mine])[0]
        return gap_m

    def finest_gap_m(self, points: Float) -> Float:
        """(N,3) lidar frame -> (N,) the same of the scanner that sees each place most finely; of
        the coarsest where none sees it."""
        gaps_m, sees = zip(*(_gap_m(m, points) for m in self.models.values()), strict=True)
        finest = np.where(sees, gaps_m, np.inf).min(axis=0)
        return np.where(np.isfinite(finest), finest, np.max(gaps_m, axis=0))


def _gap_m(model: SensorModel, points: Float) -> tuple[Float, Bool]:
    azimuth, elevation, range_m = model.directions(points)
    gap_rad = model.table.at(azimuth, elevation)[:, 1]
    return range_m * (gap_rad + _BEAM_RAD), model.sees(azimuth, elevation)


def _step_rad(rays: Aimed, rings: Float | None) -> float:
    if rings is None:
        return measure.even_step(rays.azimuth, rays.elevation)[0]
    ring = np.searchsorted(0.5 * (rings[1:] + rings[:-1]), rays.elevation)
    return measure.step_along(rays.azimuth, ring)


def _view(azimuth: Float32) -> tuple[float, float]:
    """The rightmost and the leftmost direction: the ends of the widest gap without returns; all
    round unless that is wider than what a building hides."""
    angles = np.unique(azimuth).astype(np.float64)
    gap = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(np.argmax(gap))
    if gap[widest] < _HOLE_RAD:
        return -np.pi, np.pi
    return float(angles[(widest + 1) % len(angles)]), float(angles[widest])


def _uniform_table(across_rad: float, along_rad: float) -> RayTable:
    return _table(0.0, 1.0, np.array([across_rad]), np.array([along_rad]))


def _table_of_rings(rings: Float, step_rad: float) -> RayTable:
    """The spacing at a ring is the mean of the gaps to both its neighbours."""
    low = float(rings[0]) - _BEYOND_RAD
    num_bins = int((float(rings[-1]) + _BEYOND_RAD - low) / _RING_BIN_RAD) + 1
    elevation = low + (np.arange(num_bins) + 0.5) * _RING_BIN_RAD
    along = np.interp(elevation, rings, np.gradient(rings, edge_order=1))
    return _table(low, _RING_BIN_RAD, step_rad * np.cos(elevation), along)


def _table_of_lines(sweeps: Sequence[Aimed], step_rad: float) -> RayTable:
    """Medians by elevation of the gaps within narrow sectors."""
    found = [measure.gaps_between(r.azimuth, r.elevation, step_rad / 2) for r in sweeps]
    gap, middle = (np.concatenate(columns) for columns in zip(*found, strict=True))
    low = float(min(r.elevation.min() for r in sweeps)) - _LINE_BIN_RAD
    high = float(max(r.elevation.max() for r in sweeps)) + _LINE_BIN_RAD
    num_bins = int((high - low) / _LINE_BIN_RAD) + 2
    along = np.full(num_bins, np.median(gap) if len(gap) >= _MIN_GAPS else _DEFAULT_RAD[1])
    in_bin = ((middle - low) / _LINE_BIN_RAD).astype(np.int64)
    order = np.argsort(in_bin, kind="stable")
    count = np.bincount(in_bin, minlength=num_bins)
    bins, ends = np.flatnonzero(count >= _MIN_GAPS_PER_BIN), np.cumsum(count)
    if len(bins) and len(gap) >= _MIN_GAPS:
        medians = [np.median(gap[order[ends[b] - count[b] : ends[b]]]) for b in bins]
        along = np.interp(np.arange(num_bins), bins, medians)
    elevation = low + (np.arange(num_bins) + 0.5) * _LINE_BIN_RAD
    return _table(low, _LINE_BIN_RAD, step_rad * np.cos(elevation), along)


def _table(low: float, bin_rad: float, across: Float, along: Float) -> RayTable:
    columns = (column[:, None].astype(np.float32) for column in (across, along))
    return RayTable(low, float(bin_rad), *columns)


def density_table(sweeps: Sequence[Aimed]) -> RayTable:
    """The side of the square that each return of a sweep has to itself, by direction: returns are
    counted in the smallest window around each cell of a degree that holds enough."""
    low = float(min(r.elevation.min() for r in sweeps))
    rows = int((float(max(r.elevation.max() for r in sweeps)) - low) / _CELL_RAD) + 1
    columns = round(2 * np.pi / _CELL_RAD)
    count = np.zeros((rows, columns))
    for rays in sweeps:
        row = ((rays.elevation - low) / _CELL_RAD).astype(np.int64)
        column = ((rays.azimuth + np.pi) / _CELL_RAD).astype(np.int64) % columns
        np.add.at(count, (row, column), 1)
    in_view = ndimage.binary_closing(np.pad(count > 0, 1))[1:-1, 1:-1] | (count > 0)
    cell_sr = _CELL_RAD**2 * np.cos(low + (np.arange(rows) + 0.5) * _CELL_RAD)[:, None] * in_view
    density = np.zeros((rows, columns))
    for cells in reversed(_WINDOWS):
        held, sr = (_in_windows(values, cells) for values in (count, cell_sr))
        enough = (held >= _MIN_COUNT) | (cells == _WINDOWS[-1])
        density = np.where(enough & (sr > 0), held / np.maximum(sr, 1e-12), density)
    known = in_view & (density > 0)
    spacing = np.sqrt(len(sweeps) / np.where(known, density, 1.0))
    nearest = ndimage.distance_transform_edt(~known, return_indices=True)[1]
    spacing = spacing[tuple(nearest)].astype(np.float32)
    return RayTable(low, float(_CELL_RAD), spacing, spacing)


def _in_windows(values: Float, cells: int) -> Float:
    """Sums over square windows; azimuth goes round."""
    mean: Float = ndimage.uniform_filter(values, cells, mode=("constant", "wrap"))
    return mean * cells**2
