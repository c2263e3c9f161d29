# SPDX-License-Identifier: MIT
"""Build range images: the measurements of a sweep by direction, and its free space.

A range image is in the scanner's frame at the firing time of each ray, where the rays form a
regular grid. Its rows are the scanner's rings, its columns the azimuth steps, both measured in the
returns (Thrun et al., "Probabilistic Robotics", 2005, ch. 9, for free space).

A scanner that does not fire in order of azimuth (solid state, rosettes) faces a cell at several
times. The cell keeps their middle and their spread, which widens the margin. The density of such
rays varies. Therefore several images are made, each with cells twice as large, and each is used
where enough of its cells are filled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.free_space.rays import (
    BLOCK,
    FEW_POINTS,
    Aimed,
    aimed,
    at_time,
    azimuth_of,
    fires_by_azimuth,
    from_scanner,
    measure,
)
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float, Float32, Int, RegisteredSweep

_CELLS_PER_STEP = 1.15  # a cell a little larger than a step is rarely empty
_MIN_ROW_RAD = np.deg2rad(0.45)
# Closer rings always share a row. Other rings have their own rows from the range at
# which three rings span more than the error of registration.
_MIN_FAR_ROW_RAD, _SLACK_M = np.deg2rad(0.15), 0.1
# A ring this far from all others observes free space only at its rays. Three full cells suffice.
_LONE_RAD = np.deg2rad(1.0)
_SETTLED = 0.1  # share of a turn
_MIN_COLUMNS, _MAX_COLUMNS = 90, 8192
_DENSEST = 10  # percent of the returns of an unordered scanner that set its finest cells
MIN_FILLED = 6  # least number of filled cells among the 3 x 3 around a direction
_VOUCHED, _MAX_SIZES = 0.8, 5  # share of returns with enough filled cells; number of cell sizes
_HIDES = 1000  # penalty of a hiding return, above the number of cells of all images added up
_PI, _ZERO = np.float32(np.pi), np.float32(0)


class ScannerImage(NamedTuple):
    """The range image of one scanner, R rows by C columns that start at azimuth -pi and wrap."""

    # (1,C) or (R,C) float32 seconds after the reference time at which the scanner faced the column
    # or cell, middle of all such times
    offset_s: Float32
    spread_s: Float32  # greatest difference from that time in seconds, same shape
    # Greatest difference between two estimates of the time at which a point is faced, if each
    # column has one time. A larger difference is at the seam between two turns.
    settled_s: float
    # (R,C) float32 nearest return in the 3 x 3 cells around each cell, inf if none
    nearest_m: Float32
    num_filled: NDArray[np.uint8]  # (R,C) uint8 number of these nine cells with a return
    row_edges_rad: Float32  # (R+1,) float32 elevations of the row borders, ascending
    origin_m: Float32  # (3,) float32 position of the scanner in the lidar frame
    axes: Float32  # (3,3) float32 rotation from the lidar frame to the scanner's axes
    twists: Float32  # (2,6) float32 twist of the lidar before and after the reference time
    from_m: float  # least range at which the image is used
    to_m: float  # greatest range at which the image is used


@dataclass(frozen=True)
class RangeImage:
    """The range images of a sweep, at least one for each scanner."""

    scanners: tuple[ScannerImage, ...]

    @staticmethod
    def of(registered: RegisteredSweep, num_together: int = 1, by_ring: bool = False) -> RangeImage:
        """Return the range images of a deskewed sweep.

        The columns are finer by ``num_together``, the number of sweeps whose counts are added up.
        ``by_ring`` also uses single rings: dense rings for far points, where an error of
        registration is smaller than their spacing, and isolated rings right at their rays.
        """
        scanners: list[ScannerImage] = []
        for lidar in np.unique(registered.sweep.lidar).tolist():
            scanners += _images(registered, lidar, num_together, by_ring)
        return RangeImage(tuple(scanners))

    def sees_through(
        self,
        points: Float,
        margin_m: float,
        margin_fraction: float,
        min_filled: int = MIN_FILLED,
        velocity_m_s: Float | Float32 | None = None,
    ) -> Bool:
        """Return (N,) True where the space at points (N,3) is certainly free.

        At least ``min_filled`` of the 3 x 3 cells around a point's direction must hold a return.
        Every return in them must be farther than the point by more than ``max(margin_m,
        margin_fraction * range)``. A larger margin tolerates errors of registration, but misses
        moving objects close to a background.

        Args:
            points: (N,3) positions in metres, lidar frame at the reference time of the sweep.
            velocity_m_s: (N,3) lidar frame, without ego-motion; None for static points.
        """
        beyond = self.num_beyond(points, (margin_m, margin_fraction), min_filled, velocity_m_s)
        return np.asarray((beyond >= min_filled).any(axis=0))

    def num_beyond(
        self,
        points: Float,
        margins_m: tuple[float, float],
        min_filled: int = 1,
        velocity_m_s: Float | Float32 | None = None,
    ) -> NDArray[np.int16]:
        """Return (S,N) for each of S images the filled cells around N points, if all are beyond.

        The count is far below 0 if a return is not beyond the point by ``margins_m`` (metres, share
        of the range), and 0 if fewer than ``min_filled`` of nine cells are filled. The counts of
        several sweeps may be added. Points and velocities are as in `sees_through`.
        """
        points32 = np.ascontiguousarray(points, np.float32)
        velocity = np.zeros((1, 3)) if velocity_m_s is None else velocity_m_s
        velocity32 = np.ascontiguousarray(velocity, np.float32)
        margins = np.array(margins_m, np.float32)
        beyond = np.zeros((len(self.scanners), len(points)), np.int16)
        for scanner, scanner_beyond in zip(self.scanners, beyond, strict=True):
            _see_beyond.over_rows(
                len(points), points32, velocity32, scanner, margins, min_filled, scanner_beyond
            )
        return beyond


class _Cells(NamedTuple):
    """The cells of one image: edges of the rows (R+1,), and the range in which it is used."""

    row_edges_rad: Float32
    num_columns: int
    from_m: float = 0.0
    to_m: float = np.inf
    lone: bool = False  # every other row is a single ring, and the rows between hold no ring
    coarser: bool = False  # used only where the previous image has too many empty cells


def _images(
    registered: RegisteredSweep, lidar: int, num_together: int, by_ring: bool
) -> list[ScannerImage]:
    """Return the images of scanner ``lidar``, finest first; arguments as in `RangeImage.of`."""
    rays = aimed(registered, lidar)
    images: list[ScannerImage] = []
    for cells in _cells(rays, num_together, by_ring):
        if cells.coarser and images and _share_vouched(images[-1], rays) >= _VOUCHED:
            break  # still larger cells would call the gaps between posts free
        images.append(_image(registered, lidar, rays, cells))
    return images


def _image(registered: RegisteredSweep, lidar: int, rays: Aimed, cells: _Cells) -> ScannerImage:
    """Make the range image of one scanner from its rays."""
    sweep, shape = registered.sweep, (len(cells.row_edges_rad) - 1, cells.num_columns)
    row, column = _cell_of(rays, cells.row_edges_rad, cells.num_columns)
    inside = np.flatnonzero(row >= 0)
    cell = row[inside] * cells.num_columns + column[inside]

    nearest_m = np.full(shape, np.inf, np.float32)
    np.minimum.at(nearest_m.reshape(-1), cell, rays.range_m[inside])
    num_filled = _over_3x3(np.add, np.isfinite(nearest_m).astype(np.uint8), 0)
    if cells.lone:
        num_filled[::2] *= 2
        num_filled[1::2] = 0  # a cell between two single rings is no evidence
    if fires_by_azimuth(rays):
        offset_s = _offset_per_column(column, rays.offset_s, cells.num_columns)[None]
        spread_s = np.zeros_like(offset_s)
    else:
        first, last = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
        np.minimum.at(first.reshape(-1), cell, rays.offset_s[inside])
        np.maximum.at(last.reshape(-1), cell, rays.offset_s[inside])
        first, last = _over_3x3(np.minimum, first, np.inf), _over_3x3(np.maximum, last, -np.inf)
        known, half = np.isfinite(first), np.float32(0.5)
        first, last = np.where(known, first, _ZERO), np.where(known, last, _ZERO)
        offset_s, spread_s = half * (first + last), half * (last - first)
    return ScannerImage(
        offset_s=offset_s,
        spread_s=spread_s,
        settled_s=_SETTLED * float(np.ptp(rays.offset_s)),
        nearest_m=_over_3x3(np.minimum, nearest_m, np.inf),
        num_filled=num_filled,
        row_edges_rad=cells.row_edges_rad,
        origin_m=sweep.origin_m(lidar).astype(np.float32),
        axes=sweep.axes(lidar).astype(np.float32, order="C"),
        twists=np.stack([registered.twist_before, registered.twist_after]).astype(np.float32),
        from_m=cells.from_m,
        to_m=cells.to_m,
    )


def _cell_of(rays: Aimed, row_edges_rad: Float32, num_columns: int) -> tuple[Int, Int]:
    """Return the row (-1 outside) and the column of each ray, (N,) each."""
    row = np.searchsorted(row_edges_rad, rays.elevation, side="right") - 1
    row[row == len(row_edges_rad) - 1] = -1
    column = ((rays.azimuth + _PI) * (np.float32(num_columns) / (_PI + _PI))).astype(np.int64)
    return row, column % num_columns


def _over_3x3(join: Callable[..., Any], cells: NDArray[Any], empty: float) -> NDArray[Any]:
    """Join each of the (R,C) cells with its eight neighbours; columns wrap; ``empty``: outside."""
    beside = join(join(np.roll(cells, 1, axis=1), cells), np.roll(cells, -1, axis=1))
    padded = np.pad(beside, ((1, 1), (0, 0)), constant_values=empty)
    return np.asarray(join(join(padded[:-2], padded[1:-1]), padded[2:]))


def _offset_per_column(column: Int, offset_s: Float32, num_columns: int) -> Float32:
    """Return the (C,) mean firing time of each column, interpolated in columns without rays."""
    num_rays, sum_s = np.bincount(column), np.bincount(column, offset_s)
    filled = np.flatnonzero(num_rays)
    if not len(filled):
        return np.zeros(num_columns, np.float32)
    mean_s = np.interp(np.arange(num_columns), filled, sum_s[filled] / num_rays[filled])
    return mean_s.astype(np.float32)


def _share_vouched(image: ScannerImage, rays: Aimed) -> float:
    """Return the share of rays with enough filled cells around them."""
    row, column = _cell_of(rays, image.row_edges_rad, image.num_filled.shape[1])
    return float((image.num_filled[np.maximum(row, 0), column] >= MIN_FILLED).mean())


def _cells(rays: Aimed, num_together: int, by_ring: bool) -> list[_Cells]:
    """Choose the cells of one scanner's images, finest first; arguments as in `RangeImage.of`."""
    if len(rays.azimuth) < FEW_POINTS:
        return [_grid(_uniform_edges(rays.elevation, np.deg2rad(2.0)), np.deg2rad(1.0))]
    layout = measure([rays])
    step = layout.azimuth_step_rad / num_together
    if layout.rings_rad is not None:
        return _cells_of_rings(layout.rings_rad, _CELLS_PER_STEP * step, by_ring)
    if not layout.unordered:
        row_step = _CELLS_PER_STEP * float(np.median(layout.table.along))
        return [_grid(_uniform_edges(rays.elevation, row_step), _CELLS_PER_STEP * step)]
    spacing = layout.table.at(rays.azimuth, rays.elevation)[:, 1]
    finest = _CELLS_PER_STEP * float(np.percentile(spacing, _DENSEST))
    flatten = float(np.cos(np.median(rays.elevation)))
    return [
        _grid(_uniform_edges(rays.elevation, size), size / flatten)._replace(coarser=True)
        for size in finest * 2.0 ** np.arange(_MAX_SIZES)
    ]


def _cells_of_rings(rings: Float, step: float, by_ring: bool) -> list[_Cells]:
    """Return cells whose rows reach half way to the neighbouring rings, and as far outwards."""
    middle = 0.5 * (rings[1:] + rings[:-1])
    outer: Float = 2 * rings[[0, -1]] - middle[[0, -1]]
    edges: Float = np.concatenate([outer[:1], middle, outer[1:]])
    # coarse rows for near points, fine rows for far points
    coarse, fine = (_no_closer(edges, row_rad) for row_rad in (_MIN_ROW_RAD, _MIN_FAR_ROW_RAD))
    if by_ring and len(coarse) != len(fine):
        far_m = _SLACK_M / (1.5 * float(np.diff(fine).min()))
        return [_grid(coarse, step)._replace(to_m=far_m), _grid(fine, step)._replace(from_m=far_m)]
    gaps = np.diff(rings, prepend=-np.inf, append=np.inf)
    lone = rings[np.minimum(gaps[:-1], gaps[1:]) >= _LONE_RAD]
    if not by_ring or not len(lone):
        return [_grid(coarse, step)]
    on_rings: Float = (lone[:, None] + [-_MIN_FAR_ROW_RAD, _MIN_FAR_ROW_RAD]).ravel()
    return [_grid(coarse, step), _grid(on_rings, step)._replace(lone=True)]


def _grid(edges: NDArray[np.floating], step: float) -> _Cells:
    num_columns = int(np.clip(round(2 * np.pi / step), _MIN_COLUMNS, _MAX_COLUMNS))
    return _Cells(edges.astype(np.float32), num_columns)


def _no_closer(edges: Float, distance: float) -> Float:
    """Drop edges until rows have at least this height. The first and the last edge stay."""
    # Dense rings share a row, because a slight error of registration moves points to another ring.
    kept = [edges[0]]
    for edge in edges[1:]:
        if edge - kept[-1] >= distance:
            kept.append(edge)
    return np.array([*kept[: max(1, len(kept) - 1)], edges[-1]])


def _uniform_edges(elevation: Float32, step: float) -> NDArray[np.floating]:
    low = float(elevation.min(initial=0.0)) - 0.5 * step
    num_rows = int((float(elevation.max(initial=0.0)) - low) / step) + 1
    return low + step * np.arange(num_rows + 1)


@inlined
def _column(azimuth, num_columns):  # type: ignore[no-untyped-def]
    """Return the column of an azimuth, 0 for NaN. Columns start behind the scanner."""
    if not abs(azimuth) <= _PI:
        return np.int32(0)
    # 32 bits, because more of them fit into a vector instruction.
    column = np.int32((azimuth + _PI) * (np.float32(num_columns) / (_PI + _PI)))
    return column - np.int32(num_columns) if column >= num_columns else column


@inlined
def _rows(elevation, size, edges, row):  # type: ignore[no-untyped-def]
    """Fill ``row`` with the interval of the ascending edges of each elevation, -1 outside."""
    # a binary search of many elevations at once, with the steps as the outer loop
    last, step = np.int32(len(edges) - 1), np.int32(1)
    row[:size] = 0
    while 2 * step < last:
        step *= np.int32(2)
    while step > 0:
        for k in range(size):
            at = min(row[k] + step, last)
            row[k] = at if elevation[k] >= edges[at] else row[k]
        step //= np.int32(2)
    for k in range(size):
        inside = elevation[k] >= edges[0] and elevation[k] < edges[last]
        row[k] = row[k] if inside else np.int32(-1)


@inlined
def _speed(point, velocity, twist):  # type: ignore[no-untyped-def]
    """Return the speed in m/s of a point relative to the lidar."""
    vx = velocity[0] - (twist[3] + twist[1] * point[2] - twist[2] * point[1])
    vy = velocity[1] - (twist[4] + twist[2] * point[0] - twist[0] * point[2])
    vz = velocity[2] - (twist[5] + twist[0] * point[1] - twist[1] * point[0])
    return np.sqrt(vx * vx + vy * vy + vz * vz)


@inlined
def _face(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column):  # type: ignore[no-untyped-def]
    """Move ``size`` points to the time at which the scanner faced them, which is found too."""
    # Two rounds from the position at the reference time converge.
    num_columns, by_azimuth = image.nearest_m.shape[1], len(image.offset_s) == 1
    time_s[:size] = _ZERO
    for round in range(3):
        for k in range(size):
            i, t = start + k, time_s[k]
            j = min(i, len(velocity) - 1)
            x[k], y[k], z[k] = at_time(
                points[i, 0] + t * velocity[j, 0], points[i, 1] + t * velocity[j, 1],
                points[i, 2] + t * velocity[j, 2], t, image.twists,
            )  # fmt: skip
        from_scanner(x, y, z, size, image.origin_m, image.axes)
        for k in range(size):
            column[k] = _column(azimuth_of(x[k], y[k]), num_columns)
        if round == 2 or not by_azimuth:
            for k in range(size):
                elevation[k] = azimuth_of(np.sqrt(x[k] * x[k] + y[k] * y[k]), z[k])
            _rows(elevation, size, image.row_edges_rad, row)
        if round < 2:
            for k in range(size):
                time_s[k] = image.offset_s[0 if by_azimuth else max(row[k], 0), column[k]]


@Kernel
def _see_beyond(begin, end, points, velocity, image, margins, min_filled, beyond):  # type: ignore[no-untyped-def]
    """Add to ``beyond`` (N,) int16 the number of returns of one scanner beyond each point.

    Counted are the filled cells among the 3 x 3 cells around a point, if they are at least
    ``min_filled``. If any of their returns is not beyond the point, `_HIDES` is subtracted instead.
    All other arrays are float32.

    Args:
        points: (N,3) positions in metres, lidar frame at the reference time.
        velocity: (N,3) velocities in m/s, or (1,3) for all points.
        image: Range image, `ScannerImage`.
        margins: (2,) least distance of a return beyond a point: metres and share of the range.
    """
    by_azimuth = len(image.offset_s) == 1
    settled_s = np.float32(image.settled_s)
    x, y, z, time_s, elevation = np.empty((5, BLOCK), np.float32)
    row, column = np.empty((2, BLOCK), np.int32)
    # Each point needs a long chain of steps. A block of points takes every step in parallel.
    for start in range(begin, end, BLOCK):
        size = min(BLOCK, end - start)
        _face(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column)
        for k in range(size):
            i, horizontal_m = start + k, np.sqrt(x[k] * x[k] + y[k] * y[k])
            r, c = row[k], column[k]
            if r < 0 or image.num_filled[r, c] < min_filled:
                continue
            range_m = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])
            if range_m < image.from_m or range_m >= image.to_m:
                continue
            margin_m = max(margins[0], margins[1] * range_m)
            away_s = abs(image.offset_s[0 if by_azimuth else r, c] - time_s[k])
            if by_azimuth:
                # Between two turns a spinning scanner skips or repeats a sector.
                if away_s > settled_s:
                    continue
            else:
                away_s += image.spread_s[r, c]
                twist = image.twists[0 if time_s[k] < _ZERO else 1]
                margin_m += away_s * _speed(points[i], velocity[min(i, len(velocity) - 1)], twist)
            if image.nearest_m[r, c] > range_m + margin_m:
                beyond[i] += image.num_filled[r, c]
            else:
                beyond[i] -= _HIDES
