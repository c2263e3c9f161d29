# SPDX-License-Identifier: MIT
"""What a sweep saw in every direction, and what it therefore saw *through*.

A range image is built in the scanner's own frame at each ray's own firing time, where the rays form
a regular grid; a point of the deskewed sweep finds its cell by asking when the scanner faced it.
Its cells follow the sensor: their size is measured from the returns (Thrun et al., "Probabilistic
Robotics", 2005, ch. 9, for free space from range images).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from densify.types import Bool, Float, Float32, RegisteredSweep

_CELLS_PER_STEP = 1.15  # a cell a little larger than a step is rarely empty
_MIN_POINTS_TO_MEASURE = 200
_SETTLED_S = 0.01


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
        free = np.zeros(len(points), bool)
        points32 = points.astype(np.float32)
        velocity = None if velocity_m_s is None else velocity_m_s.astype(np.float32)
        for scanner in self.scanners:
            free |= scanner.sees_through(points32, velocity, margin_m, margin_fraction, min_filled)
        return free


@dataclass(frozen=True)
class ScannerImage:
    """One scanner's range image.

    nearest_m: (R,C) float32, nearest return within the 3 x 3 cells around each cell, inf if none.
    num_filled: (R,C) how many of those nine hold a return. offset_s: (C,) float32, when the scanner
    faced each column. elevation_low_rad: of row 0. Columns start at azimuth -pi and wrap around.
    """

    nearest_m: Float32
    num_filled: np.ndarray
    offset_s: Float32
    elevation_low_rad: float
    elevation_step_rad: float
    twist_before: Float32
    twist_after: Float32

    @staticmethod
    def of(registered: RegisteredSweep, lidar: int) -> ScannerImage:
        sweep = registered.sweep
        mine = sweep.lidar == lidar
        points = sweep.points[mine].astype(np.float32)
        twists = (
            registered.twist_before.astype(np.float32),
            registered.twist_after.astype(np.float32),
        )
        offset_s = np.zeros(len(points), np.float32)
        if sweep.offset_ns is not None:
            offset_s = (sweep.offset_ns[mine] * 1e-9).astype(np.float32)
        azimuth, elevation, range_m = _spherical(_at_time(points, offset_s, *twists))
        azimuth_step, elevation_step = _angular_steps(azimuth, elevation)
        num_columns = int(np.clip(round(2 * np.pi / azimuth_step), 90, 8192))
        low = float(elevation.min(initial=0.0)) - 0.5 * elevation_step
        high = float(elevation.max(initial=0.0))
        num_rows = int((high - low) / elevation_step) + 1

        column = _column(azimuth, num_columns)
        row = np.clip(((elevation - low) / elevation_step).astype(np.int64), 0, num_rows - 1)
        nearest = np.full((num_rows, num_columns), np.inf, np.float32)
        np.minimum.at(nearest, (row, column), range_m)
        filled = np.isfinite(nearest).astype(np.uint8)
        counted = ndimage.correlate1d(filled, np.ones(3, np.uint8), axis=0, mode="constant")
        counted = ndimage.correlate1d(counted, np.ones(3, np.uint8), axis=1, mode="wrap")
        return ScannerImage(
            nearest_m=ndimage.minimum_filter(nearest, 3, mode=("constant", "wrap"), cval=np.inf),
            num_filled=counted,
            offset_s=_offset_per_column(column, offset_s, num_columns),
            elevation_low_rad=low,
            elevation_step_rad=elevation_step,
            twist_before=twists[0],
            twist_after=twists[1],
        )

    def sees_through(
        self,
        points: Float32,
        velocity: Float32 | None,
        margin_m: float,
        margin_fraction: float,
        min_filled: int,
    ) -> Bool:
        num_rows, num_columns = self.nearest_m.shape
        seen = points
        for _ in range(2):  # when did the scanner face the point? converges in two steps
            time_s = self.offset_s[_column(np.arctan2(seen[:, 1], seen[:, 0]), num_columns)]
            moved = points if velocity is None else points + time_s[:, None] * velocity
            seen = _at_time(moved, time_s, self.twist_before, self.twist_after)
        azimuth, elevation, range_m = _spherical(seen)
        column = _column(azimuth, num_columns)
        row = np.floor((elevation - self.elevation_low_rad) / self.elevation_step_rad)
        inside = (row >= 0) & (row < num_rows)
        # Where a turning scanner begins and ends its revolution it skips or repeats a sector.
        inside &= np.abs(self.offset_s[column] - time_s) < _SETTLED_S
        cell = (np.where(inside, row, 0).astype(np.int64), column)
        margin = np.maximum(margin_m, margin_fraction * range_m)
        return (
            inside
            & (self.num_filled[cell] >= min_filled)
            & (self.nearest_m[cell] > range_m + margin)
        )


def _spherical(points: Float32) -> tuple[Float32, Float32, Float32]:
    """(N,3) -> azimuth (rad, left positive), elevation (rad), range (m)."""
    ground = np.hypot(points[:, 0], points[:, 1])
    return (
        np.arctan2(points[:, 1], points[:, 0]),
        np.arctan2(points[:, 2], ground),
        np.hypot(ground, points[:, 2]),
    )


def _column(azimuth: Float32, num_columns: int) -> np.ndarray:
    column = ((azimuth + np.pi) * (num_columns / (2 * np.pi))).astype(np.int64)
    return column % num_columns


def _at_time(
    points: Float32, time_s: Float32, twist_before: Float32, twist_after: Float32
) -> Float32:
    """Points at the reference time -> in the scanner's frame at ``time_s``; inverse of deskewing.

    The rotation is taken to second order: within a sweep it stays below 0.1 rad.
    """
    before = (time_s < 0)[:, None]
    twist = np.where(before, twist_before, twist_after)
    rotation, translation = twist[:, :3] * time_s[:, None], twist[:, 3:] * time_s[:, None]
    p = points - translation
    turned = np.cross(rotation, p)
    moved: Float32 = p - turned + np.float32(0.5) * np.cross(rotation, turned)
    return moved


def _angular_steps(azimuth: Float32, elevation: Float32) -> tuple[float, float]:
    """Cell width and height (rad) from the returns: the median gaps along and between rings."""
    if len(azimuth) < _MIN_POINTS_TO_MEASURE:
        return np.deg2rad(1.0), np.deg2rad(2.0)
    # A strip half a degree wide crosses every ring a few times: large gaps in elevation part rings.
    strip = np.floor(azimuth / np.deg2rad(0.5))
    order = np.lexsort((elevation, strip))
    same_strip = np.diff(strip[order]) == 0
    gaps = np.diff(elevation[order])[same_strip]
    between = gaps[gaps > max(np.deg2rad(0.08), 0.25 * float(np.percentile(gaps, 95)))]
    elevation_step = float(np.median(between)) if len(between) else np.deg2rad(0.4)
    ring = np.floor(elevation / elevation_step)
    order = np.lexsort((azimuth, ring))
    same_ring = np.diff(ring[order]) == 0
    along = np.diff(azimuth[order])[same_ring]
    along = along[along > np.deg2rad(0.02)]
    azimuth_step = float(np.median(along)) if len(along) else np.deg2rad(0.2)
    return _CELLS_PER_STEP * azimuth_step, _CELLS_PER_STEP * elevation_step


def _offset_per_column(column: np.ndarray, offset_s: Float32, num_columns: int) -> Float32:
    count = np.bincount(column, minlength=num_columns)
    mean = np.bincount(column, offset_s, num_columns) / np.maximum(count, 1)
    seen = np.flatnonzero(count)
    if not len(seen):
        return np.zeros(num_columns, np.float32)
    return np.interp(np.arange(num_columns), seen, mean[seen]).astype(np.float32)
