# SPDX-License-Identifier: MIT
"""Estimate the height of the ground, and the rotation that makes the lidar level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.compiled import Kernel
from densify.geometry.nearest import bulk
from densify.geometry.types import Bool, Float, Float32, Int, Stretch, Sweep

ABOVE_GROUND_M = 0.2
"""Height above the ground below which points are part of it and never start a moving object."""
_MOST_CELLS = 1 << 18  # largest grid, 512 m x 512 m
_CELL_M = 1.0  # side of a cell; smaller cells follow kerbs, larger ones bridge holes
_MAX_SLOPE = 0.15  # rise per metre; steeper surfaces are objects
_WINDOW = 7  # width in cells; a narrower hump or pit is not ground


def ground(stretch: Stretch) -> HeightMap:
    """Return the height of the ground under all sweeps of a window, in the world frame, z up."""
    clouds = [
        poses.transform(registered.T_world_lidar, registered.sweep.points)
        for registered in stretch.sweeps
    ]
    return HeightMap.of(clouds)


@dataclass(frozen=True)
class HeightMap:
    """Ground heights on a grid of square cells, in a world frame with z up."""

    heights_m: Float  # (X,Y) z of the ground in metres at the centres of X by Y cells
    low_m: Float  # (2,) x and y of the grid's lower corner
    cell_m: float  # side of a cell

    @staticmethod
    def of(clouds: Sequence[Float]) -> HeightMap:
        """Return the height of the ground under clouds of points (N,3), z up, at least one in all.

        The height in a cell is the median over the clouds of the lowest points, without mirror
        images from below the road. A limit on the slope removes cars and walls.
        """
        gridded, low_m, shape = _fit_grid(clouds)
        cell_numbers = [_cells_of(points, low_m, shape[1]) for points in gridded]
        # Cells without a point have the height inf, until they take that of the nearest other cell.
        heights_m = _median_lowest(gridded, cell_numbers, shape[0] * shape[1]).reshape(shape)
        is_measured = np.isfinite(heights_m)
        nearest_cell = tuple(ndimage.distance_transform_edt(~is_measured, return_indices=True)[1])

        # A cell lower than the greatest slope allows over half a window is a mirror image.
        median_m = ndimage.median_filter(heights_m[nearest_cell], _WINDOW)
        rise_m = _MAX_SLOPE * _CELL_M
        is_pit = is_measured & (heights_m < median_m - rise_m * (_WINDOW // 2))
        heights_m = np.where(is_pit, median_m, heights_m)
        heights_m = _limit_slope(heights_m, rise_m)[nearest_cell]

        # Narrow humps, such as a vehicle that is always parked, are removed. Slopes and kerbs stay.
        # Morphological opening: Zhang et al., "A Progressive Morphological Filter for Removing
        # Nonground Measurements from Airborne LIDAR Data", TGRS 2003.
        opened_m = ndimage.grey_opening(heights_m, (_WINDOW, _WINDOW))
        hull_m = np.where(heights_m - opened_m > ABOVE_GROUND_M, opened_m, heights_m)
        # The hull is a lower bound of the ground. The ground is the mean of the points close to it.
        hull = HeightMap(hull_m, low_m, _CELL_M)
        return HeightMap(_mean_heights(hull, gridded, cell_numbers), low_m, _CELL_M)

    def under(self, points: Float) -> Float:
        """Return the ground's height (N,), m, at points (N,2 or 3), beyond the grid at its edge."""
        ground_m = np.empty(len(points))
        _interpolate.over_rows(
            len(points),
            np.ascontiguousarray(points, np.float64),
            np.ascontiguousarray(self.heights_m, np.float64),
            self.low_m,
            self.cell_m,
            ground_m,
        )
        return ground_m

    def above(self, points: Float) -> Float32:
        """Return the heights (N,) in metres of points (N,3), frame of the map, above the ground."""
        height_m: Float32 = (points[:, 2] - self.under(points)).astype(np.float32)
        return height_m

    def below(self, points: Float, T_world_lidar: Float) -> Bool:
        """Return the mask (N,) of points that are within 30 m and over 0.5 m below the ground.

        Points (N,3) are in the lidar frame. ``T_world_lidar`` leads to the frame of the map.
        """
        # Farther away not every sweep measures the ground. Returns from 0.5 m below the ground are
        # mirror images or multipath.
        rows = np.flatnonzero(np.hypot(points[:, 0], points[:, 1]) < 30.0)
        is_below = np.zeros(len(points), bool)
        is_below[rows] = self.above(poses.transform(T_world_lidar, points[rows])) < -0.5
        return is_below


@Kernel
def _interpolate(begin, end, points, heights_m, low_m, cell_m, ground_m):  # type: ignore[no-untyped-def]
    """Fill ``ground_m`` (N,) with heights interpolated bilinearly between the middles of cells."""
    num_x, num_y = heights_m.shape
    for i in range(begin, end):
        # Position in cells from the middle of the first cell. In this order NaN becomes 0.
        x = min(max(0.0, (points[i, 0] - low_m[0]) / cell_m - 0.5), num_x - 1.0)
        y = min(max(0.0, (points[i, 1] - low_m[1]) / cell_m - 0.5), num_y - 1.0)
        row, column = int(x), int(y)
        next_row, next_column = min(row + 1, num_x - 1), min(column + 1, num_y - 1)
        x, y = x - row, y - column
        near_m = (1 - y) * heights_m[row, column] + y * heights_m[row, next_column]
        far_m = (1 - y) * heights_m[next_row, column] + y * heights_m[next_row, next_column]
        ground_m[i] = (1 - x) * near_m + x * far_m


def _fit_grid(clouds: Sequence[Float]) -> tuple[list[Float], Float, tuple[int, int]]:
    """Return the clouds (N,3) without the few points too far away for a grid, and the grid.

    The grid is given by its (2,) lower corner in metres and its numbers of cells in x and y.
    """

    def find_bounds(clouds: Sequence[Float]) -> tuple[Float, Float]:
        """Return the lower and the upper corner (2,) of the box around all points."""
        low_m = [min(points[:, k].min(initial=np.inf) for points in clouds) for k in (0, 1)]
        high_m = [max(points[:, k].max(initial=-np.inf) for points in clouds) for k in (0, 1)]
        return np.array(low_m), np.array(high_m)

    gridded = list(clouds)
    low_m, high_m = find_bounds(gridded)
    if np.prod((high_m - low_m) / _CELL_M + 1) > _MOST_CELLS:
        in_grid = bulk(np.concatenate([points[:, :2] for points in clouds]), _CELL_M, _MOST_CELLS)
        masks = np.split(in_grid, np.cumsum([len(points) for points in clouds])[:-1])
        gridded = [points[mask] for points, mask in zip(clouds, masks, strict=True)]
        low_m, high_m = find_bounds(gridded)
    low_m = np.floor(low_m / _CELL_M) * _CELL_M
    num_x, num_y = ((high_m - low_m) / _CELL_M).astype(np.int64) + 1
    return gridded, low_m, (int(num_x), int(num_y))


def _cells_of(points: Float, low_m: Float, num_y: int) -> Int:
    """Return the (N,) number of each point's grid cell; a row of the grid has ``num_y`` cells."""
    x, y = (((points[:, axis] - low_m[axis]) / _CELL_M).astype(np.int64) for axis in (0, 1))
    return x * num_y + y


def _median_lowest(clouds: Sequence[Float], cell_numbers: Sequence[Int], num_cells: int) -> Float:
    """Return the (num_cells,) median over clouds of their lowest points, inf in empty cells."""
    lowest_m = np.full((len(clouds), num_cells), np.nan, np.float32)
    for points, cell, cloud_lowest_m in zip(clouds, cell_numbers, lowest_m, strict=True):
        z = points[:, 2]
        # Sort by cell, then by height. Cell numbers are integers, and heights scaled to less than 1
        # order the points of a cell.
        scaled_height = (z - z.min(initial=0)) / (z.max(initial=0) - z.min(initial=0) + 1)
        order = np.argsort(cell + scaled_height)
        cell_start = np.flatnonzero(np.diff(cell[order], prepend=-1))  # lowest point of each cell
        num_points = np.diff(cell_start, append=len(order))
        # Up to 2 % of the points of a cell are mirror images or noise. At least the lowest point is
        # skipped, if the cell has two.
        num_outliers = np.maximum(1, (0.02 * num_points).astype(int))
        ground_row = order[cell_start + np.minimum(num_points - 1, num_outliers)]
        cloud_lowest_m[cell[order[cell_start]]] = z[ground_row]
    is_measured = ~np.isnan(lowest_m).all(axis=0)
    heights_m = np.full(num_cells, np.inf)
    heights_m[is_measured] = np.nanmedian(lowest_m[:, is_measured], axis=0)
    return heights_m


def _mean_heights(hull: HeightMap, clouds: Sequence[Float], cell_numbers: Sequence[Int]) -> Float:
    """Return the (X,Y) mean height of the points close to the hull around each cell."""
    # The hull is lower where more points were measured: an object driving there would climb.
    sum_m, num_points = np.zeros((2, hull.heights_m.size))
    for points, cell in zip(clouds, cell_numbers, strict=True):
        above_hull_m = points[:, 2] - hull.under(points)
        rows = np.flatnonzero(np.abs(above_hull_m) < _MAX_SLOPE * _CELL_M)
        np.add.at(num_points, cell[rows], 1)
        np.add.at(sum_m, cell[rows], above_hull_m[rows])
    # Sums over each cell and its eight neighbours
    sum_m, num_points = (
        9 * ndimage.uniform_filter(values.reshape(hull.heights_m.shape), 3, mode="constant")
        for values in (sum_m, num_points)
    )
    mean_m: Float = hull.heights_m + sum_m / np.maximum(num_points, 1)
    return mean_m


def _limit_slope(heights_m: Float, rise_m: float) -> Float:
    """Return the (X,Y) heights lowered until they rise by at most ``rise_m`` per cell."""
    cone = -rise_m * np.hypot(*np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    # A low cell limits its neighbours, these limit their own, and so on.
    while True:
        lower_m = ndimage.grey_erosion(heights_m, structure=cone, mode="nearest")
        if np.array_equal(lower_m, heights_m):
            return lower_m
        heights_m = lower_m


def find_upright(sweeps: Sequence[Sweep]) -> Float:
    """Return the rotation ``R_level_lidar`` (3,3) from the lidar frame to level axes, z up.

    RANSAC (Fischler, Bolles, 1981) finds the ground plane. Most points are on this plane, and few
    below. Slopes below 0.075 are not levelled. Without ground the result is the identity.
    """
    stride = sum(map(len, sweeps)) // 2000 + 1  # 2000 points of all sweeps are enough
    points = np.concatenate([sweep.points[::stride] for sweep in sweeps])
    for R_turned_lidar in (np.eye(3), np.diag([1.0, -1.0, -1.0])):  # as measured, and upside down
        up = _ground_normal(points @ R_turned_lidar.T)
        if up is None:
            continue
        if np.hypot(*up[:2]) < 0.5 * _MAX_SLOPE * up[2]:  # the slope may be the road's own
            return R_turned_lidar
        return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix() @ R_turned_lidar
    return np.eye(3)


def _ground_normal(points: Float) -> Float | None:
    """Return the (3,) unit normal of the ground plane, pointing up, None if there is no ground."""
    if len(points) < 3:
        return None

    # Planes through 200 random triples of points, with the normal upwards
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(200, 3))]
    corner_a, corner_b, corner_c = corners.transpose(1, 0, 2)
    normal = np.cross(corner_b - corner_a, corner_c - corner_a)
    normal *= np.where(normal[:, 2:] < 0, -1, 1)
    is_floor = normal[:, 2] > np.hypot(*normal[:, :2].T)  # a floor and not a wall
    normal = normal[is_floor] / np.linalg.norm(normal[is_floor], axis=1, keepdims=True)

    # The plane, under the lidar, with the most points on it and the fewest below
    plane_z_m = np.einsum("ij,ij->i", normal, corner_a[is_floor])
    height_m = points @ normal.T - plane_z_m
    on_plane = np.abs(height_m) < ABOVE_GROUND_M
    share_on = np.where(plane_z_m < 0, on_plane.mean(axis=0), 0)
    share_below = (height_m < -ABOVE_GROUND_M).mean(axis=0)
    score = share_on - share_below
    if score.max(initial=0) < 0.1:  # no ground in view
        return None

    # The normal is the direction in which the points of the plane vary least.
    ground_points = points[on_plane[:, np.argmax(score)]]
    _, _, axes = np.linalg.svd(ground_points - ground_points.mean(axis=0), full_matrices=False)
    fitted: Float = axes[2] * np.sign(axes[2, 2])
    return fitted
