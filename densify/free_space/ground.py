# SPDX-License-Identifier: MIT
"""Estimate the height of the ground, and the rotation that makes the lidar level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.nearest import bulk
from densify.geometry.types import Bool, Float, Float32, Int, Stretch, Sweep

ABOVE_GROUND_M = 0.2
"""Height above the ground below which points are part of it and never start a moving object."""
_BELOW_M = 0.5  # points this far below the ground are no surface: mirror images, multipath
_STRAY = 0.02  # largest share of the points of a cell that are mirror images or noise
_DENSE_M = 30.0  # range within which every sweep measures the ground
_MOST_CELLS = 1 << 18  # 512 m x 512 m
CELL_M = 1.0  # smaller cells follow kerbs, larger ones bridge holes
MAX_SLOPE = 0.15  # rise per metre; steeper surfaces are objects
_WINDOW = 7  # cells; a narrower hump or pit is not ground

_NUM_POINTS, _NUM_TRIES = 2000, 200
_LEAST_SHARE = 0.1  # share of points on a ground plane minus share of points below it


def ground(stretch: Stretch) -> HeightMap:
    """Return the ground height under all sweeps of a window, in the world frame with z up."""
    return HeightMap.of([poses.transform(s.T_world_lidar, s.sweep.points) for s in stretch.sweeps])


@dataclass(frozen=True)
class HeightMap:
    """Ground heights on a grid of square cells, in a world frame with z up."""

    heights_m: Float  # (X,Y) z of the ground in metres at the centres of X by Y cells
    low_m: Float  # (2,) x and y of the grid's lower corner
    cell_m: float  # side of a cell

    @staticmethod
    def of(clouds: Sequence[Float]) -> HeightMap:
        """Return the ground height under clouds of (N,3) points, z up, at least one point in all.

        The ground of a cell is the median, over the clouds, of a cloud's lowest point after its
        second lowest and its lowest 2 %, because these may be mirror images from below the road. A
        cell far below the median of its surroundings is repaired. A limit on the slope then removes
        cars and walls, and narrow humps are removed. The points near the resulting lower hull are
        averaged.
        """
        inside = bulk(np.concatenate([points[:, :2] for points in clouds]), CELL_M, _MOST_CELLS)
        ends = np.cumsum([len(points) for points in clouds])[:-1]
        cloud_rows = zip(clouds, np.split(inside, ends), strict=True)
        clouds = [points[rows] for points, rows in cloud_rows]
        low, shape = _grid(clouds)
        cells = [_cells(points, low, shape[1]) for points in clouds]
        heights = _median_of_low(clouds, cells, shape[0] * shape[1]).reshape(shape)

        known = np.isfinite(heights)
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        around, rise_m = ndimage.median_filter(heights[tuple(nearest)], _WINDOW), MAX_SLOPE * CELL_M
        heights = np.where(known & (heights < around - rise_m * (_WINDOW // 2)), around, heights)
        heights = _slope_limited(heights, rise_m)
        hull = HeightMap(_without_humps(heights[tuple(nearest)]), low, CELL_M)
        return HeightMap(_averaged(hull, clouds, cells), low, CELL_M)

    def under(self, points: Float) -> Float:
        """Return (N,) ground heights, m, at points (N,2) or (N,3); beyond the grid, at its edge."""
        x, y = ((points[:, i] - self.low_m[i]) / self.cell_m - 0.5 for i in (0, 1))
        ground_m: Float = ndimage.map_coordinates(self.heights_m, (x, y), order=1, mode="nearest")
        return ground_m

    def above(self, points: Float) -> Float32:
        """Return the (N,) height in metres of points (N,3) above the ground."""
        height_m: Float32 = (points[:, 2] - self.under(points)).astype(np.float32)
        return height_m

    def below(self, points: Float, T_world_lidar: Float) -> Bool:
        """Return (N,) True for points (N,3, lidar frame) clearly below the ground: mirror images.

        Only points within 30 m of the lidar are judged, where the ground is measured densely.
        """
        rows = np.flatnonzero(np.hypot(points[:, 0], points[:, 1]) < _DENSE_M)
        is_below = np.zeros(len(points), bool)
        is_below[rows] = self.above(poses.transform(T_world_lidar, points[rows])) < -_BELOW_M
        return is_below


def _grid(clouds: Sequence[Float]) -> tuple[Float, tuple[int, int]]:
    """Return the (2,) lower corner of a grid around all points, and its numbers of cells."""
    low = np.array([min(p[:, i].min(initial=np.inf) for p in clouds) for i in (0, 1)])
    high = np.array([max(p[:, i].max(initial=-np.inf) for p in clouds) for i in (0, 1)])
    low = np.floor(low / CELL_M) * CELL_M
    num_x, num_y = ((high - low) / CELL_M).astype(np.int64) + 1
    return low, (int(num_x), int(num_y))


def _cells(points: Float, low_m: Float, num_y: int) -> Int:
    """Return the (N,) number of each point's grid cell; a row of the grid has ``num_y`` cells."""
    x, y = (((points[:, i] - low_m[i]) / CELL_M).astype(np.int64) for i in (0, 1))
    return x * num_y + y


def _median_of_low(clouds: Sequence[Float], cells: Sequence[Int], num_cells: int) -> Float:
    """Return the (num_cells,) median over clouds of their low points, inf in empty cells."""
    low = np.full((len(clouds), num_cells), np.nan, np.float32)
    for points, cell, low_m in zip(clouds, cells, low, strict=True):
        z = points[:, 2]
        scaled_height = (z - z.min(initial=0)) / (z.max(initial=0) - z.min(initial=0) + 1)
        order = np.argsort(cell + scaled_height)  # by cell, then by height
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))  # of each cell, lowest first
        count = np.diff(first, append=len(order))
        stray = np.maximum(1, (_STRAY * count).astype(int))
        low_m[cell[order[first]]] = z[order[first + np.minimum(count - 1, stray)]]
    known = ~np.isnan(low).all(axis=0)
    heights = np.full(num_cells, np.inf)
    heights[known] = np.nanmedian(low[:, known], axis=0)
    return heights


def _averaged(hull: HeightMap, clouds: Sequence[Float], cells: Sequence[Int]) -> Float:
    """Return the (X,Y) mean height of the points close to the hull around each cell."""
    # The hull is lower where more points were measured: an object driving there would climb.
    total, number = np.zeros((2, hull.heights_m.size))
    for points, cell in zip(clouds, cells, strict=True):
        over_m = points[:, 2] - hull.under(points)
        rows = np.flatnonzero(np.abs(over_m) < MAX_SLOPE * CELL_M)
        np.add.at(number, cell[rows], 1)
        np.add.at(total, cell[rows], over_m[rows])
    total, number = (n.reshape(hull.heights_m.shape) for n in (total, number))
    total, number = (ndimage.uniform_filter(n, 3, mode="constant") * 9 for n in (total, number))
    mean: Float = hull.heights_m + total / np.maximum(number, 1)
    return mean


def _without_humps(heights: Float) -> Float:
    """Remove narrow humps, such as a vehicle that is always parked. Slopes and kerbs stay."""
    # Morphological opening: Zhang et al., "A Progressive Morphological Filter for Removing
    # Nonground Measurements from Airborne LIDAR Data", TGRS 2003.
    opened = ndimage.grey_opening(heights, (_WINDOW, _WINDOW))
    return np.where(heights - opened > ABOVE_GROUND_M, opened, heights)


def _slope_limited(heights: Float, rise: float) -> Float:
    """Return the largest map below ``heights`` that rises by at most ``rise`` per cell."""
    cone = -rise * np.hypot(*np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    while True:
        lower = ndimage.grey_erosion(heights, structure=cone, mode="nearest")
        if np.array_equal(lower, heights):
            return lower
        heights = lower


def find_upright(sweeps: Sequence[Sweep]) -> Float:
    """Return the (3,3) rotation ``R_level_lidar`` from the lidar frame to level axes, z up.

    RANSAC (Fischler, Bolles, 1981) finds the ground plane: most points are on it, few below it, and
    the lidar is above it. The lidar is upside down if this holds only after turning it over.
    Without a ground plane the result is the identity. Slopes below 0.075 are not levelled.
    """
    num = sum(map(len, sweeps)) // _NUM_POINTS + 1
    points = np.concatenate([s.points[::num] for s in sweeps])
    for R_hung_lidar in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
        up = _ground_normal(points @ R_hung_lidar.T)
        if up is not None:
            return _level(up) @ R_hung_lidar
    return np.eye(3)


def _level(up: Float) -> Float:
    """Return the smallest rotation (3,3) that turns a unit vector (3,) to z."""
    if np.hypot(*up[:2]) < 0.5 * MAX_SLOPE * up[2]:
        return np.eye(3)
    R: Float = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
    return R


def _ground_normal(points: Float) -> Float | None:
    """Return the (3,) unit normal of the ground plane, pointing up, None if there is no ground."""
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(len(points), size=(_NUM_TRIES, 3))].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal *= np.where(normal[:, 2:] < 0, -1, 1)
    is_floor = normal[:, 2] > np.hypot(*normal[:, :2].T)  # a floor and not a wall
    normal = normal[is_floor] / np.linalg.norm(normal[is_floor], axis=1, keepdims=True)
    from_origin = np.einsum("ij,ij->i", normal, a[is_floor])
    height_m = points @ normal.T - from_origin
    on_plane = np.abs(height_m) < ABOVE_GROUND_M
    share = np.where(from_origin < 0, on_plane.mean(axis=0), 0) - (height_m < -ABOVE_GROUND_M).mean(
        axis=0
    )
    if share.max(initial=0) < _LEAST_SHARE:
        return None
    ground = points[on_plane[:, np.argmax(share)]]
    _, _, axes = np.linalg.svd(ground - ground.mean(axis=0), full_matrices=False)
    fitted: Float = axes[2] * np.sign(axes[2, 2])
    return fitted
