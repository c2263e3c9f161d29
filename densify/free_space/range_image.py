# SPDX-License-Identifier: MIT
"""What a sweep saw in every direction, and what it therefore saw *through*.

A range image is built in the scanner's own frame at each ray's own firing time, where the rays form
a regular grid; a point of the deskewed sweep finds its cell by asking when the scanner faced it.
Its cells follow the sensor: rows its rings, columns its azimuth step, both found in the returns
(Thrun et al., "Probabilistic Robotics", 2005, ch. 9, for free space from range images).

A scanner whose firing time does not go with the azimuth (solid state, rosettes) faces a cell at
several moments of a sweep. There each cell knows the middle of the times at which it and those
around it were looked at, and how far from it they were: a point is asked for at the middle, and
what it and the scanner move in the rest is added to the margin. Rays without order are denser here
than there, and no one size of cells is right: there are images of several sizes, each twice as
coarse as the one before, and each vouches for what it has enough returns around.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.free_space import rays as kernels
from densify.free_space import rings as measure
from densify.free_space.sensor import (
    FEW_POINTS,
    Aimed,
    aimed,
    density_table,
    in_lines,
    some_sectors,
)
from densify.geometry.types import Bool, Float, Float32, RegisteredSweep

_CELLS_PER_STEP = 1.15  # a cell a little larger than a step is rarely empty
_MIN_ROW_RAD = np.deg2rad(0.45)
# Rings closer than that are one row wherever they are; each other one has its own from as far away
# on as three of them reach so far up and down, which errors of registration do not.
_MIN_FAR_ROW_RAD, _SLACK_M = np.deg2rad(0.15), 0.1
# A ring so far from all others tells of what is so close to its rays; three full cells are enough.
_LONE_RAD, _ON_RING_RAD, _OF_ONE_RING = np.deg2rad(1.0), np.deg2rad(0.15), 2
_SETTLED = 0.1  # of a turn
_MIN_COLUMNS, _MAX_COLUMNS = 90, 8192
_DENSEST = 10  # percent of an unordered scanner's returns: the finest cells
_MIN_FILLED, _VOUCHED, _MAX_SIZES = 6, 0.8, 5  # sizes until most returns have so many cells around


@dataclass(frozen=True)
class RangeImage:
    """Range images of a sweep, one or more per scanner in it."""

    scanners: tuple[ScannerImage, ...]

    @staticmethod
    def of(registered: RegisteredSweep, num_together: int = 1, by_ring: bool = False) -> RangeImage:
        """Build from a deskewed sweep (its rays are put back to their firing times).

        num_together: sweeps that will be asked together. Of scanners that turn the columns are so
        many times as many: as many as returns of all these sweeps fill. by_ring: rings tell by
        themselves too. Dense ones, which are one row, have each their own for what is far away,
        where a slight error of registration is less than they are apart. One far from all others
        tells of what is right on its rays: the ring below it meets the road before it."""
        ids = np.unique(registered.sweep.lidar)
        return RangeImage(
            tuple(
                image
                for i in ids
                for image in ScannerImage.all_of(registered, int(i), num_together, by_ring)
            )
        )

    def sees_through(
        self,
        points: Float,
        margin_m: float,
        margin_fraction: float,
        min_filled: int = 6,
        velocity_m_s: Float | Float32 | None = None,
    ) -> Bool:
        """(N,3) lidar frame at the reference time -> (N,) True where the space is certainly free.

        Concretely: of the 3 x 3 cells around the point's direction at least ``min_filled`` hold a
        return, and every return in them lies farther than the point by more than
        ``max(margin_m, margin_fraction * range)``. A larger margin forgives errors of registration
        and misses movers close to a background.

        velocity_m_s: (N,3) of the points, if they move: the scanner faced them earlier or later.
        """
        margins_m = margin_m, margin_fraction
        beyond = self.num_beyond(points, margins_m, min_filled, velocity_m_s)
        return np.asarray((beyond >= min_filled).any(axis=0))

    def num_beyond(
        self,
        points: Float,
        margins_m: tuple[float, float],
        least: int = 1,
        velocity_m_s: Float | Float32 | None = None,
    ) -> NDArray[np.int16]:
        """(S,N) for each image how many of the 3 x 3 cells around each point's direction hold a
        return, where every return in them lies farther as `sees_through` has it; far below 0 where
        one does not, 0 where fewer than ``least`` are filled. What several sweeps say may be added.
        """
        points32 = np.ascontiguousarray(points, np.float32)
        velocity = np.zeros((0, 3), np.float32)
        if velocity_m_s is not None:
            velocity = np.ascontiguousarray(velocity_m_s, np.float32)
        margins = np.array(margins_m, np.float32)
        beyond = np.zeros((len(self.scanners), len(points)), np.int16)
        for scanner, own in zip(self.scanners, beyond, strict=True):
            told, in_reach, of_told = scanner.told(points32), points32, velocity
            if not told.all():
                in_reach, of_told = points32[told], velocity[told[: len(velocity)]]
            num = np.zeros(len(in_reach), np.int16)
            kernels.see_beyond.over_rows(
                len(num), in_reach, of_told, scanner.tables, margins, least, num
            )
            own[told] = num
        return beyond


@dataclass(frozen=True)
class ScannerImage:
    """One scanner's range image.

    offset_s, spread_s: (1,C) or (R,C) float32, the middle of the times at which the scanner faced
    the column or cell, and how far from it they were at most; columns start at azimuth -pi and wrap
    around. settled_s: where there is one time for a column, by how much the time at which a point
    is faced may differ from the first guess: more is the seam of the turn. nearest_m: (R,C)
    float32, nearest return within the 3 x 3 cells around each cell, inf if none. num_filled: (R,C)
    uint8, how many of those nine hold a return. row_edges_rad: (R+1,) float32 ascending elevations.
    origin_m: (3,) float32 of the scanner in the lidar frame. axes: (3,3) float32 from the lidar
    frame's to its own, and whether they differ. twists: (2,6) float32, the sweep's
    before and after its reference time. from_m, to_m: how far away it tells of points.
    """

    offset_s: Float32
    spread_s: Float32
    settled_s: np.float32
    nearest_m: Float32
    num_filled: NDArray[np.uint8]
    row_edges_rad: Float32
    origin_m: Float32
    axes: Float32
    turned: np.bool_
    twists: Float32
    from_m: float
    to_m: float

    @staticmethod
    def all_of(
        registered: RegisteredSweep, lidar: int, num_together: int = 1, by_ring: bool = False
    ) -> tuple[ScannerImage, ...]:
        """One, or of an unordered scanner several with cells of different sizes, finest first, or
        of dense rings one for what is near and one for what is far, see `RangeImage.of`."""
        rays = aimed(registered, lidar)
        order = measure.firing_order(rays.azimuth, rays.offset_s)
        duration_s = order.period_s or float(np.ptp(rays.offset_s)) if len(rays.offset_s) else 0.0
        origin_m = registered.sweep.origin_m(lidar).astype(np.float32)
        twists = np.stack([registered.twist_before, registered.twist_after]).astype(np.float32)

        def image(cells: _Cells) -> ScannerImage:
            row_edges_rad, num_columns = cells.row_edges_rad, cells.num_columns
            shape = len(row_edges_rad) - 1, num_columns
            nearest_m, num_filled = np.empty(shape, np.float32), np.empty(shape, np.uint8)
            offset_s = np.zeros((1 if order.by_azimuth else shape[0], num_columns), np.float32)
            spread_s = np.zeros_like(offset_s)
            kernels.fill(rays, row_edges_rad, nearest_m, num_filled)
            if cells.lone:
                num_filled[::2] *= _OF_ONE_RING
                num_filled[1::2] = 0  # between two rings neither tells
            if order.by_azimuth:
                offset_s[0] = _offset_per_column(rays, num_columns)
            else:
                kernels.fill_times(rays, row_edges_rad, offset_s, spread_s)
            return ScannerImage(
                offset_s=offset_s,
                spread_s=spread_s,
                settled_s=np.float32(_SETTLED * duration_s),
                nearest_m=nearest_m,
                num_filled=num_filled,
                row_edges_rad=row_edges_rad,
                origin_m=origin_m,
                axes=registered.sweep.axes(lidar).astype(np.float32, order="C"),
                turned=np.bool_(registered.sweep.R_scanner_lidar is not None),
                twists=twists,
                from_m=cells.from_m,
                to_m=cells.to_m,
            )

        images: list[ScannerImage] = []
        for cells in _cells(rays, num_together, by_ring):
            if cells.coarser and images and images[-1].share_vouched(rays) >= _VOUCHED:
                break
            images.append(image(cells))
        return tuple(images)

    def told(self, points: Float32) -> Bool:
        """(N,3) lidar frame -> (N,) whether it tells of points so far away."""
        if self.from_m == 0 and self.to_m == np.inf:
            return np.ones(len(points), bool)
        away = points - self.origin_m
        squared = np.einsum("ij,ij->i", away, away)
        return np.asarray((squared >= self.from_m**2) & (squared < self.to_m**2))

    def share_vouched(self, rays: Aimed) -> float:
        """Share of the rays with enough filled cells around them to tell of free space."""
        num_rows, num_columns = self.num_filled.shape
        row = np.clip(np.searchsorted(self.row_edges_rad, rays.elevation) - 1, 0, num_rows - 1)
        column = ((rays.azimuth + np.pi) * (num_columns / (2 * np.pi))).astype(np.int64)
        return float((self.num_filled[row, column % num_columns] >= _MIN_FILLED).mean())

    @property
    def tables(self) -> kernels.Tables:
        """What `densify.free_space.rays.see_beyond` looks points up in."""
        return kernels.Tables(
            self.offset_s,
            self.spread_s,
            self.settled_s,
            self.nearest_m,
            self.num_filled,
            self.row_edges_rad,
            self.origin_m,
            self.axes,
            self.turned,
            self.twists,
        )


class _Cells(NamedTuple):
    """Those of one image: edges of the rows (R+1,), and how far away they tell of points. lone:
    every other row is a ring, the others lie between two. coarser: of use where the image before
    has too many empty ones."""

    row_edges_rad: Float32
    num_columns: int
    from_m: float = 0.0
    to_m: float = np.inf
    lone: bool = False
    coarser: bool = False


def _cells(rays: Aimed, num_together: int, by_ring: bool) -> list[_Cells]:
    """The cells of a scanner's images: of an unordered scanner's, finest first, as many are of use
    as it takes until cells are seldom empty; rings that tell by themselves too have two."""
    if len(rays.azimuth) < FEW_POINTS:
        return [_grid(_uniform_edges(rays.elevation, np.deg2rad(2.0)), np.deg2rad(1.0))]
    some = some_sectors(rays)
    rings = measure.find_rings(some.elevation)
    if rings is not None:
        edges = _edges_between(rings)
        step = measure.step_along(some.azimuth, np.searchsorted(edges, some.elevation))
        step *= _CELLS_PER_STEP / num_together
        near, far = (_no_closer(edges, least) for least in (_MIN_ROW_RAD, _MIN_FAR_ROW_RAD))
        if not by_ring:
            return [_grid(near, step)]
        if len(near) == len(far):
            lone, cells = _lone(rings), [_grid(near, step)]
            return [*cells, _grid(lone, step)._replace(lone=True)] if len(lone) else cells
        far_m = _SLACK_M / (1.5 * float(np.diff(far).min()))
        return [_grid(near, step)._replace(to_m=far_m), _grid(far, step)._replace(from_m=far_m)]
    if in_lines(some):
        row_step = measure.step_between(some.azimuth, some.elevation)
        step = measure.step_along(some.azimuth, np.floor(some.elevation / row_step))
        rows = _uniform_edges(rays.elevation, _CELLS_PER_STEP * row_step)
        return [_grid(rows, _CELLS_PER_STEP * step / num_together)]
    spacing = density_table([rays]).at(rays.azimuth, rays.elevation)[:, 1]
    finest = _CELLS_PER_STEP * float(np.percentile(spacing, _DENSEST))
    flatten = float(np.cos(np.median(rays.elevation)))
    return [
        _grid(_uniform_edges(rays.elevation, size), size / flatten)._replace(coarser=True)
        for size in finest * 2.0 ** np.arange(_MAX_SIZES)
    ]


def _grid(edges: NDArray[np.floating], step: float) -> _Cells:
    num_columns = int(np.clip(round(2 * np.pi / step), _MIN_COLUMNS, _MAX_COLUMNS))
    return _Cells(edges.astype(np.float32), num_columns)


def _edges_between(rings: Float) -> Float:
    """A ring's row reaches half the way to the next ring, the outermost ones as far outwards."""
    middle = 0.5 * (rings[1:] + rings[:-1])
    outer: Float = 2 * rings[[0, -1]] - middle[[0, -1]]
    edges: Float = np.concatenate([outer[:1], middle, outer[1:]])
    return edges


def _lone(rings: Float) -> Float:
    """Edges below and above each ring that is far from all others, (2R,); none if no ring is."""
    gaps = np.diff(rings, prepend=-np.inf, append=np.inf)
    lone = rings[np.minimum(gaps[:-1], gaps[1:]) >= _LONE_RAD]
    edges: Float = (lone[:, None] + [-_ON_RING_RAD, _ON_RING_RAD]).ravel()
    return edges


def _no_closer(edges: Float, distance: float) -> Float:
    """Some of the edges, the first and the last among them: rows of dense rings are joined, or a
    slight error of registration would leave the 3 x 3 cells that vouch for a point."""
    kept = [edges[0]]
    for edge in edges[1:]:
        if edge - kept[-1] >= distance:
            kept.append(edge)
    return np.array([*kept[: max(1, len(kept) - 1)], edges[-1]])


def _uniform_edges(elevation: Float32, step: float) -> NDArray[np.floating]:
    low = float(elevation.min(initial=0.0)) - 0.5 * step
    num_rows = int((float(elevation.max(initial=0.0)) - low) / step) + 1
    return low + step * np.arange(num_rows + 1)


def _offset_per_column(rays: Aimed, num_columns: int) -> Float32:
    """Mean firing time of each column's returns; of a column without any that of those beside."""
    num_rays, sum_s = np.zeros(num_columns, np.int64), np.zeros(num_columns)
    kernels.add_times(rays, num_rays, sum_s)
    seen = np.flatnonzero(num_rays)
    if not len(seen):
        return np.zeros(num_columns, np.float32)
    return np.interp(np.arange(num_columns), seen, sum_s[seen] / num_rays[seen]).astype(np.float32)
