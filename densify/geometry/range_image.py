# SPDX-License-Identifier: MIT
"""What a sweep saw in every direction, and what it therefore saw *through*.

A range image is built in the scanner's own frame at each ray's own firing time, where the rays form
a regular grid; a point of the deskewed sweep finds its cell by asking when the scanner faced it.
Its cells follow the sensor: rows its rings, columns its azimuth step, both found in the returns
(Thrun et al., "Probabilistic Robotics", 2005, ch. 9, for free space from range images).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from densify.kernels import rays
from densify.types import Bool, Float, Float32, Int, RegisteredSweep

_CELLS_PER_STEP = 1.15  # a cell a little larger than a step is rarely empty
_MIN_POINTS_TO_MEASURE = 200
_MANY_POINTS = 15_000
_SECTOR_RAD = np.deg2rad(5.0)
_MIN_ROW_RAD = np.deg2rad(0.45)
_RING_BIN_RAD = np.deg2rad(0.02)
_MIN_PROMINENCE = 0.5
_MIN_RETURNS_PER_RING = 30
_MIN_RING_SHARE = 0.8


@dataclass(frozen=True)
class RangeImage:
    """Range images of a sweep, one per scanner in it."""

    scanners: tuple[ScannerImage, ...]

    @staticmethod
    def of(registered: RegisteredSweep) -> RangeImage:
        """Build from a deskewed sweep (its rays are put back to their firing times)."""
        ids = np.unique(registered.sweep.lidar)
        return RangeImage(tuple(ScannerImage.of(registered, int(i)) for i in ids))

    def sees_through(
        self,
        points: Float,
        margin_m: float,
        margin_fraction: float,
        min_filled: int = 6,
        velocity_m_s: Float | None = None,
    ) -> Bool:
        """(N,3) lidar frame at the reference time -> (N,) True where the space is certainly free.

        Concretely: of the 3 x 3 cells around the point's direction at least ``min_filled`` hold a
        return, and every return in them lies farther than the point by more than
        ``max(margin_m, margin_fraction * range)``. A larger margin forgives errors of registration
        and misses movers close to a background.

        velocity_m_s: (N,3) of the points, if they move: the scanner faced them earlier or later.
        """
        points32 = np.ascontiguousarray(points, np.float32)
        velocity = np.zeros((0, 3), np.float32)
        if velocity_m_s is not None:
            velocity = np.ascontiguousarray(velocity_m_s, np.float32)
        margins = np.array([margin_m, margin_fraction], np.float32)
        free = np.zeros(len(points), bool)
        for scanner in self.scanners:
            rays.see_through.over_rows(
                len(points), points32, velocity, *scanner.tables, margins, min_filled, free
            )
        return free


@dataclass(frozen=True)
class ScannerImage:
    """One scanner's range image.

    offset_s: (C,) float32, when the scanner faced each column; columns start at azimuth -pi and
    wrap around. nearest_m: (R,C) float32, nearest return within the 3 x 3 cells around each cell,
    inf if none. num_filled: (R,C) uint8, how many of those nine hold a return. row_edges_rad:
    (R+1,) float32 ascending elevations. origin_m: (3,) float32 of the scanner in the lidar frame.
    twists: (2,6) float32, the sweep's before and after its reference time.
    """

    offset_s: Float32
    nearest_m: Float32
    num_filled: NDArray[np.uint8]
    row_edges_rad: Float32
    origin_m: Float32
    twists: Float32

    @staticmethod
    def of(registered: RegisteredSweep, lidar: int) -> ScannerImage:
        sweep = registered.sweep
        mine = np.flatnonzero(sweep.lidar == lidar)
        offset_s = np.zeros(len(mine), np.float32)
        if sweep.offset_ns is not None:
            offset_s = (sweep.offset_ns[mine] * 1e-9).astype(np.float32)
        place = (
            sweep.origin_m(lidar).astype(np.float32),
            np.stack([registered.twist_before, registered.twist_after]).astype(np.float32),
        )
        seen = np.empty((3, len(mine)), np.float32)
        rays.aim.over_rows(len(mine), sweep.points[mine].astype(np.float32), offset_s, *place, seen)
        row_edges_rad, num_columns = _cells(*seen[:2])
        shape = len(row_edges_rad) - 1, num_columns
        nearest_m, num_filled = np.empty(shape, np.float32), np.empty(shape, np.uint8)
        num_rays, sum_s = np.zeros(num_columns, np.int64), np.zeros(num_columns)
        rays.fill(seen, offset_s, row_edges_rad, nearest_m, num_filled, num_rays, sum_s)
        return ScannerImage(
            _offset_per_column(num_rays, sum_s), nearest_m, num_filled, row_edges_rad, *place
        )

    @property
    def row_step_rad(self) -> float:
        """Angle between neighbouring rows, mostly that between neighbouring rings."""
        return float(np.median(np.diff(self.row_edges_rad)))

    @property
    def tables(self) -> tuple[NDArray[Any], ...]:
        """What `densify.kernels.rays.see_through` looks points up in."""
        return (
            *(self.offset_s, self.nearest_m, self.num_filled, self.row_edges_rad),
            *(self.origin_m, self.twists),
        )


def _cells(azimuth: Float32, elevation: Float32) -> tuple[Float32, int]:
    """Edges of the rows (R+1,), rad, and the number of columns."""
    whole = elevation
    if len(azimuth) > _MANY_POINTS:
        some = np.floor(azimuth / _SECTOR_RAD) % 4 == 0
        if some.mean() > 0.1:  # of a view all round every fourth sector tells as much
            azimuth, elevation = azimuth[some], elevation[some]
    edges: NDArray[np.floating]
    if len(azimuth) < _MIN_POINTS_TO_MEASURE:
        edges, step = _uniform_edges(whole, np.deg2rad(2.0)), np.deg2rad(1.0)
    else:
        rings = _rings(elevation)
        if rings is not None:
            edges = _edges_between(rings)
            step = _step_along(azimuth, np.searchsorted(edges, elevation))
            edges = _no_closer(edges, _MIN_ROW_RAD)
        else:
            row_step = _step_between(azimuth, elevation)
            edges = _uniform_edges(whole, _CELLS_PER_STEP * row_step)
            step = _step_along(azimuth, np.floor(elevation / row_step))
        step *= _CELLS_PER_STEP
    return edges.astype(np.float32), int(np.clip(round(2 * np.pi / step), 90, 8192))


def _rings(elevation: Float32) -> Float | None:
    """(K,) ascending elevations of the scanner's beams; None where the returns do not lie on rings:
    several scanners taken for one, clouds already processed, and lasers that do not share an origin
    (KITTI's HDL-64E, whose near returns smear).

    The peaks of a fine histogram, if they stand alone and hold nearly all returns.
    """
    of_return = ((elevation + 0.5 * np.pi) / _RING_BIN_RAD).astype(np.int64)
    returns = np.bincount(of_return, minlength=int(np.pi / _RING_BIN_RAD) + 2).astype(float)
    count = ndimage.gaussian_filter1d(returns, 1.0)
    peaks, found = signal.find_peaks(count, prominence=0.0)
    peaks = peaks[found["prominences"] >= _MIN_PROMINENCE * count[peaks]]
    if not 3 <= len(peaks) <= len(elevation) / _MIN_RETURNS_PER_RING:
        return None
    rings: Float = (peaks + 0.5) * _RING_BIN_RAD - 0.5 * np.pi
    nearest = np.searchsorted(0.5 * (rings[1:] + rings[:-1]), elevation)
    off = np.abs(elevation - rings[nearest])
    share = np.mean(off < 0.2 * np.gradient(rings)[nearest])
    return rings if share >= _MIN_RING_SHARE else None


def _edges_between(rings: Float) -> Float:
    """A ring's row reaches half the way to the next ring, the outermost ones as far outwards."""
    middle = 0.5 * (rings[1:] + rings[:-1])
    outer: Float = 2 * rings[[0, -1]] - middle[[0, -1]]
    edges: Float = np.concatenate([outer[:1], middle, outer[1:]])
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


def _step_between(azimuth: Float32, elevation: Float32) -> float:
    """Median elevation between rings (rad), where rings are not distinct."""
    # A strip half a degree wide crosses every ring a few times: large gaps in elevation part rings.
    gaps = _gaps(np.floor(azimuth / np.deg2rad(0.5)), elevation)
    between = gaps[gaps > max(np.deg2rad(0.08), 0.25 * float(np.percentile(gaps, 95)))]
    return float(np.median(between)) if len(between) else np.deg2rad(0.4)


def _step_along(azimuth: Float32, ring: NDArray[Any]) -> float:
    """Median azimuth between neighbours on a ring (rad)."""
    along = _gaps(ring, azimuth)
    along = along[along > np.deg2rad(0.02)]
    return float(np.median(along)) if len(along) else np.deg2rad(0.2)


def _gaps(group: NDArray[Any], angle: Float32) -> Float:
    """Between neighbouring angles of the same group; group: (N,) whole numbers."""
    apart = 4 * np.pi  # more than angles of one group can be
    gaps: Float = np.diff(np.sort(group * apart + angle.astype(np.float64)))
    return gaps[gaps < 2 * np.pi]


def _offset_per_column(num_rays: Int, sum_s: Float) -> Float32:
    seen = np.flatnonzero(num_rays)
    if not len(seen):
        return np.zeros(len(num_rays), np.float32)
    mean_s = sum_s[seen] / num_rays[seen]
    return np.interp(np.arange(len(num_rays)), seen, mean_s).astype(np.float32)
