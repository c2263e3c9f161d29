# SPDX-License-Identifier: MIT
"""Clouds, compiled: boxes cut out of them, and how certain the places of their surfaces are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry.compiled import Kernel
from densify.geometry.types import Float, Float32, Int

Bytes = NDArray[np.uint8]

_STRIP = 32


class Strips:
    """Points in the order of a scan, in which neighbours mostly follow each other: with the box
    around every few of them, most need not be looked at to find those inside another box."""

    def __init__(self, points: Float) -> None:
        """points: (N,3)."""
        self._points = points
        self._boxes = np.empty((-(-len(points) // _STRIP), 6))
        _box(points, self._boxes)

    def rows_inside(self, low: Float, high: Float) -> Int:
        """The rows, ascending, of the points strictly between two corners (3,)."""
        rows = np.empty(len(self._points), np.int64)
        return rows[: _collect(self._points, self._boxes, low, high, rows)].copy()


def surface_information(
    points: Float, near: Int, loose: float, noise_m: float, ridge: float
) -> Float:
    """(N,5) xx xy yy xz yz of the inverse covariance (1/m²) of the surface around each point.

    points: (N,3). near: (N,k) rows of its neighbours, itself among them. loose: factor of their
    covariance. noise_m: standard deviation added in all directions; ridge: and so much of the mean
    variance.
    """
    information = np.empty((len(points), 5))
    _invert.over_rows(len(points), points, near, loose, noise_m * noise_m, ridge, information)
    return information


@Kernel
def spread(
    points: Float, low: Float, step: float, offsets: Int, values: Bytes, grid: Bytes
) -> None:
    """Raise, in place, the cells around each point to the values.

    points: (N,3). low: (3,) the grid's corner. step: a cell's side. offsets: (K,3) cells from the
    point's own; none may lead out of the grid (X,Y,Z). values: (K,).
    """
    for i in range(len(points)):
        x, y, z = (
            int((points[i, 0] - low[0]) / step),
            int((points[i, 1] - low[1]) / step),
            int((points[i, 2] - low[2]) / step),
        )
        for k in range(len(offsets)):
            at = x + offsets[k, 0], y + offsets[k, 1], z + offsets[k, 2]
            grid[at] = max(grid[at], values[k])


@Kernel
def look_up(
    first: int,
    last: int,
    points: Float,
    late_s: Float,
    velocities: Float,
    elapsed_s: Float,
    low: Float,
    cells_per_m: float,
    nearness: Bytes,
    found: Bytes,
) -> None:
    """Raise ``found`` (V,N), in place, to what the cells hold in which (N,3) points are that have
    moved for ``elapsed_s`` (V,), ``late_s`` (N,) less, with each of (V,3) velocities.

    nearness: (X,Y,Z) of the cells of a grid whose corner is ``low`` (3,); 0 outside.
    """
    num_x, num_y, num_z = nearness.shape
    for v in range(first, last):
        for i in range(len(points)):
            moving_s = elapsed_s[v] - late_s[i]
            x = int((points[i, 0] + velocities[v, 0] * moving_s - low[0]) * cells_per_m)
            y = int((points[i, 1] + velocities[v, 1] * moving_s - low[1]) * cells_per_m)
            z = int((points[i, 2] + velocities[v, 2] * moving_s - low[2]) * cells_per_m)
            if 0 <= x < num_x and 0 <= y < num_y and 0 <= z < num_z:
                found[v, i] = max(found[v, i], nearness[x, y, z])


@Kernel
def _box(points: Float, boxes: Float) -> None:
    for box in range(len(boxes)):
        for axis in range(3):
            low, high = np.inf, -np.inf
            for i in range(box * _STRIP, min((box + 1) * _STRIP, len(points))):
                low, high = min(low, points[i, axis]), max(high, points[i, axis])
            boxes[box, axis], boxes[box, 3 + axis] = low, high


@Kernel
def _collect(points: Float, boxes: Float, low: Float, high: Float, rows: Int) -> int:
    num = 0
    for box in range(len(boxes)):
        apart = False
        for axis in range(3):
            apart |= boxes[box, axis] >= high[axis] or boxes[box, 3 + axis] <= low[axis]
        if apart:
            continue
        for i in range(box * _STRIP, min((box + 1) * _STRIP, len(points))):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            rows[num] = i  # overwritten unless it is inside: without a branch, none foresees it
            num += (
                (x > low[0])
                & (x < high[0])
                & (y > low[1])
                & (y < high[1])
                & (z > low[2])
                & (z < high[2])
            )
    return num


@Kernel
def _invert(
    begin: int,
    end: int,
    points: Float,
    near: Int,
    loose: float,
    noise: float,
    ridge: float,
    information: Float,
) -> None:
    num = near.shape[1]
    for i in range(begin, end):
        mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
        for k in range(num):
            j = near[i, k]
            mx, my, mz = mx + points[j, 0], my + points[j, 1], mz + points[j, 2]
        mx, my, mz = mx / num, my / num, mz / num
        for k in range(num):
            j = near[i, k]
            x, y, z = points[j, 0] - mx, points[j, 1] - my, points[j, 2] - mz
            xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
            yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
        factor = loose / num
        added = noise + ridge * factor * (xx + yy + zz) / 3
        xx, yy, zz = factor * xx + added, factor * yy + added, factor * zz + added
        xy, xz, yz = factor * xy, factor * xz, factor * yz
        # By cofactors: the ridge keeps the covariance far from singular.
        of_xx, of_xy, of_xz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        determinant = xx * of_xx + xy * of_xy + xz * of_xz
        information[i, 0] = of_xx / determinant
        information[i, 1] = of_xy / determinant
        information[i, 2] = (xx * zz - xz * xz) / determinant
        information[i, 3] = of_xz / determinant
        information[i, 4] = (xy * xz - xx * yz) / determinant


def thinned(points: Float | Float32, order: Int, step: float, most: int) -> Int:
    """The rows, ascending, of (N,3) points that are left if each cell of a grid keeps the first
    ``most`` of its points in that ``order``.

    step: side of a cell. Rows that are not in the order are left out.
    """
    size = 1 << max(4, int(2 * len(points)).bit_length())
    cells, counts = np.full(size, -1, np.int64), np.zeros(size, np.uint8)
    keep = np.zeros(len(points), bool)
    if len(points):
        low = points.min(axis=0).astype(np.float64)
        _thin(points, order, low, step, most, cells, counts, keep)
    return np.flatnonzero(keep)


@Kernel
def _thin(points, order, low, step, most, cells, counts, keep):  # type: ignore[no-untyped-def]
    """cells, counts: a table of 2^k places, by open addressing."""
    mask = len(cells) - 1
    for i in order:
        x = int((points[i, 0] - low[0]) / step)
        y = int((points[i, 1] - low[1]) / step)
        z = int((points[i, 2] - low[2]) / step)
        cell = (x << 42) | (y << 21) | z
        at = (cell ^ (cell >> 29)) * np.int64(-7046029254386353131)
        at = (at ^ (at >> 32)) & mask
        while cells[at] != cell and cells[at] >= 0:
            at = (at + 1) & mask
        cells[at] = cell
        if counts[at] < most:
            counts[at] += 1
            keep[i] = True
