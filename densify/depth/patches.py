# SPDX-License-Identifier: MIT
"""Compute the surface patch of each accumulated point, in space and in an image, and occlusion.

A patch is as large as the spacing of its sweep's rays, tangent to the neighbouring points, and
occludes what lies behind it. On a plane the inverse range is normal · direction, so its derivatives
by azimuth and elevation give the normal. In an image the inverse depth of a plane is linear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import PointsInImage, pixel_of
from densify.free_space.sensor import Sensors
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Camera, Cloud, Float, Float32, Int, Patches

AGREE_M, AGREE_FRACTION = 0.1, 0.02
"""Greatest deviation between points on one surface: metres plus share of the depth."""
HIDDEN_M, HIDDEN_FRACTION = 0.2, 0.06
"""Least distance of an occluded point behind the nearest surface: metres plus share of depth."""
FOOTPRINT = 0.35
"""Half size of a patch, and of the spot of a laser, in spacings of neighbouring rays."""
_SLACK_M = 0.5 * AGREE_M  # added to the footprint, for errors of registration and flow
_STEEP = 5.7  # greatest slope, 10 degrees of incidence; a steeper surface on one side is a step
_BEND = 0.25  # greatest change of the slope on one surface, as a share
_RADIUS, _MOST_CELLS = 5.0, 20  # radius of neighbours of unordered rays: spacings, most cells
_RIDGE = 0.005  # ridge of planes, as a share of the mean square distance of the neighbours
_MOST_RATIO = 1.4  # greatest ratio of the extended inverse depth and that at the start


def agree_m(depth_m: Float | Float32) -> Float | Float32:
    """Return the greatest deviation between points on one surface at these depths."""
    return AGREE_M + AGREE_FRACTION * depth_m


def hidden_m(surface_m: Float | Float32) -> Float | Float32:
    """Return the distance behind surfaces at these depths from which points are occluded."""
    return HIDDEN_M + HIDDEN_FRACTION * surface_m


def find_patches(
    cloud: Cloud, sensors: Sensors, origins: Mapping[int, Float], wanted: Bool | None = None
) -> Patches:
    """Return the surface patches of a cloud.

    A patch is tangent to the neighbouring returns of the same scanner and sweep. If the neighbours
    are on no single surface, the patch faces the scanner.

    Args:
        cloud: The cloud of M points.
        sensors: Scanners of the recording.
        origins: (S,3) origins of the scanners, key sweep's lidar frame, by frame number.
        wanted: (M,) True for points in view of a camera, None for all. Other points get zeros.
    """
    frames, index = np.unique(cloud.frame, return_inverse=True)
    sweep: NDArray[np.int32] = index.ravel().astype(np.int32)
    sweep_origins = [origins[int(frame)] for frame in frames]
    # In the rigid points the objects have the shape that each sweep measured.
    return fit_tangents(cloud.rigid_points, cloud.lidar, sweep, sensors, sweep_origins, wanted)


def fit_tangents(
    points: Float,
    lidar: NDArray[np.uint8],
    sweep: NDArray[np.int32],
    sensors: Sensors,
    origins: Sequence[Float],
    wanted: Bool | None = None,
) -> Patches:
    """Return the patches of M points, see `find_patches`.

    A point p is on the tangent plane if normal · (p - origin) = 1. Spacings are metres between
    neighbouring rays, along the azimuth and along the elevation.

    Args:
        points: (M,3) points, in any one frame.
        lidar: (M,) number of the scanner of each point.
        sweep: (M,) index of each point's sweep in ``origins``.
        sensors: Scanners of the recording.
        origins: (S,3) origins of the scanners for each sweep, in the frame of the points.
        wanted: As in `find_patches`.
    """
    normal = np.zeros((len(points), 3), np.float32)
    spacing_m = np.zeros((len(points), 2), np.float32)
    if not len(points):
        return Patches(normal, spacing_m)
    # Scanners are counted over all sweeps: those of the first sweep, of the second, and so on.
    num_scanners = len(origins[0])
    scanner = (sweep * num_scanners + lidar).astype(np.int32)
    spherical = np.empty((3, len(points)), np.float32)
    _to_spherical.over_rows(len(points), points, np.concatenate(origins), scanner, spherical)
    size = np.bincount(scanner, minlength=num_scanners * len(origins))
    members = np.split(np.argsort(scanner, kind="stable"), np.cumsum(size)[:-1])
    for number, model in sensors.models.items():
        grid = model.grid
        cells = np.empty((grid.num_rows, grid.num_columns), np.int32)
        fit = _fit_anywhere if model.unordered else _fit_on_rings
        for rows in members[number::num_scanners]:  # of one scanner, sweep by sweep
            _nearest_in_cells(spherical, rows, grid, cells)
            if wanted is not None:
                rows = rows[wanted[rows]]
            fit.over_rows(len(rows), rows, spherical, model.table, grid, cells, normal, spacing_m)
    return Patches(normal, spacing_m)


@Kernel
def _to_spherical(first, last, points, origins, scanner, spherical):  # type: ignore[no-untyped-def]
    """Fill ``spherical`` (3,N) with azimuth, elevation (rad) and range (m) of points (N,3)."""
    for i in range(first, last):
        x = points[i, 0] - origins[scanner[i], 0]
        y = points[i, 1] - origins[scanner[i], 1]
        z = points[i, 2] - origins[scanner[i], 2]
        horizontal_m = np.sqrt(x * x + y * y)
        spherical[0, i] = np.arctan2(y, x)
        spherical[1, i] = np.arctan2(z, horizontal_m)
        spherical[2, i] = np.sqrt(horizontal_m * horizontal_m + z * z)


@inlined
def _cell(azimuth, elevation, grid):  # type: ignore[no-untyped-def]
    """Return row and column of a direction in a `densify.free_space.sensor.RayGrid`."""
    # The row is interpolated between the edges of the elevation's bin.
    bin_position = (elevation - grid.low_rad) / grid.bin_rad
    k = min(max(int(bin_position), 0), len(grid.row_of) - 2)
    row_position = grid.row_of[k] + (bin_position - k) * (grid.row_of[k + 1] - grid.row_of[k])
    row = min(max(int(row_position), 0), grid.num_rows - 1)
    column = int((azimuth + np.pi) * (grid.num_columns / (2 * np.pi)))
    return row, min(max(column, 0), grid.num_columns - 1)


@inlined
def _spacing(azimuth, elevation, table):  # type: ignore[no-untyped-def]
    """Return the angles (rad) to the next ray along azimuth and elevation, from a `RayTable`."""
    rows, columns = table.elevation_gap_rad.shape
    row = min(max(int((elevation - table.low_rad) / table.bin_rad), 0), rows - 1)
    column = int((azimuth + np.pi) * (columns / (2 * np.pi))) % columns
    return table.azimuth_gap_rad[row, column], table.elevation_gap_rad[row, column]


@inlined
def _before(spherical, i, j):  # type: ignore[no-untyped-def]
    """Return True if point i is nearer than point j; between equal ranges the direction decides."""
    if spherical[2, i] != spherical[2, j]:
        return spherical[2, i] < spherical[2, j]
    if spherical[0, i] != spherical[0, j]:
        return spherical[0, i] < spherical[0, j]
    return spherical[1, i] < spherical[1, j]


@Kernel
def _nearest_in_cells(spherical, members, grid, cells):  # type: ignore[no-untyped-def]
    """Fill ``cells`` (R,C) with the index of the nearest of the members in each cell, -1 none."""
    cells[:] = -1
    for i in members:
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        nearest = cells[row, column]
        if nearest < 0 or _before(spherical, i, nearest):
            cells[row, column] = i


@inlined
def _first(cells, row, column, rows, columns):  # type: ignore[no-untyped-def]
    """Return the index of the point in the first filled cell at the given offsets, -1 none."""
    for k in range(len(rows)):
        r = row + rows[k]
        if 0 <= r < cells.shape[0]:
            point = cells[r, (column + columns[k]) % cells.shape[1]]
            if point >= 0:
                return point
    return -1


@inlined
def _slope(slope_a, slope_b, step, range_m):  # type: ignore[no-untyped-def]
    """Return the slope of inverse range per radian from its slopes on both sides (NaN: unknown)."""
    # Metres of range per step (rad), for a slope of 1: the range changes by range² · slope.
    metres = step * range_m * range_m
    # The mean on one surface, else the lesser slope, or 0 if that is a step in depth
    if abs(slope_a - slope_b) * metres <= AGREE_M + _BEND * abs(slope_a + slope_b) * metres:
        return 0.5 * (slope_a + slope_b)
    if not abs(slope_a) <= abs(slope_b):  # True if a slope is NaN
        slope_a = slope_b
    return slope_a if abs(slope_a) * range_m <= _STEEP else 0.0


@inlined
def _change(spherical, i, j, axis, across, slope_across):  # type: ignore[no-untyped-def]
    """Return the change of inverse range per radian from i to j along ``axis``, NaN if unknown."""
    if j < 0:
        return np.nan
    apart = spherical[axis, j] - spherical[axis, i]
    if axis == 0:
        apart -= 2 * np.pi * np.rint(apart / (2 * np.pi))
    if abs(apart) < 1e-5:
        return np.nan
    beside = spherical[across, j] - spherical[across, i]
    return (1 / spherical[2, j] - 1 / spherical[2, i] - slope_across * beside) / apart


@inlined
def _put(i, spherical, table, slope_u, slope_v, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill in normal and spacing of point i from its slopes of inverse range per radian."""
    azimuth, elevation, range_m = spherical[0, i], spherical[1, i], spherical[2, i]
    azimuth_gap, elevation_gap = _spacing(azimuth, elevation, table)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    aside = slope_u / max(ce, 1e-3)
    normal[i, 0] = ce * ca / range_m - aside * sa - slope_v * se * ca
    normal[i, 1] = ce * sa / range_m + aside * ca - slope_v * se * sa
    normal[i, 2] = se / range_m + slope_v * ce
    spacing[i, 0] = range_m * azimuth_gap
    spacing[i, 1] = range_m * elevation_gap


@Kernel
def _fit_on_rings(first, last, members, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal (N,3) and spacing (N,2) of members from neighbours on the ring, above, below."""
    # Offsets of the cells in which a neighbour is looked for, in this order
    right, left = np.array([-2, -1, -3]), np.array([2, 1, 3])
    same = np.array([0, 0, 0])
    up, down = np.array([1, 1, 1, 2]), np.array([-1, -1, -1, -2])
    straight = np.array([0, 1, -1, 0])
    for k in range(first, last):
        i = members[k]
        azimuth_gap, elevation_gap = _spacing(spherical[0, i], spherical[1, i], table)
        step = azimuth_gap / max(np.cos(spherical[1, i]), 1e-3)
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        slope_a = _change(spherical, i, _first(cells, row, column, same, right), 0, 1, 0.0)
        slope_b = _change(spherical, i, _first(cells, row, column, same, left), 0, 1, 0.0)
        slope_u = _slope(slope_a, slope_b, 2 * step, spherical[2, i])  # neighbours two steps away
        slope_u = 0.0 if np.isnan(slope_u) else slope_u
        above = _first(cells, row, column, up, straight)
        below = _first(cells, row, column, down, straight)
        slope_a = _change(spherical, i, above, 1, 0, slope_u)
        slope_b = _change(spherical, i, below, 1, 0, slope_u)
        slope_v = _slope(slope_a, slope_b, elevation_gap, spherical[2, i])
        _put(i, spherical, table, slope_u, 0.0 if np.isnan(slope_v) else slope_v, normal, spacing)


@Kernel
def _fit_anywhere(first, last, members, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal and spacing as `_fit_on_rings`, for a scanner without rings."""
    num_rows, num_columns = cells.shape
    for k in range(first, last):
        i = members[k]
        range_m, flatten = spherical[2, i], np.cos(spherical[1, i])
        row, column = _cell(spherical[0, i], spherical[1, i], grid)
        spacing_rad = _spacing(spherical[0, i], spherical[1, i], table)[1]
        reach = min(1 + int(_RADIUS * spacing_rad / grid.bin_rad), _MOST_CELLS)
        slope_u, slope_v = 0.0, 0.0
        for turn in range(2):  # fit a plane to the points around, then to those close to it
            uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
            num, num_kept = 0, 0
            for r in range(max(row - reach, 0), min(row + reach, num_rows - 1) + 1):
                for c in range(column - reach, column + reach + 1):
                    j = cells[r, c % num_columns]
                    if j < 0:
                        continue
                    u = spherical[0, j] - spherical[0, i]
                    u = (u - 2 * np.pi * np.rint(u / (2 * np.pi))) * flatten
                    v, w = spherical[1, j] - spherical[1, i], 1 / spherical[2, j] - 1 / range_m
                    if u == 0 and v == 0 and w == 0:
                        continue  # the point itself, or one at the same position
                    num += 1
                    deviation_m = abs(w - slope_u * u - slope_v * v) * range_m * range_m
                    if turn and deviation_m > AGREE_M + _BEND * abs(w) * range_m * range_m:
                        continue
                    num_kept += 1
                    uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
            ridge = _RIDGE * (uu + vv) + 1e-12
            slope_u, slope_v = slopes(uu + ridge, uv, vv + ridge, uw, vw)
            if 2 * num_kept < num:  # no plane: the patch faces the scanner
                slope_u, slope_v = 0.0, 0.0
        _put(i, spherical, table, slope_u * flatten, slope_v, normal, spacing)


def is_occluded(points: PointsInImage, camera: Camera) -> Bool:
    """Return (K,) True for points clearly behind the nearest patch over their pixel."""
    slack_px = _SLACK_M * points.focal_px / points.depth[:, None]
    # At least half a pixel, so that each patch covers a pixel
    half_px = np.maximum(FOOTPRINT * points.spacing_px + slack_px, 0.5)
    nearest = np.zeros((camera.height_px, camera.width_px), np.float32)
    paint(points.uv, points.inverse, points.slope, half_px, nearest)
    with np.errstate(divide="ignore"):
        nearest_m = 1 / nearest[pixel_of(points.uv)].astype(np.float64)  # inf without a patch
    occluded: Bool = points.depth - nearest_m > hidden_m(nearest_m)
    return occluded


@Kernel
def paint(uv, inverse, slope, half_px, canvas):  # type: ignore[no-untyped-def]
    """Raise ``canvas`` (H,W) float32 in place to the greatest inverse depth of the patches there.

    A patch covers the pixel centres within ``half_px`` (K,2) of uv (K,2). Its inverse depth is
    ``inverse + slope · offset``, between half of ``inverse`` and all of it, never nearer than its
    point. ``inverse`` (K,) is in 1/m, ``slope`` (K,2) in 1/m per px.
    """
    height, width = canvas.shape
    for i in range(len(inverse)):
        own = inverse[i]
        left = max(int(np.ceil(uv[i, 0] - half_px[i, 0])), 0)
        right = min(int(np.floor(uv[i, 0] + half_px[i, 0])), width - 1)
        top = max(int(np.ceil(uv[i, 1] - half_px[i, 1])), 0)
        bottom = min(int(np.floor(uv[i, 1] + half_px[i, 1])), height - 1)
        for v in range(top, bottom + 1):
            tilt_v = slope[i, 1] * (v - uv[i, 1])
            covered = canvas[v, left : right + 1]
            for k in range(len(covered)):
                tilt = tilt_v + slope[i, 0] * (left + k - uv[i, 0])
                on_patch = own + min(max(tilt, -0.5 * own), 0.0)
                covered[k] = max(covered[k], np.float32(on_patch))


def sorted_by_pixel(points: PointsInImage, rank: Int, camera: Camera) -> tuple[Int, Int]:
    """Return ``start`` (H·W+1,) and ``order`` (K,), the points by pixel, the best first.

    Pixel p has ``order[start[p]:start[p + 1]]``, by lowest ``rank`` (K,), then nearest point.
    """
    row, column = pixel_of(points.uv)
    start = np.empty(camera.height_px * camera.width_px + 1, np.int64)
    order = np.empty(len(rank), np.int64)
    pixel = row * camera.width_px + column
    _by_pixel(pixel, rank, points.depth, points.frame, points.uv, start, order)
    return start, order


@inlined
def _wins(a, b, rank, depth, frame, uv):  # type: ignore[no-untyped-def]
    """Return True if point a wins a pixel over b. Equal points may come in any order."""
    if rank[a] != rank[b]:
        return rank[a] < rank[b]
    if depth[a] != depth[b]:
        return depth[a] < depth[b]
    if frame[a] != frame[b]:
        return frame[a] < frame[b]
    if uv[a, 0] != uv[b, 0]:
        return uv[a, 0] < uv[b, 0]
    return uv[a, 1] < uv[b, 1]


@Kernel
def _by_pixel(pixel, rank, depth, frame, uv, start, order):  # type: ignore[no-untyped-def]
    """Fill start (num_pixels + 1,) and order (K,) of `sorted_by_pixel`."""
    # The number of points of each pixel, one place later, so that sums give the first places
    start[:] = 0
    for p in pixel:
        start[p + 1] += 1
    for p in range(len(start) - 1):
        start[p + 1] += start[p]
    filled = np.empty(len(start) - 1, np.int32)
    filled[:] = 0
    for i in range(len(pixel)):
        p = pixel[i]
        # Insertion sort: a pixel has few points.
        place = start[p] + filled[p]
        while place > start[p] and _wins(i, order[place - 1], rank, depth, frame, uv):
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
        filled[p] += 1


@inlined
def limit_inverse(inverse, start):  # type: ignore[no-untyped-def]
    """Return inverse depth ``inverse``, kept between 1 / 1.4 and 1.4 times ``start``."""
    return min(max(inverse, start / _MOST_RATIO), _MOST_RATIO * start)


@inlined
def slopes(uu, uv, vv, uw, vw):  # type: ignore[no-untyped-def]
    """Return both slopes of the least-squares plane from centred second moments of `plane`."""
    determinant = uu * vv - uv * uv
    return (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant


@inlined
def add_moments(moments, weight, u, v, w):  # type: ignore[no-untyped-def]
    """Add a pixel, at offset (u, v) with inverse depth w, to the ``moments`` (9,) of `plane`."""
    moments[0] += weight
    moments[1] += weight * u
    moments[2] += weight * v
    moments[3] += weight * u * u
    moments[4] += weight * u * v
    moments[5] += weight * v * v
    moments[6] += weight * w
    moments[7] += weight * u * w
    moments[8] += weight * v * w


@inlined
def plane(moments, ridge):  # type: ignore[no-untyped-def]
    """Return inverse depth at the origin and both slopes of the plane of `add_moments`' sums (9,).

    ``ridge``, a variance (px²), keeps pixels on one line from tilting the plane across the line.
    """
    n = moments[0]
    u, v, w = moments[1] / n, moments[2] / n, moments[6] / n
    uu = moments[3] / n - u * u + ridge
    uv = moments[4] / n - u * v
    vv = moments[5] / n - v * v + ridge
    uw, vw = moments[7] / n - u * w, moments[8] / n - v * w
    slope_u, slope_v = slopes(uu, uv, vv, uw, vw)
    return w - slope_u * u - slope_v * v, slope_u, slope_v
