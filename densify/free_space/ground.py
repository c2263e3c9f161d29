# SPDX-License-Identifier: MIT
"""The ground: its height under a stretch of sweeps, and how a lidar is mounted above it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int, Stretch, Sweep

ABOVE_GROUND_M = 0.2
"""Points lower than this above the ground are part of it: they start no motion."""
CELL_M = 1.0  # smaller cells follow kerbs, larger ones bridge holes
MAX_SLOPE = 0.15  # rise per metre; steeper surfaces are objects
_LOW_OUTLIER_M = 0.4
_GROUND_M = 0.15  # points this close to the lowest point belong to the ground
_NARROW_M, _HUMP_M = 7.0, 0.2  # a hump that is narrower and higher is not ground
_FEW = 3.0  # points in and around a cell are too few for a mean

_NUM_SWEEPS = 5
_NEAR_M = 30.0
_NUM_POINTS, _NUM_TRIES = 1000, 200
_CLOSE_M, _BELOW_M = 0.1, 0.3
_MAX_SHARE_BELOW = 0.03  # of the points; more lie below the plane of a wall or a roof
_LEAST_SHARE = 0.1
_UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
_MAX_LEAN_RAD, _MIN_LEAN_RAD = np.deg2rad([50.0, 6.0])  # less is the road's slope, or load


def ground(stretch: Stretch) -> HeightMap:
    """Return the ground height under all sweeps, in the world frame with z up."""
    return HeightMap.of([poses.transform(s.T_world_lidar, s.sweep.points) for s in stretch.sweeps])


@dataclass(frozen=True)
class HeightMap:
    """Ground heights on a grid.

    heights_m: (X,Y) at the cells' centres. low_m: (2,) the grid's lower corner.
    """

    heights_m: Float
    low_m: Float
    cell_m: float

    @staticmethod
    def of(clouds: Sequence[Float]) -> HeightMap:
        """Find the ground under point clouds.

        The second lowest point of a cell is its ground (the lowest may be a stray reflection). A
        cell far below the median of its neighbours is repaired. The slope limit then cuts cars and
        walls away, and humps are removed. The points near this lower hull are averaged.

        clouds: (N,3) each, metres, z up, at least one point in all.
        """
        low, shape = _grid(clouds)
        lowest, second = np.full((2, *shape), np.inf)
        for points in clouds:
            np.minimum.at(lowest, _cells(points, low), points[:, 2])
        for points in clouds:
            cells = _cells(points, low)
            rows = np.flatnonzero(points[:, 2] > lowest[cells])
            np.minimum.at(second, (cells[0][rows], cells[1][rows]), points[rows, 2])
        heights = np.where(np.isfinite(second), second, lowest)

        known = np.isfinite(heights)
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        around = ndimage.median_filter(heights[tuple(nearest)], 5)
        heights = np.where(known & (heights < around - _LOW_OUTLIER_M), around, heights)
        heights = _slope_limited(heights, MAX_SLOPE * CELL_M)
        hull = HeightMap(_without_humps(heights[tuple(nearest)]), low, CELL_M)
        return HeightMap(_averaged(hull, clouds), low, CELL_M)

    def under(self, points: Float) -> Float:
        """Return the (N,) ground height in metres at points (N,2) or (N,3).

        Beyond the grid the height is that of the nearest edge.
        """
        x, y = ((points[:, :2] - self.low_m) / self.cell_m - 0.5).T
        ground_m: Float = ndimage.map_coordinates(self.heights_m, (x, y), order=1, mode="nearest")
        return ground_m

    def above(self, points: Float) -> Float32:
        """Return the (N,) height in metres of points (N,3) above the ground."""
        height_m: Float32 = (points[:, 2] - self.under(points)).astype(np.float32)
        return height_m


def _grid(clouds: Sequence[Float]) -> tuple[Float, tuple[int, int]]:
    """Return the (2,) lower corner of a grid that holds all points, and its numbers of cells."""
    low = np.min([p[:, :2].min(axis=0, initial=np.inf) for p in clouds], axis=0)
    high = np.max([p[:, :2].max(axis=0, initial=-np.inf) for p in clouds], axis=0)
    low = np.floor(low / CELL_M) * CELL_M
    num_x, num_y = ((high - low) / CELL_M).astype(np.int64) + 1
    return low, (int(num_x), int(num_y))


def _cells(points: Float, low_m: Float) -> tuple[Int, Int]:
    """Return the row and the column (N,) of the grid cell of each point."""
    x, y = ((points[:, :2] - low_m) / CELL_M).astype(np.int64).T
    return x, y


def _averaged(hull: HeightMap, clouds: Sequence[Float]) -> Float:
    """Return the (X,Y) mean height of the points close to the hull, around each cell.

    The hull itself is lower where more points were measured; an object that drives from one such
    place to another must not climb.
    """
    number = np.zeros(hull.heights_m.shape, np.int64)
    total = np.zeros(hull.heights_m.shape)
    for points in clouds:
        over_m = points[:, 2] - hull.under(points)
        rows = np.flatnonzero(np.abs(over_m) < _GROUND_M)
        cells = _cells(points[rows], hull.low_m)
        np.add.at(number, cells, 1)
        np.add.at(total, cells, over_m[rows])
    number = ndimage.uniform_filter(number.astype(float), 3, mode="constant") * 9
    total = ndimage.uniform_filter(total, 3, mode="constant") * 9
    mean: Float = hull.heights_m + np.where(number >= _FEW, total / np.maximum(number, 1), 0.0)
    return mean


def _without_humps(heights: Float) -> Float:
    """Remove narrow humps, such as a vehicle that never left its place; slopes and kerbs stay.

    Morphological opening: Zhang et al., "A Progressive Morphological Filter for Removing Nonground
    Measurements from Airborne LIDAR Data", TGRS 2003.
    """
    size = round(_NARROW_M / CELL_M)
    opened = ndimage.grey_opening(heights, (size, size))
    return np.where(heights - opened > _HUMP_M, opened, heights)


def _slope_limited(heights: Float, rise: float) -> Float:
    """Return the largest map below ``heights`` that rises by at most ``rise`` per cell."""
    cone = -rise * np.hypot(*np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    while True:
        lower = ndimage.grey_erosion(heights, structure=cone, mode="nearest")
        if np.array_equal(lower, heights):
            return lower
        heights = lower


def find_upright(sweeps: Sequence[Sweep]) -> Float:
    """Return (3,3) ``R_level_lidar``, which turns the lidar's axes so that z is up.

    The ground plane is found by RANSAC within 30 m (Fischler, Bolles, "Random sample consensus",
    1981), as the median over at most five of the sweeps. A lidar is upside down where no sweep has
    a ground below and some have one above. The identity is returned for less than 6 degrees, or
    where no sweep shows a ground: a height map follows such slopes.
    """
    chosen = sweeps[:: max(1, len(sweeps) // _NUM_SWEEPS)][:_NUM_SWEEPS]
    for R_hung_lidar in (np.eye(3), _UPSIDE_DOWN):
        turned = (sweep.points @ R_hung_lidar.T for sweep in chosen)
        normals = [n for n in map(_ground_normal, turned) if n is not None]
        if normals:
            return _level(np.median(normals, axis=0)) @ R_hung_lidar
    return np.eye(3)


def _level(up: Float) -> Float:
    """Return the smallest rotation (3,3) that turns this direction (3,) to z."""
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    lean_rad = float(np.arccos(np.clip(up[2], -1, 1)))
    if lean_rad < _MIN_LEAN_RAD:
        return np.eye(3)
    R: Float = Rotation.from_rotvec(axis / np.linalg.norm(axis) * lean_rad).as_matrix()
    return R


def _ground_normal(points: Float) -> Float | None:
    """Return the (3,) unit normal of the ground plane, upwards; None where there is none."""
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    points = points[:: len(points) // _NUM_POINTS + 1]
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(len(points), size=(_NUM_TRIES, 3))].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal, a = normal[length > 0] / length[length > 0, None], a[length > 0]
    normal *= np.where(normal[:, 2] < 0, -1, 1)[:, None]
    level = normal[:, 2] > np.cos(_MAX_LEAN_RAD)
    normal, a = normal[level], a[level]
    above = points @ normal.T - np.einsum("ij,ij->i", normal, a)
    close = (np.abs(above) < _CLOSE_M).mean(axis=0)
    close[(above < -_BELOW_M).mean(axis=0) > _MAX_SHARE_BELOW] = 0.0
    if not len(close) or close.max() < _LEAST_SHARE:
        return None
    on_plane = points[np.abs(above[:, int(np.argmax(close))]) < _CLOSE_M]
    _, _, axes = np.linalg.svd(on_plane - on_plane.mean(axis=0), full_matrices=False)
    fitted: Float = axes[2] * np.sign(axes[2, 2])
    return fitted
