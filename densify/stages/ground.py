# SPDX-License-Identifier: MIT
"""Ground: a height map of the stretch that follows slopes and kerbs, not a plane."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from densify import poses
from densify.config import GroundSettings
from densify.types import Float, Float32, Stretch

_LOW_OUTLIER_M = 0.4


def height_above_ground(stretch: Stretch, settings: GroundSettings) -> tuple[Float32, ...]:
    """Per sweep (N,) metres above the ground.

    All sweeps together fill a grid in the world, whose z is taken for up. A cell's ground is
    its second lowest point (the lowest may be a stray reflection), repaired where it lies below
    the median of its neighbours, then bounded by the steepest slope from every other cell, which
    cuts cars and walls away.
    """
    clouds = [poses.transform(s.T_world_lidar, s.sweep.points) for s in stretch.sweeps]
    heights_m, low = _height_map(np.concatenate(clouds), settings)
    return tuple(
        (cloud[:, 2] - _sample(heights_m, low, cloud, settings.cell_m)).astype(np.float32)
        for cloud in clouds
    )


def _height_map(points: Float, settings: GroundSettings) -> tuple[Float, Float]:
    """(N,3) -> heights (X,Y) metres of the cells, and the grid's lower corner (2,)."""
    cell_m = settings.cell_m
    low = np.floor(points[:, :2].min(0) / cell_m) * cell_m
    index = ((points[:, :2] - low) / cell_m).astype(np.int64)
    shape = tuple(index.max(0) + 1)
    cell = np.ravel_multi_index(tuple(index.T), shape)
    z = points[:, 2]
    lowest = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(lowest, cell, z)
    above = z > lowest[cell]
    second = np.full_like(lowest, np.inf)
    np.minimum.at(second, cell[above], z[above])
    heights = np.where(np.isfinite(second), second, lowest).reshape(shape)

    known = np.isfinite(heights)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    around = ndimage.median_filter(heights[tuple(nearest)], 5)
    heights = np.where(known & (heights < around - _LOW_OUTLIER_M), around, heights)
    heights = _slope_limited(heights, settings.max_slope * cell_m)
    return heights[tuple(nearest)], low


def _slope_limited(heights: Float, rise: float) -> Float:
    """The largest map below ``heights`` that rises by at most ``rise`` per cell."""
    cone = -rise * np.hypot(*np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    while True:
        lower = ndimage.grey_erosion(heights, structure=cone, mode="nearest")
        if np.array_equal(lower, heights):
            return lower
        heights = lower


def _sample(heights: Float, low: Float, points: Float, cell_m: float) -> Float:
    at = (points[:, :2] - low).T / cell_m - 0.5
    return ndimage.map_coordinates(heights, at, order=1, mode="nearest")
