# SPDX-License-Identifier: MIT
"""Heights of the ground under a cloud: a map that follows slopes and kerbs, not a plane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from densify.config import GroundSettings
from densify.free_space.heights import add_near, heights_under, two_lowest
from densify.geometry.types import Float, Float32

ABOVE_GROUND_M = 0.2
"""Points lower than this above the ground are part of it: they start no motion."""
_LOW_OUTLIER_M = 0.4
_GROUND_M = 0.15  # points this close to the lowest are the ground's
_NARROW_M, _HUMP_M = 7.0, 0.2  # what rises higher on less is no ground
_FEW = 3.0  # points in and around a cell do not tell its mean


@dataclass(frozen=True)
class HeightMap:
    """heights_m: (X,Y) of the cells' centres. low_m: (2,) the grid's lower corner."""

    heights_m: Float
    low_m: Float
    cell_m: float

    @staticmethod
    def of(clouds: Iterable[Float], settings: GroundSettings) -> HeightMap:
        """clouds: (N,3) each, z up, at least one point in all. They are walked three times and not
        kept: what makes each of them anew needs the memory of one.

        A cell's ground is its second lowest point (the lowest may be a stray reflection), repaired
        where it lies below the median of its neighbours, then bounded by the steepest slope from
        every other cell, which cuts cars and walls away, and without humps. What lies on that lower
        hull is averaged.
        """
        cell_m = settings.cell_m
        low, shape = _grid(clouds, cell_m)
        lowest, second = np.full((2, *shape), np.inf)
        for points in clouds:
            two_lowest(points, low, cell_m, lowest, second)
        heights = np.where(np.isfinite(second), second, lowest)

        known = np.isfinite(heights)
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        around = ndimage.median_filter(heights[tuple(nearest)], 5)
        heights = np.where(known & (heights < around - _LOW_OUTLIER_M), around, heights)
        heights = _slope_limited(heights, settings.max_slope * cell_m)
        hull = HeightMap(_without_humps(heights[tuple(nearest)], cell_m), low, cell_m)
        return HeightMap(_averaged(hull, clouds), low, cell_m)

    def under(self, points: Float) -> Float:
        """(N,2) or (N,3) -> (N,) ground height there; beyond the map as at its nearest edge."""
        ground_m = np.empty(len(points))
        heights_under.over_rows(
            len(points), points, self.low_m, self.cell_m, self.heights_m, ground_m
        )
        return ground_m

    def above(self, points: Float) -> Float32:
        """(N,3) -> (N,) metres above the ground."""
        height_m: Float32 = (points[:, 2] - self.under(points)).astype(np.float32)
        return height_m


def _grid(clouds: Iterable[Float], cell_m: float) -> tuple[Float, tuple[int, int]]:
    """(2,) lower corner, on a multiple of the cell, and how many cells cover all points."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for points in clouds:
        if len(points):
            x, y, _ = points.T
            low = np.minimum(low, [x.min(), y.min()])
            high = np.maximum(high, [x.max(), y.max()])
    low = np.floor(low / cell_m) * cell_m
    num_x, num_y = ((high - low) / cell_m).astype(np.int64) + 1
    return low, (int(num_x), int(num_y))


def _averaged(hull: HeightMap, clouds: Iterable[Float]) -> Float:
    """Mean of what lies on the hull, about each cell; the second lowest of many is lower than the
    second lowest of few, and an object that drives from one to the other must not climb."""
    number = np.zeros(hull.heights_m.shape, np.int64)
    total = np.zeros(hull.heights_m.shape)
    for points in clouds:
        over_m = points[:, 2] - hull.under(points)
        add_near(points, over_m, _GROUND_M, hull.low_m, hull.cell_m, number, total)
    number = ndimage.uniform_filter(number.astype(float), 3, mode="constant") * 9
    total = ndimage.uniform_filter(total, 3, mode="constant") * 9
    mean: Float = hull.heights_m + np.where(number >= _FEW, total / np.maximum(number, 1), 0.0)
    return mean


def _without_humps(heights: Float, cell_m: float) -> Float:
    """The map without what rises out of its surroundings on little room: where a vehicle never left
    its place bare, the lowest that was seen is the vehicle. Slopes and kerbs stay (morphological
    opening; Zhang et al., "A Progressive Morphological Filter for Removing Nonground Measurements
    from Airborne LIDAR Data", TGRS 2003)."""
    size = max(1, round(_NARROW_M / cell_m))
    opened = ndimage.grey_opening(heights, (size, size))
    return np.where(heights - opened > _HUMP_M, opened, heights)


def _slope_limited(heights: Float, rise: float) -> Float:
    """The largest map below ``heights`` that rises by at most ``rise`` per cell."""
    cone = -rise * np.hypot(*np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    while True:
        lower = ndimage.grey_erosion(heights, structure=cone, mode="nearest")
        if np.array_equal(lower, heights):
            return lower
        heights = lower
