# SPDX-License-Identifier: MIT
"""Build range images, and find free-space violations: points that other sweeps saw through.

A range image (`RangeImage`) holds the nearest return of a sweep in each direction. It is in the
scanner's frame at the firing time of each ray, where the rays form a regular grid of rings and
azimuth steps. The space before a return is free (Thrun et al., "Probabilistic Robotics", 2005, ch.
9). A scanner that does not fire in order of azimuth (solid state, rosettes) faces a cell at several
times, whose spread widens the margin. It gets several images with ever larger cells. `FreeSpace`
holds the images of a window's sweeps, and tests points against them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.free_space.sensor import (
    BLOCK,
    FEW_POINTS,
    PI,
    ZERO,
    AimedRays,
    Sensors,
    aim_rays,
    azimuth_of,
    fires_by_azimuth,
    measure_layout,
    move_to_scanner,
    move_to_time,
)
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import Kernel, inlined, num_threads
from densify.geometry.types import Bool, Float, Float32, Int, RegisteredSweep, Stretch

REACH_S = 1.0
"""Greatest time between a sweep and the sweeps that are tested against its points."""
FREE_MARGIN = 0.4, 0.015
"""Least distance of a return beyond a seen-through point: the larger of metres, share of range."""
_CELLS_PER_STEP = 1.15  # a cell a little larger than a step is rarely empty
_MIN_FILLED = 6  # least number of filled cells among the 3 x 3 around a direction
# Rings closer than this always share a row. Other rings have their own rows for far points.
_MIN_FAR_ROW_RAD = np.deg2rad(0.15)
_PENALTY = 1000  # of a return that is not beyond the point; above the sum of all cells counted


class ScannerImage(NamedTuple):
    """The range image of one scanner, R rows by C columns that start at azimuth -pi and wrap."""

    # (1,C) or (R,C) float32 seconds after the reference time at which the scanner faced the column
    # or cell, middle of all such times
    offset_s: Float32
    spread_s: Float32  # greatest difference from that time in seconds, same shape
    # Greatest difference between two estimates of the time at which a point is faced, if each
    # column has one time. A larger difference is at the seam between two turns.
    max_error_s: float
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
        """Return the range images of a sweep, at least one for each of its scanners.

        Args:
            registered: Deskewed sweep with its twists.
            num_together: Number of sweeps whose counts are added up. The columns are finer by this
                factor.
            by_ring: True also uses single rings: dense rings for far points, where an error of
                registration is smaller than their spacing, and isolated rings at their rays.
        """
        images: list[ScannerImage] = []
        for lidar in np.unique(registered.sweep.lidar).tolist():
            rays = aim_rays(registered, lidar)
            for cells in _choose_cells(rays, num_together, by_ring):
                images.append(_make_image(registered, lidar, rays, cells))
                # Enough rays can be tested. Larger cells would call the gaps between returns free.
                if cells.may_be_last and _share_testable(images[-1], rays) >= 0.8:
                    break
        return RangeImage(tuple(images))

    def sees_through(
        self,
        points: Float,
        margin_m: float,
        margin_fraction: float,
        min_filled: int = _MIN_FILLED,
        velocity_m_s: Float | Float32 | None = None,
    ) -> Bool:
        """Return the mask (N,) of the points that the sweep certainly saw through.

        At least ``min_filled`` of the 3 x 3 cells around a point's direction must hold a return.
        Every return in these cells must be farther than the point by more than ``max(margin_m,
        margin_fraction * range)``. A larger margin tolerates errors of registration, but misses
        moving objects close to a background. Points are in the lidar frame at the reference time,
        and velocities (N,3) without ego-motion in the same frame, None for static points.
        """
        margins = margin_m, margin_fraction
        num_beyond = self.count_beyond(points, margins, min_filled, velocity_m_s)
        return np.asarray((num_beyond >= min_filled).any(axis=0))

    def count_beyond(
        self,
        points: Float,
        margins: tuple[float, float],
        min_filled: int = 1,
        velocity_m_s: Float | Float32 | None = None,
    ) -> NDArray[np.int16]:
        """Return the number of cells with a return around each point whose returns are all beyond.

        The 3 x 3 cells around a point's direction are counted, in each image. The counts of several
        sweeps may be added.

        Args:
            points: (N,3) positions in metres, lidar frame at the reference time of the sweep.
            margins: Least distance of a return beyond a point: metres, and share of the range. The
                larger one counts.
            min_filled: Least number of cells with a return.
            velocity_m_s: (N,3) lidar frame, without ego-motion; None for static points.

        Returns:
            (S,N) counts in S images: 0 if fewer than ``min_filled`` cells have a return, far below
            0 if one of the returns is not beyond the point.
        """
        points32 = np.ascontiguousarray(points, np.float32)
        velocity = np.zeros((1, 3)) if velocity_m_s is None else velocity_m_s
        velocity32 = np.ascontiguousarray(velocity, np.float32)
        margins32 = np.array(margins, np.float32)
        num_beyond = np.zeros((len(self.scanners), len(points)), np.int16)
        for image, image_count in zip(self.scanners, num_beyond, strict=True):
            _count_beyond.over_rows(
                len(points), points32, velocity32, image, margins32, min_filled, image_count
            )
        return num_beyond


@dataclass(frozen=True)
class FreeSpace:
    """The free space that each of the W sweeps of a window observed; sweeps are 0 to W - 1.

    Consecutive sweeps of a fast scanner, too sparse alone, are tested together as a batch.
    """

    images: tuple[RangeImage, ...]  # W range images
    T_lidar_world: tuple[Float, ...]  # W transforms (4,4) at the reference times
    clock: Clock  # reference times of the sweeps
    sensors: Sensors  # scanners, with the angles between their rays
    batches: tuple[tuple[int, ...], ...]  # indices of each batch's sweeps, see `Clock.batches`

    @staticmethod
    def of(stretch: Stretch) -> FreeSpace:
        """Return the free space that the registered, deskewed sweeps of a window observed."""
        clock = Clock.of(stretch)
        batches = clock.batches()
        make_image = partial(RangeImage.of, num_together=max(map(len, batches)), by_ring=True)
        with ThreadPoolExecutor(num_threads()) as pool:
            images = tuple(pool.map(make_image, stretch.sweeps))
        T_lidar_world = tuple(poses.inverse(sweep.T_world_lidar) for sweep in stretch.sweeps)
        return FreeSpace(images, T_lidar_world, clock, Sensors.of(stretch.sweeps), batches)

    def gap_m(self, position: Float, i: int) -> float:
        """Return the distance (m) between rings of sweep i, at a (3,) world position."""
        position_lidar = poses.transform(self.T_lidar_world[i], position[None])
        return float(self.sensors.finest_gap_m(position_lidar)[0])

    def others(self, i: int) -> list[int]:
        """Return the index of the first sweep of each other batch within 1 s of sweep i."""
        return [
            batch[0]
            for batch in self.batches
            if i not in batch and any(self.clock.near(i, j, REACH_S) for j in batch)
        ]

    def seen_through(self, points: Float, j: int, velocity_m_s: Float | None = None) -> Bool:
        """Return the mask (N,) of the points that the batch of sweep j certainly saw through.

        Every return near the direction of the point must be clearly farther away, in all sweeps of
        the batch. Together the sweeps must have enough returns near this direction.

        Args:
            points: (N,3) positions in the world frame at the reference time of sweep j.
            j: Index of the sweep.
            velocity_m_s: (N,3) velocities in the world frame, None for static points.
        """
        batch = next(batch for batch in self.batches if j in batch)
        # With several sweeps only the sum of their counts must be large enough.
        min_filled = _MIN_FILLED if len(batch) == 1 else 1
        counts = []  # one (S,N) array of `count_beyond` for each sweep of the batch
        for k in batch:
            T_lidar_world = self.T_lidar_world[k]
            points_k, velocity_lidar = points, None
            if velocity_m_s is not None:
                velocity_lidar = poses.rotate(T_lidar_world, velocity_m_s)
                if k != j:  # the points move on to the time of sweep k
                    duration_s = self.clock.time_s[k] - self.clock.time_s[j]
                    points_k = points + duration_s * velocity_m_s
            points_lidar = poses.transform(T_lidar_world, points_k)
            image = self.images[k]
            counts.append(image.count_beyond(points_lidar, FREE_MARGIN, min_filled, velocity_lidar))
        # A sweep that lacks a scanner has fewer images: its counts cannot be added to the others.
        addable = [count for count in counts if len(count) == len(counts[0])]
        is_free: Bool = (np.sum(addable, axis=0) >= _MIN_FILLED).any(axis=0)
        return is_free


class _Cells(NamedTuple):
    """The cells of one image, and the range in which it is used."""

    row_edges_rad: Float32  # (R+1,) float32 elevations of the row borders, ascending
    num_columns: int
    from_m: float = 0.0
    to_m: float = np.inf
    # True if every other row is a single ring, and the rows between hold no ring
    has_lone_rings: bool = False
    # True if the image is the last one unless too many of its cells are empty
    may_be_last: bool = False


def _make_image(
    registered: RegisteredSweep, lidar: int, rays: AimedRays, cells: _Cells
) -> ScannerImage:
    """Return the range image of scanner number ``lidar``, made from its rays."""
    sweep = registered.sweep
    shape = len(cells.row_edges_rad) - 1, cells.num_columns
    row, column = _cell_of(rays, cells.row_edges_rad, cells.num_columns)
    in_rows = np.flatnonzero(row >= 0)
    cell = row[in_rows] * cells.num_columns + column[in_rows]

    nearest_m = _reduce_3x3(np.minimum, np.inf, cell, rays.range_m[in_rows], shape)
    is_filled = np.zeros(shape, np.uint8)
    is_filled.reshape(-1)[cell] = 1
    num_filled = _join_3x3(np.add, is_filled, 0)
    if cells.has_lone_rings:
        num_filled[::2] *= 2  # three filled cells of a lone ring count as six
        num_filled[1::2] = 0  # a cell between two lone rings is no evidence

    if fires_by_azimuth(rays):
        first_s = last_s = _offset_per_column(column, rays.offset_s, cells.num_columns)[None]
    else:
        first_s, last_s = _cell_times(cell, rays.offset_s[in_rows], shape)
    half = np.float32(0.5)  # stays in float32
    return ScannerImage(
        offset_s=half * (first_s + last_s),
        spread_s=half * (last_s - first_s),
        max_error_s=0.1 * float(np.ptp(rays.offset_s)),  # a tenth of a turn
        nearest_m=nearest_m,
        num_filled=num_filled,
        row_edges_rad=cells.row_edges_rad,
        origin_m=sweep.origin_m(lidar).astype(np.float32),
        axes=sweep.axes(lidar).astype(np.float32, order="C"),
        twists=np.stack([registered.twist_before, registered.twist_after]).astype(np.float32),
        from_m=cells.from_m,
        to_m=cells.to_m,
    )


def _cell_of(rays: AimedRays, row_edges_rad: Float32, num_columns: int) -> tuple[Int, Int]:
    """Return the row (-1 outside) and the column of each ray, (N,) each."""
    row = np.searchsorted(row_edges_rad, rays.elevation, side="right") - 1
    row[row == len(row_edges_rad) - 1] = -1  # above the last edge
    column = ((rays.azimuth + PI) * (np.float32(num_columns) / (PI + PI))).astype(np.int64)
    return row, column % num_columns


def _reduce_3x3(
    join: np.ufunc, empty: float, cell: Int, values: Float32, shape: tuple[int, int]
) -> Float32:
    """Return the (R,C) result of joining the values in the 3 x 3 cells around each cell.

    Without values the result is ``empty``. ``cell`` (N,) is the flat index of each value's cell.
    """
    joined = np.full(shape, empty, np.float32)
    join.at(joined.reshape(-1), cell, values)
    return _join_3x3(join, joined, empty)


def _join_3x3(join: Callable[..., Any], cells: NDArray[Any], empty: float) -> NDArray[Any]:
    """Return the (R,C) cells joined with their eight neighbours. Columns wrap around."""
    in_row = join(join(np.roll(cells, 1, axis=1), cells), np.roll(cells, -1, axis=1))
    padded = np.pad(in_row, ((1, 1), (0, 0)), constant_values=empty)
    return np.asarray(join(join(padded[:-2], padded[1:-1]), padded[2:]))


def _cell_times(cell: Int, offset_s: Float32, shape: tuple[int, int]) -> tuple[Float32, Float32]:
    """Return the (R,C) first and last firing time (s) in the 3 x 3 cells around each, 0 if none."""
    first_s = _reduce_3x3(np.minimum, np.inf, cell, offset_s, shape)
    last_s = _reduce_3x3(np.maximum, -np.inf, cell, offset_s, shape)
    first_s[np.isinf(first_s)] = last_s[np.isinf(last_s)] = 0  # no ray in the nine cells
    return first_s, last_s


def _offset_per_column(column: Int, offset_s: Float32, num_columns: int) -> Float32:
    """Return the (C,) mean firing time (s) of each column, interpolated in columns without rays."""
    num_rays = np.bincount(column)
    with_rays = np.flatnonzero(num_rays)
    if not len(with_rays):
        return np.zeros(num_columns, np.float32)
    mean_s = np.bincount(column, offset_s)[with_rays] / num_rays[with_rays]
    return np.interp(np.arange(num_columns), with_rays, mean_s).astype(np.float32)


def _share_testable(image: ScannerImage, rays: AimedRays) -> float:
    """Return the share of the rays with enough filled cells of the image around them."""
    row, column = _cell_of(rays, image.row_edges_rad, image.num_filled.shape[1])
    return float((image.num_filled[np.maximum(row, 0), column] >= _MIN_FILLED).mean())


def _choose_cells(rays: AimedRays, num_together: int, by_ring: bool) -> list[_Cells]:
    """Return the cells of one scanner's images, the finest first."""
    if len(rays.azimuth) < FEW_POINTS:  # too few to measure their layout
        return [_uniform_cells(rays, row_rad=np.deg2rad(2.0), column_rad=np.deg2rad(1.0))]
    layout = measure_layout([rays])
    column_rad = _CELLS_PER_STEP * (layout.azimuth_step_rad / num_together)
    if layout.rings_rad is not None:
        return _cells_of_rings(layout.rings_rad, column_rad, by_ring)
    if not layout.unordered:
        row_rad = _CELLS_PER_STEP * float(np.median(layout.table.elevation_gap_rad))
        return [_uniform_cells(rays, row_rad, column_rad)]
    # Square cells of up to five sizes. The finest follow the closest tenth of the rays.
    gap_rad = layout.table.at(rays.azimuth, rays.elevation)[:, 1]
    finest_rad = _CELLS_PER_STEP * float(np.percentile(gap_rad, 10))
    # A step of azimuth is shorter on the sphere by the cosine of the elevation.
    shortening = float(np.cos(np.median(rays.elevation)))
    return [
        _uniform_cells(rays, side_rad, side_rad / shortening)._replace(may_be_last=True)
        for side_rad in finest_rad * 2.0 ** np.arange(5)
    ]


def _cells_of_rings(rings: Float, column_rad: float, by_ring: bool) -> list[_Cells]:
    """Return the cells of a scanner with rings (K,), of a second image too if ``by_ring``."""
    borders = 0.5 * (rings[1:] + rings[:-1])
    # The first and the last ring are in the middle of their rows, too.
    outer: Float = 2 * rings[[0, -1]] - borders[[0, -1]]
    edges: Float = np.concatenate([outer[:1], borders, outer[1:]])
    near_cells = _grid(_merge_rows(edges, 3 * _MIN_FAR_ROW_RAD), column_rad)
    far_edges = _merge_rows(edges, _MIN_FAR_ROW_RAD)
    if by_ring and len(near_cells.row_edges_rad) != len(far_edges):
        # A point's 3 x 3 cells reach 1.5 rows up and down, from the range ``far_m`` on over the
        # error of registration, 0.1 m.
        far_m = 0.1 / (1.5 * float(np.diff(far_edges).min()))
        far_cells = _grid(far_edges, column_rad)
        return [near_cells._replace(to_m=far_m), far_cells._replace(from_m=far_m)]

    # A ring at least 1 degree from all others is alone: it observes free space only at its rays.
    # A second image has a row around each lone ring, and a row between two lone rings.
    gap_rad = np.diff(rings, prepend=-np.inf, append=np.inf)
    is_lone = np.minimum(gap_rad[:-1], gap_rad[1:]) >= np.deg2rad(1.0)
    if not by_ring or not is_lone.any():
        return [near_cells]
    lone_edges: Float = rings[is_lone][:, None] + [-_MIN_FAR_ROW_RAD, _MIN_FAR_ROW_RAD]
    return [near_cells, _grid(lone_edges.ravel(), column_rad)._replace(has_lone_rings=True)]


def _grid(row_edges_rad: NDArray[np.floating], column_rad: float) -> _Cells:
    """Return cells with these edges of rows (R+1,), and columns of about this width."""
    num_columns = int(np.clip(round(2 * np.pi / column_rad), 90, 8192))
    return _Cells(row_edges_rad.astype(np.float32), num_columns)


def _merge_rows(edges: Float, min_rad: float) -> Float:
    """Return the first and last edge, and edges between that are at least ``min_rad`` apart."""
    merged = [edges[0]]
    for edge in edges[1:]:
        if edge - merged[-1] >= min_rad:
            merged.append(edge)
    # The last edge replaces the last edge that was kept, unless that is the first edge.
    return np.array([*merged[: max(1, len(merged) - 1)], edges[-1]])


def _uniform_cells(rays: AimedRays, row_rad: float, column_rad: float) -> _Cells:
    """Return cells in equal rows that cover the elevations of all rays and elevation 0."""
    # The lowest ray is in the middle of its row.
    low_rad = float(rays.elevation.min(initial=0.0)) - 0.5 * row_rad
    num_rows = int((float(rays.elevation.max(initial=0.0)) - low_rad) / row_rad) + 1
    return _grid(low_rad + row_rad * np.arange(num_rows + 1), column_rad)


@inlined
def _column(azimuth, num_columns):  # type: ignore[no-untyped-def]
    """Return the column of an azimuth, 0 for NaN. Columns start behind the scanner."""
    if not abs(azimuth) <= PI:  # True for NaN
        return np.int32(0)
    # 32 bits, because more such numbers fit into a vector instruction.
    column = np.int32((azimuth + PI) * (np.float32(num_columns) / (PI + PI)))
    return column - np.int32(num_columns) if column >= num_columns else column


@inlined
def _fill_rows(elevation, size, edges, row):  # type: ignore[no-untyped-def]
    """Fill ``row`` with the interval of ascending edges that holds each elevation, -1 outside."""
    # A binary search for many elevations at once. The inner loop, of equal steps, is vectorized.
    last, step = np.int32(len(edges) - 1), np.int32(1)
    row[:size] = 0
    while 2 * step < last:  # to the largest power of 2 that is needed
        step *= np.int32(2)
    while step > 0:
        for k in range(size):
            higher = min(row[k] + step, last)
            row[k] = higher if elevation[k] >= edges[higher] else row[k]
        step //= np.int32(2)
    for k in range(size):
        is_inside = elevation[k] >= edges[0] and elevation[k] < edges[last]
        row[k] = row[k] if is_inside else np.int32(-1)


@inlined
def _speed_of(point, velocity, twist):  # type: ignore[no-untyped-def]
    """Return the speed in m/s of a point (3,) relative to the lidar with this twist (6,)."""
    # The lidar's own velocity at the point is v + w x point.
    vx = velocity[0] - (twist[3] + twist[1] * point[2] - twist[2] * point[1])
    vy = velocity[1] - (twist[4] + twist[2] * point[0] - twist[0] * point[2])
    vz = velocity[2] - (twist[5] + twist[0] * point[1] - twist[1] * point[0])
    return np.sqrt(vx * vx + vy * vy + vz * vz)


@inlined
def _find_cells(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column):  # type: ignore[no-untyped-def]
    """Find when and in which cell the scanner faced ``size`` points from index ``start`` on.

    Fills the arrays, one value for each point: position x, y, z in the scanner's frame at that
    time, the time, the elevation, and the row (-1 outside the image) and column of the cell.
    ``velocity`` is (N,3), or (1,3) for all.
    """
    # The time gives the position, the position gives the cell, and the cell gives the time. Two
    # iterations from the position at the reference time converge. The third finds the last cell.
    num_columns, by_azimuth = image.nearest_m.shape[1], len(image.offset_s) == 1
    time_s[:size] = ZERO
    for iteration in range(3):
        for k in range(size):
            i, t = start + k, time_s[k]
            j = min(i, len(velocity) - 1)
            x[k], y[k], z[k] = move_to_time(
                points[i, 0] + t * velocity[j, 0], points[i, 1] + t * velocity[j, 1],
                points[i, 2] + t * velocity[j, 2], t, image.twists,
            )  # fmt: skip
        move_to_scanner(x, y, z, size, image.origin_m, image.axes)
        for k in range(size):
            column[k] = _column(azimuth_of(x[k], y[k]), num_columns)
        # Columns with one time need the row only in the end.
        if iteration == 2 or not by_azimuth:
            for k in range(size):
                elevation[k] = azimuth_of(np.sqrt(x[k] * x[k] + y[k] * y[k]), z[k])
            _fill_rows(elevation, size, image.row_edges_rad, row)
        if iteration < 2:
            for k in range(size):
                time_s[k] = image.offset_s[0 if by_azimuth else max(row[k], 0), column[k]]


@Kernel
def _count_beyond(begin, end, points, velocity, image, margins, min_filled, num_beyond):  # type: ignore[no-untyped-def]
    """Add to ``num_beyond`` (N,) one image's counts of `RangeImage.count_beyond`."""
    by_azimuth = len(image.offset_s) == 1
    max_error_s = np.float32(image.max_error_s)
    x, y, z, time_s, elevation = np.empty((5, BLOCK), np.float32)
    row, column = np.empty((2, BLOCK), np.int32)
    # Each point needs a long chain of steps. A block of points takes every step in parallel.
    for start in range(begin, end, BLOCK):
        size = min(BLOCK, end - start)
        _find_cells(points, velocity, start, size, image, x, y, z, time_s, elevation, row, column)
        for k in range(size):
            i, horizontal_m = start + k, np.sqrt(x[k] * x[k] + y[k] * y[k])
            r, c = row[k], column[k]
            if r < 0 or image.num_filled[r, c] < min_filled:
                continue
            range_m = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])
            if range_m < image.from_m or range_m >= image.to_m:
                continue

            # The margin grows with the range and with the uncertainty of the firing time.
            margin_m = max(margins[0], margins[1] * range_m)
            error_s = abs(image.offset_s[0 if by_azimuth else r, c] - time_s[k])
            if by_azimuth:
                # Between two turns a spinning scanner skips or repeats a sector: no evidence.
                if error_s > max_error_s:
                    continue
            else:
                # Within the uncertain time the point may move.
                error_s += image.spread_s[r, c]
                twist = image.twists[0 if time_s[k] < ZERO else 1]
                speed_m_s = _speed_of(points[i], velocity[min(i, len(velocity) - 1)], twist)
                margin_m += error_s * speed_m_s

            if image.nearest_m[r, c] > range_m + margin_m:
                num_beyond[i] += image.num_filled[r, c]
            else:
                num_beyond[i] -= _PENALTY
