# SPDX-License-Identifier: MIT
"""Compute the surface patch of each accumulated point, in space and in an image, and occlusion.

A patch is as large as the spacing of its sweep's rays, tangent to the neighbouring points, and
occludes what lies behind it. On a plane with normal · point = 1 the inverse range in a direction is
normal · direction. Its derivatives by azimuth and elevation give the normal. In an image the
inverse depth of a plane is linear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import PointsInImage, pixel_of
from densify.free_space.sensor import Sensors
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Cloud, Float, Float32, Int, Patches

AGREE_M, AGREE_FRACTION = 0.1, 0.02
"""Greatest deviation between points on one surface: metres plus share of the depth."""
HIDDEN_M, HIDDEN_FRACTION = 0.2, 0.06
"""Least distance of an occluded point behind the nearest surface: metres plus share of depth."""
FOOTPRINT = 0.35
"""Half size of a patch, and of the spot of a laser, in spacings of neighbouring rays."""
_SLACK_M = 0.5 * AGREE_M  # added to the footprint, for errors of registration and flow
# Greatest change of range per metre across the ray, at 10 degrees between ray and surface. A
# steeper slope is a step in depth between two surfaces.
_STEEP = 5.7
_BEND = 0.25  # greatest change of the slope on one curved surface, as a share of the slope
# Neighbours of a point of an unordered scanner: radius in spacings of rays, and its limit in cells
_RADIUS, _MOST_CELLS = 5.0, 20
_RIDGE = 0.005  # ridge of planes, as a share of the sum of the neighbours' squared distances
_MOST_RATIO = 1.4  # greatest ratio of an extended inverse depth to the inverse depth at its start
_AZIMUTH, _ELEVATION, _RANGE = range(3)  # rows of ``spherical``


def agree_m(depth_m: Float | Float32) -> Float | Float32:
    """Return the greatest deviation in metres between points on one surface, at depths in m."""
    return AGREE_M + AGREE_FRACTION * depth_m


def hidden_m(surface_m: Float | Float32) -> Float | Float32:
    """Return the distance in metres behind surfaces, at depths in m, that occludes points."""
    return HIDDEN_M + HIDDEN_FRACTION * surface_m


def find_patches(
    cloud: Cloud, sensors: Sensors, origins: Mapping[int, Float], wanted: Bool | None = None
) -> Patches:
    """Return the surface patch of each of M points of a cloud, tangent to the neighbouring points.

    ``origins`` are the scanners' origins (S,3) by a sweep's frame number, key sweep's lidar frame.
    Only ``wanted`` (M,) points get a patch, others get zeros. None means all.
    """
    frames, index = np.unique(cloud.frame, return_inverse=True)
    sweep: NDArray[np.int32] = index.astype(np.int32)
    sweep_origins = [origins[frame] for frame in frames.tolist()]
    # In the rigid points a moving object has the shape that each sweep measured.
    return fit_tangents(cloud.rigid_points, cloud.lidar, sweep, sensors, sweep_origins, wanted)


def fit_tangents(
    points: Float,
    lidar: NDArray[np.uint8],
    sweep: NDArray[np.int32],
    sensors: Sensors,
    origins: Sequence[Float],
    wanted: Bool | None = None,
) -> Patches:
    """Return the patches of M points, each tangent to the neighbours that its scanner measured.

    A position x is on the tangent plane if normal · (x - origin) = 1. If the neighbours are on no
    single surface, the patch faces the scanner. Spacings are metres between neighbouring rays,
    along the azimuth and along the elevation.

    Args:
        points: (M,3) points, in any one frame.
        lidar: (M,) number of the scanner of each point.
        sweep: (M,) index of each point's sweep in ``origins``.
        origins: (S,3) origins of the scanners for each sweep, in the frame of the points.
        wanted: (M,) True for points that need a patch, None for all. Other points get zeros.
    """
    normal = np.zeros((len(points), 3), np.float32)
    spacing_m = np.zeros((len(points), 2), np.float32)
    if not len(points):
        return Patches(normal, spacing_m)
    # A scan is the part of a sweep that one scanner measured. Scans are numbered sweep by sweep.
    num_scanners = len(origins[0])
    scan = (sweep * num_scanners + lidar).astype(np.int32)
    spherical = np.empty((3, len(points)), np.float32)
    _to_spherical.over_rows(len(points), points, np.concatenate(origins), scan, spherical)
    num_points = np.bincount(scan, minlength=num_scanners * len(origins))
    rows_of_scan = np.split(np.argsort(scan, kind="stable"), np.cumsum(num_points)[:-1])
    for number, model in sensors.models.items():
        grid = model.grid
        cells = np.empty((grid.num_rows, grid.num_columns), np.int32)
        fit = _fit_unordered if model.unordered else _fit_on_rings
        for rows in rows_of_scan[number::num_scanners]:  # the scans of this scanner
            _nearest_in_cells(spherical, rows, grid, cells)
            fitted = rows if wanted is None else rows[wanted[rows]]
            fit.over_rows(
                len(fitted), fitted, spherical, model.table, grid, cells, normal, spacing_m
            )
    return Patches(normal, spacing_m)


@Kernel
def _to_spherical(begin, end, points, origins, scan, spherical):  # type: ignore[no-untyped-def]
    """Fill ``spherical`` (3,N): azimuth, elevation (rad) and range (m) from each scan's origin."""
    for i in range(begin, end):
        x = points[i, 0] - origins[scan[i], 0]
        y = points[i, 1] - origins[scan[i], 1]
        z = points[i, 2] - origins[scan[i], 2]
        horizontal_m = np.sqrt(x * x + y * y)
        spherical[_AZIMUTH, i] = np.arctan2(y, x)
        spherical[_ELEVATION, i] = np.arctan2(z, horizontal_m)
        spherical[_RANGE, i] = np.sqrt(horizontal_m * horizontal_m + z * z)


@inlined
def _cell(azimuth, elevation, grid):  # type: ignore[no-untyped-def]
    """Return the row and the column of a direction (rad) in a grid of directions, a `RayGrid`."""
    # The row is interpolated between the borders of the elevation's bin.
    bin_position = (elevation - grid.low_rad) / grid.bin_rad
    index = min(max(int(bin_position), 0), len(grid.row_of) - 2)
    lower_row, upper_row = grid.row_of[index], grid.row_of[index + 1]
    row_position = lower_row + (bin_position - index) * (upper_row - lower_row)
    row = min(max(int(row_position), 0), grid.num_rows - 1)
    column = int((azimuth + np.pi) * (grid.num_columns / (2 * np.pi)))
    return row, min(max(column, 0), grid.num_columns - 1)


@inlined
def _spacing(azimuth, elevation, table):  # type: ignore[no-untyped-def]
    """Return the angles (rad) to the next ray along azimuth and along elevation, by a table."""
    rows, columns = table.elevation_gap_rad.shape
    row = min(max(int((elevation - table.low_rad) / table.bin_rad), 0), rows - 1)
    column = int((azimuth + np.pi) * (columns / (2 * np.pi))) % columns
    return table.azimuth_gap_rad[row, column], table.elevation_gap_rad[row, column]


@inlined
def _is_nearer(spherical, i, j):  # type: ignore[no-untyped-def]
    """Return True if point i is nearer than point j. The direction decides ties, not the order."""
    if spherical[_RANGE, i] != spherical[_RANGE, j]:
        return spherical[_RANGE, i] < spherical[_RANGE, j]
    if spherical[_AZIMUTH, i] != spherical[_AZIMUTH, j]:
        return spherical[_AZIMUTH, i] < spherical[_AZIMUTH, j]
    return spherical[_ELEVATION, i] < spherical[_ELEVATION, j]


@Kernel
def _nearest_in_cells(spherical, rows, grid, cells):  # type: ignore[no-untyped-def]
    """Fill ``cells`` (R,C) with the index of the nearest point of ``rows`` in each, -1 if none."""
    cells[:] = -1
    for i in rows:
        row, column = _cell(spherical[_AZIMUTH, i], spherical[_ELEVATION, i], grid)
        nearest = cells[row, column]
        if nearest < 0 or _is_nearer(spherical, i, nearest):
            cells[row, column] = i


@inlined
def _first_filled(cells, row, column, row_offsets, column_offsets):  # type: ignore[no-untyped-def]
    """Return the index of the point in the first filled cell at the given offsets, -1 if none."""
    for k in range(len(row_offsets)):
        neighbour_row = row + row_offsets[k]
        if 0 <= neighbour_row < cells.shape[0]:
            point = cells[neighbour_row, (column + column_offsets[k]) % cells.shape[1]]
            if point >= 0:
                return point
    return -1


@inlined
def _slope(slope_a, slope_b, step_rad, range_m):  # type: ignore[no-untyped-def]
    """Return the slope of inverse range per radian from the slopes to both sides, 0 if unknown."""
    # The change of range (m) to a neighbour, step_rad away, is range² · slope · step.
    metres = step_rad * range_m * range_m
    # The mean on one surface, else the lesser slope, or 0 if the lesser slope is a step in depth
    if abs(slope_a - slope_b) * metres <= AGREE_M + _BEND * abs(slope_a + slope_b) * metres:
        return 0.5 * (slope_a + slope_b)
    if not abs(slope_a) <= abs(slope_b):  # also if one of them is NaN
        slope_a = slope_b
    return slope_a if abs(slope_a) * range_m <= _STEEP else 0.0  # 0 for NaN, too


@inlined
def _slope_to(spherical, i, j, axis, other_axis, other_slope):  # type: ignore[no-untyped-def]
    """Return the slope of inverse range per radian along ``axis`` from point i to neighbour j.

    The change along the other axis, of known slope, is subtracted. Axes are ``_AZIMUTH`` and
    ``_ELEVATION``. The slope is NaN without a neighbour (j < 0), or if both have equal angles.
    """
    if j < 0:
        return np.nan
    angle = spherical[axis, j] - spherical[axis, i]
    if axis == _AZIMUTH:
        angle -= 2 * np.pi * np.rint(angle / (2 * np.pi))  # azimuths wrap around
    if abs(angle) < 1e-5:  # rounding errors would decide the slope
        return np.nan
    # 1 / range changes by slope · angle + other slope · other angle.
    other_angle = spherical[other_axis, j] - spherical[other_axis, i]
    change = 1 / spherical[_RANGE, j] - 1 / spherical[_RANGE, i]
    return (change - other_slope * other_angle) / angle


@inlined
def _put(i, spherical, table, azimuth_slope, elevation_slope, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill in normal and spacing of point i from its slopes of inverse range per radian."""
    azimuth, elevation = spherical[_AZIMUTH, i], spherical[_ELEVATION, i]
    range_m = spherical[_RANGE, i]
    azimuth_gap, elevation_gap = _spacing(azimuth, elevation, table)
    # The components of the normal along the ray, to the left and upwards are the inverse range, and
    # its slopes per radian on the sphere, where a radian of azimuth is shorter.
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    to_left = azimuth_slope / max(ce, 1e-3)
    normal[i, 0] = ce * ca / range_m - to_left * sa - elevation_slope * se * ca
    normal[i, 1] = ce * sa / range_m + to_left * ca - elevation_slope * se * sa
    normal[i, 2] = se / range_m + elevation_slope * ce
    spacing[i, 0] = range_m * azimuth_gap
    spacing[i, 1] = range_m * elevation_gap


@Kernel
def _fit_on_rings(begin, end, rows, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal (N,3) and spacing (N,2) of points by neighbours on the ring, above and below."""
    # Offsets of the cells in which a neighbour is looked for, in this order. Noise of the range
    # matters less over two steps.
    right, left = np.array([-2, -1, -3]), np.array([2, 1, 3])
    same_row = np.array([0, 0, 0])
    up, down = np.array([1, 1, 1, 2]), np.array([-1, -1, -1, -2])
    beside = np.array([0, 1, -1, 0])
    for k in range(begin, end):
        i = rows[k]
        azimuth, elevation = spherical[_AZIMUTH, i], spherical[_ELEVATION, i]
        range_m = spherical[_RANGE, i]
        azimuth_gap, elevation_gap = _spacing(azimuth, elevation, table)
        # The table has angles on the sphere. The difference in azimuth is larger.
        step_rad = azimuth_gap / max(np.cos(elevation), 1e-3)
        row, column = _cell(azimuth, elevation, grid)

        # A neighbour is usually two steps away. Along the ring the elevation hardly changes.
        on_right = _first_filled(cells, row, column, same_row, right)
        on_left = _first_filled(cells, row, column, same_row, left)
        slope_right = _slope_to(spherical, i, on_right, _AZIMUTH, _ELEVATION, 0.0)
        slope_left = _slope_to(spherical, i, on_left, _AZIMUTH, _ELEVATION, 0.0)
        azimuth_slope = _slope(slope_right, slope_left, 2 * step_rad, range_m)

        # Neighbours above and below may differ in azimuth: the change by the azimuth is subtracted.
        above = _first_filled(cells, row, column, up, beside)
        below = _first_filled(cells, row, column, down, beside)
        slope_up = _slope_to(spherical, i, above, _ELEVATION, _AZIMUTH, azimuth_slope)
        slope_down = _slope_to(spherical, i, below, _ELEVATION, _AZIMUTH, azimuth_slope)
        elevation_slope = _slope(slope_up, slope_down, elevation_gap, range_m)
        _put(i, spherical, table, azimuth_slope, elevation_slope, normal, spacing)


@inlined
def _sum_products(i, spherical, cells, row, column, reach, slope_u, slope_v, is_refit, sums):  # type: ignore[no-untyped-def]
    """Fill in ``sums`` (5,) of products, and return the numbers of all and of used neighbours."""
    # u and v are angles to the left and upwards on the sphere, w is inverse range, all relative to
    # point i. A refit uses only neighbours close to the plane w = slope_u · u + slope_v · v.
    azimuth, elevation = spherical[_AZIMUTH, i], spherical[_ELEVATION, i]
    range_m, shortening = spherical[_RANGE, i], np.cos(elevation)
    num_rows, num_columns = cells.shape
    uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    num_neighbours, num_fitted = 0, 0
    for r in range(max(row - reach, 0), min(row + reach, num_rows - 1) + 1):
        for c in range(column - reach, column + reach + 1):
            j = cells[r, c % num_columns]  # columns wrap around
            if j < 0:
                continue
            u = spherical[_AZIMUTH, j] - azimuth
            u = (u - 2 * np.pi * np.rint(u / (2 * np.pi))) * shortening
            v, w = spherical[_ELEVATION, j] - elevation, 1 / spherical[_RANGE, j] - 1 / range_m
            if u == 0 and v == 0 and w == 0:
                continue  # the point itself, or one at the same position
            num_neighbours += 1
            # A difference of inverse range (1/m), times range², is one of range (m).
            deviation_m = abs(w - slope_u * u - slope_v * v) * range_m * range_m
            if is_refit and deviation_m > AGREE_M + _BEND * abs(w) * range_m * range_m:
                continue
            num_fitted += 1
            uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
    sums[0], sums[1], sums[2], sums[3], sums[4] = uu, uv, vv, uw, vw
    return num_neighbours, num_fitted


@Kernel
def _fit_unordered(begin, end, rows, spherical, table, grid, cells, normal, spacing):  # type: ignore[no-untyped-def]
    """Fill normal (N,3) and spacing (N,2) of points by a plane through all neighbours."""
    sums = np.empty(5)
    for k in range(begin, end):
        i = rows[k]
        azimuth, elevation = spherical[_AZIMUTH, i], spherical[_ELEVATION, i]
        row, column = _cell(azimuth, elevation, grid)
        _, elevation_gap = _spacing(azimuth, elevation, table)
        reach = min(1 + int(_RADIUS * elevation_gap / grid.bin_rad), _MOST_CELLS)
        # The plane is fitted by least squares to all neighbours, then to those close to that plane.
        slope_u, slope_v = 0.0, 0.0
        for attempt in range(2):
            num_neighbours, num_fitted = _sum_products(
                i, spherical, cells, row, column, reach, slope_u, slope_v, attempt == 1, sums
            )
            uu, uv, vv, uw, vw = sums[0], sums[1], sums[2], sums[3], sums[4]
            ridge = _RIDGE * (uu + vv) + 1e-12  # not singular, even with one neighbour
            slope_u, slope_v = slopes(uu + ridge, uv, vv + ridge, uw, vw)
            if 2 * num_fitted < num_neighbours:  # no single plane: the patch faces the scanner
                slope_u, slope_v = 0.0, 0.0
        # From the sphere to a slope per radian of azimuth, which is shorter there
        azimuth_slope = slope_u * np.cos(elevation)
        _put(i, spherical, table, azimuth_slope, slope_v, normal, spacing)


def is_occluded(points: PointsInImage, shape: tuple[int, ...]) -> Bool:
    """Return the mask (K,) of points clearly behind the nearest patch in an image of (H,W) px."""
    slack_px = _SLACK_M * points.focal_px / points.depth[:, None]
    # At least half a pixel, so that each patch covers a pixel
    half_px = np.maximum(FOOTPRINT * points.spacing_px + slack_px, 0.5)
    nearest = np.zeros(shape, np.float32)
    paint(points.uv, points.inverse, points.slope, half_px, nearest)
    with np.errstate(divide="ignore"):
        nearest_m = 1 / nearest[pixel_of(points.uv)].astype(np.float64)  # inf without a patch
    return points.depth - nearest_m > hidden_m(nearest_m)


@Kernel
def paint(uv, inverse, slope, half_px, canvas):  # type: ignore[no-untyped-def]
    """Raise ``canvas`` (H,W) float32 in place to the greatest inverse depth of the patches there.

    A patch covers the pixel centres within ``half_px`` (K,2) of uv (K,2). There its inverse depth
    is ``inverse + slope · offset``, between half of ``inverse`` and all of it: a patch is never
    nearer than its point. ``inverse`` (K,) is in 1/m, ``slope`` (K,2) in 1/m per px.
    """
    height, width = canvas.shape
    for i in range(len(inverse)):
        at_point = inverse[i]
        left = max(int(np.ceil(uv[i, 0] - half_px[i, 0])), 0)
        right = min(int(np.floor(uv[i, 0] + half_px[i, 0])), width - 1)
        top = max(int(np.ceil(uv[i, 1] - half_px[i, 1])), 0)
        bottom = min(int(np.floor(uv[i, 1] + half_px[i, 1])), height - 1)
        for v in range(top, bottom + 1):
            change_v = slope[i, 1] * (v - uv[i, 1])
            covered = canvas[v, left : right + 1]
            for k in range(len(covered)):
                change = change_v + slope[i, 0] * (left + k - uv[i, 0])
                on_patch = at_point + min(max(change, -0.5 * at_point), 0.0)
                covered[k] = max(covered[k], np.float32(on_patch))


def sorted_by_pixel(points: PointsInImage, rank: Int, shape: tuple[int, ...]) -> tuple[Int, Int]:
    """Return the order of K points by their pixel in an image of shape (H,W), then by rank.

    Of equal ranks the nearer point is first. Returned are ``start`` (H·W+1,) and the indices
    ``order`` (K,) of the points: pixel p has ``order[start[p]:start[p + 1]]``.
    """
    row, column = pixel_of(points.uv)
    start = np.empty(shape[0] * shape[1] + 1, np.int64)
    order = np.empty(len(rank), np.int64)
    pixel = row * shape[1] + column
    _sort_by_pixel(pixel, rank, points.depth, points.frame, points.uv, start, order)
    return start, order


@inlined
def _wins(a, b, rank, depth, frame, uv):  # type: ignore[no-untyped-def]
    """Return True if a pixel has point a before b. Only equal points may come in any order."""
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
def _sort_by_pixel(pixel, rank, depth, frame, uv, start, order):  # type: ignore[no-untyped-def]
    """Fill start (num_pixels + 1,) and order (K,) of `sorted_by_pixel` by flat pixels (K,)."""
    # The points of pixel p are counted at p + 1, so the running sum is the start of each pixel.
    start[:] = 0
    for p in pixel:
        start[p + 1] += 1
    for p in range(len(start) - 1):
        start[p + 1] += start[p]
    # Insertion sort within each pixel, which has few points
    num_sorted = np.empty(len(start) - 1, np.int32)
    num_sorted[:] = 0
    for i in range(len(pixel)):
        p = pixel[i]
        place = start[p] + num_sorted[p]
        while place > start[p] and _wins(i, order[place - 1], rank, depth, frame, uv):
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
        num_sorted[p] += 1


@inlined
def limit_inverse(inverse, start):  # type: ignore[no-untyped-def]
    """Return ``inverse`` (1/m), kept between 1 / 1.4 and 1.4 times ``start`` (1/m, above 0).

    ``inverse`` is extended from a pixel with the inverse depth ``start``, and may be 0 or below.
    """
    return min(max(inverse, start / _MOST_RATIO), _MOST_RATIO * start)


@inlined
def slopes(uu, uv, vv, uw, vw):  # type: ignore[no-untyped-def]
    """Return slope_u and slope_v of the plane w = slope_u · u + slope_v · v through points.

    The arguments are sums or means of the products of u, v and w, all relative to their means.
    """
    # Normal equations: uu slope_u + uv slope_v = uw, uv slope_u + vv slope_v = vw
    determinant = uu * vv - uv * uv
    return (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant


@inlined
def add_moments(moments, weight, u, v, w):  # type: ignore[no-untyped-def]
    """Add a pixel at offset (u, v) px with inverse depth w (1/m) to the sums (9,) of `plane`."""
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
    """Return the weighted least-squares plane through the pixels summed by `add_moments`.

    Returned are inverse depth (1/m) at offset 0 and slopes right and down (1/m per px). ``ridge``,
    a variance (px²), keeps pixels on one line from tilting the plane across the line.
    """
    sum_weights = moments[0]
    u, v, w = moments[1] / sum_weights, moments[2] / sum_weights, moments[6] / sum_weights
    # Variances and covariances: means of products minus products of means
    uu = moments[3] / sum_weights - u * u + ridge
    uv = moments[4] / sum_weights - u * v
    vv = moments[5] / sum_weights - v * v + ridge
    uw, vw = moments[7] / sum_weights - u * w, moments[8] / sum_weights - v * w
    slope_u, slope_v = slopes(uu, uv, vv, uw, vw)
    return w - slope_u * u - slope_v * v, slope_u, slope_v
