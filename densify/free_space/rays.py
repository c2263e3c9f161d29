# SPDX-License-Identifier: MIT
"""Measure the rays of a scanner (angles in radians), and how they sample directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Float, Float32, Int, RegisteredSweep

FEW_POINTS = 200  # with fewer returns nothing can be measured
_DEFAULT_RAD = tuple(np.deg2rad([0.18, 0.40]))  # gaps of a 64-beam scanner: on a ring, to the next
# A sweep of more returns is measured in every fourth sector of this width.
_MANY_POINTS, _SECTOR_RAD = 15_000, np.deg2rad(5.0)

# Heights of the bins of elevation in which rings and lines are found; side of a cell of direction
_RING_BIN_RAD, _LINE_BIN_RAD, _CELL_RAD = np.deg2rad([0.02, 0.5, 1.0])
_MIN_NUM = 24  # least number of returns or gaps for a mean in a ring, a bin or a cell
_EVEN = 0.2  # greatest deviation of a ray from an even spacing, as a share of the usual gap
_VALLEY = 0.5  # greatest count between two rings, as a share of both peaks
_MIN_RING_SHARE = 0.8  # least share of the returns that lie on rings

_BAND_RAD = np.deg2rad(0.1)  # height of a band of returns of about equal elevation
_MIN_GAP_RAD, _MAX_GAP_RAD = 1e-4, np.deg2rad(4.0)  # smaller gaps are noise, larger ones holes
_MIN_EVEN_SHARE = 0.5  # least share of even gaps along lines
_MIN_PER_COLUMN = 5  # least number of rays that show the spread of a column's firing times
_APART_RAD = 4 * np.pi  # shift between groups of angles, twice the range of angles
_AT_ONCE = 0.03  # greatest spread of a column's firing times, as a share of a sweep's duration

_NUM_WINDOWS = 5  # windows of 1, 3, 7, 15, 31 cells, for the density of an unordered scanner

BLOCK = 128  # number of points that a kernel moves together
PI, _HALF_PI = np.float32(np.pi), np.float32(0.5 * np.pi)
_HALF, ZERO = np.float32(0.5), np.float32(0)
# Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.47: arctan within 1e-5 rad, far
# less than a cell.
_A1, _A3, _A5, _A7, _A9 = (
    np.float32(a) for a in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
)


@inlined
def azimuth_of(x, y):  # type: ignore[no-untyped-def]
    """Return the azimuth of (x, y) in radians, positive to the left."""
    # The series is faster than the system's arctan2, and the same with every version of it.
    # It holds up to 45 degrees; symmetries give the other octants.
    ax, ay = abs(x), abs(y)
    is_steep = ay > ax
    ratio = ax / ay if is_steep else (ay / ax if ax > ZERO else ZERO)
    square = ratio * ratio
    angle = ratio * (_A1 + square * (_A3 + square * (_A5 + square * (_A7 + square * _A9))))
    if is_steep:
        angle = _HALF_PI - angle
    if x < ZERO:
        angle = PI - angle
    return -angle if y < ZERO else angle


@inlined
def move_to_time(x, y, z, time_s, twists):  # type: ignore[no-untyped-def]
    """Move a point from the reference time to the lidar frame at ``time_s``: undo deskewing."""
    # The inverse rotation of p = point - translation is p - r x p + r x (r x p) / 2 to second order
    # in the rotation vector r, which stays below 0.1 rad within a sweep.
    w = 0 if time_s < ZERO else 1
    rx, ry, rz = twists[w, 0] * time_s, twists[w, 1] * time_s, twists[w, 2] * time_s
    px, py, pz = x - twists[w, 3] * time_s, y - twists[w, 4] * time_s, z - twists[w, 5] * time_s
    tx, ty, tz = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px  # r x p
    return (
        px - tx + _HALF * (ry * tz - rz * ty),
        py - ty + _HALF * (rz * tx - rx * tz),
        pz - tz + _HALF * (rx * ty - ry * tx),
    )


@inlined
def move_to_scanner(x, y, z, size, origin, R):  # type: ignore[no-untyped-def]
    """Move ``size`` points from the lidar frame to the scanner's origin and axes R, in place."""
    for k in range(size):
        x[k], y[k], z[k] = x[k] - origin[0], y[k] - origin[1], z[k] - origin[2]
    if R[0, 0] + R[1, 1] + R[2, 2] < 3:  # not the identity
        for k in range(size):
            x[k], y[k], z[k] = (
                R[0, 0] * x[k] + R[0, 1] * y[k] + R[0, 2] * z[k],
                R[1, 0] * x[k] + R[1, 1] * y[k] + R[1, 2] * z[k],
                R[2, 0] * x[k] + R[2, 1] * y[k] + R[2, 2] * z[k],
            )


@Kernel
def aim(begin, end, points, offset_s, origin, axes, twists, rays):  # type: ignore[no-untyped-def]
    """Fill ``rays`` (3,N) with azimuth and elevation (rad) and range (m) of a scanner's points.

    Each point is moved to the scanner's frame at its firing time. All arrays are float32.

    Args:
        points: (N,3) positions in metres, lidar frame at the reference time.
        offset_s: (N,) firing times in seconds after the reference time.
        origin: (3,) position of the scanner in the lidar frame.
        axes: (3,3) rotation from the lidar frame to the scanner's axes.
        twists: (2,6) twist of the lidar before and after the reference time.
    """
    x, y, z = np.empty((3, BLOCK), np.float32)
    for start in range(begin, end, BLOCK):
        size = min(BLOCK, end - start)
        for k in range(size):
            i = start + k
            x[k], y[k], z[k] = move_to_time(
                points[i, 0], points[i, 1], points[i, 2], offset_s[i], twists
            )
        move_to_scanner(x, y, z, size, origin, axes)
        for k in range(size):
            horizontal_m = np.sqrt(x[k] * x[k] + y[k] * y[k])
            rays[0, start + k] = azimuth_of(x[k], y[k])
            rays[1, start + k] = azimuth_of(horizontal_m, z[k])
            rays[2, start + k] = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])


class AimedRays(NamedTuple):
    """The N rays of one scanner at their firing times, in its frame; (N,) float32 each."""

    azimuth: Float32  # azimuth in radians, positive to the left
    elevation: Float32  # elevation in radians, positive upwards
    range_m: Float32
    offset_s: Float32  # firing time in seconds after the reference time of the sweep


def aim_rays(registered: RegisteredSweep, lidar: int) -> AimedRays:
    """Return the rays of scanner number ``lidar``, each as it left at its own firing time."""
    sweep = registered.sweep
    rows = np.flatnonzero(sweep.lidar == lidar)
    offset_s = np.zeros(len(rows), np.float32)
    if sweep.offset_ns is not None:
        offset_s = (sweep.offset_ns[rows] * 1e-9).astype(np.float32)
    rays = np.empty((3, len(rows)), np.float32)
    aim.over_rows(
        len(rows),
        sweep.points.take(rows, axis=0).astype(np.float32),
        offset_s,
        sweep.origin_m(lidar).astype(np.float32),
        sweep.axes(lidar).astype(np.float32, order="C"),
        np.stack([registered.twist_before, registered.twist_after]).astype(np.float32),
        rays,
    )
    return AimedRays(rays[0], rays[1], rays[2], offset_s)


class RayTable(NamedTuple):
    """Angles (rad) between neighbouring rays, by B bins of elevation and C of azimuth, from -pi."""

    # Lowest elevation of bin 0. The outermost bins also stand for all elevations beyond.
    low_rad: float
    bin_rad: float  # height of a bin of elevation
    # (B,C) float32 angle between neighbouring rays of a ring: they differ in azimuth
    azimuth_gap_rad: Float32
    # (B,C) float32 angle between neighbouring rings: their rays differ in elevation
    elevation_gap_rad: Float32

    @staticmethod
    def by_elevation(
        low_rad: float, bin_rad: float, azimuth_gap_rad: Float, elevation_gap_rad: Float
    ) -> RayTable:
        """Return a table that depends on elevation alone, from the (B,) gaps of its B bins."""
        columns = (
            gap_rad[:, None].astype(np.float32) for gap_rad in (azimuth_gap_rad, elevation_gap_rad)
        )
        return RayTable(low_rad, float(bin_rad), *columns)

    def at(self, azimuth: NDArray[np.floating], elevation: NDArray[np.floating]) -> Float:
        """Return the (N,2) gaps in azimuth and in elevation at (N,) directions, in radians."""
        num_rows, num_columns = self.elevation_gap_rad.shape
        row = np.clip((elevation - self.low_rad) / self.bin_rad, 0, num_rows - 1).astype(np.int64)
        column = ((azimuth + np.pi) * (num_columns / (2 * np.pi))).astype(np.int64) % num_columns
        gaps_rad = [self.azimuth_gap_rad[row, column], self.elevation_gap_rad[row, column]]
        return np.stack(gaps_rad, 1).astype(np.float64)


@dataclass(frozen=True)
class Layout:
    """The pattern in which a scanner samples directions."""

    # (K,) elevation of every ring, ascending; None if there are no distinct rings
    rings_rad: Float | None
    # True if there are no lines either, or if the firing time does not follow the azimuth (solid
    # state, rosettes)
    unordered: bool
    azimuth_step_rad: float  # angle between rays of a ring or line, usual spacing if unordered
    table: RayTable  # angles between neighbouring rays by direction


def measure_layout(sweeps: Sequence[AimedRays]) -> Layout:
    """Return the layout of one scanner, measured in its rays of a few sweeps.

    Most returns of rings have one of a few elevations. Lasers that do not share an origin, as in
    KITTI's HDL-64E, mix their rings at close range, but their returns follow at even steps along
    the azimuth: lines. Scanners with neither are unordered. Fewer than 200 returns give the
    default, lines with the spacing of a 64-beam scanner.
    """
    if sum(len(rays.azimuth) for rays in sweeps) < FEW_POINTS:
        return _default_layout()
    sampled = [_select_sectors(rays) for rays in sweeps]

    rings = find_rings(np.concatenate([rays.elevation for rays in sampled]))
    if rings is not None:
        step_rad = float(np.median([_step_on_rings(rays, rings) for rays in sampled]))
        return Layout(rings, False, step_rad, _table_of_rings(rings, step_rad))

    step_rad, even_share = np.median([_even_step(rays) for rays in sampled], axis=0).tolist()
    if even_share >= _MIN_EVEN_SHARE and fires_by_azimuth(sampled[0]):
        return Layout(None, False, step_rad, _table_of_lines(sweeps, step_rad))

    table = _table_of_density(sweeps)
    azimuth_gap_rad = table.at(sweeps[0].azimuth, sweeps[0].elevation)[:, 0]
    return Layout(None, True, float(np.median(azimuth_gap_rad)), table)


def _default_layout() -> Layout:
    """Return lines with the spacing of a 64-beam scanner."""
    step_rad, gap_rad = _DEFAULT_RAD
    table = RayTable.by_elevation(0.0, 1.0, np.array([step_rad]), np.array([gap_rad]))
    return Layout(None, False, step_rad, table)


def find_rings(elevation: Float32) -> Float | None:
    """Return the (K,) ascending elevations of the rings, None if the returns are not on rings."""
    # The last bin but one holds the zenith; one more is spare for rounding.
    num_bins = int(np.pi / _RING_BIN_RAD) + 2
    bin_of_return = ((elevation + 0.5 * np.pi) / _RING_BIN_RAD).astype(np.int64)
    num_in_bin = np.bincount(bin_of_return, minlength=num_bins).astype(float)
    peaks = _find_peaks(ndimage.gaussian_filter1d(num_in_bin, 1.0))
    if not 3 <= len(peaks) <= len(elevation) / _MIN_NUM:
        return None

    # the middle of each peak's bin
    rings: Float = (peaks + 0.5) * _RING_BIN_RAD - 0.5 * np.pi
    ring = _nearest_ring(rings, elevation)
    is_close = np.abs(elevation - rings[ring]) < _EVEN * np.gradient(rings)[ring]
    if is_close.mean() < _MIN_RING_SHARE:
        return None
    sum_rad = np.bincount(ring[is_close], elevation[is_close].astype(float), len(rings))
    return sum_rad / np.bincount(ring[is_close], minlength=len(rings))


def _nearest_ring(rings: Float, elevation: Float32) -> Int:
    """Return the (N,) index of the ring (K,) nearest to each elevation."""
    return np.searchsorted(0.5 * (rings[1:] + rings[:-1]), elevation)


def _find_peaks(counts: Float) -> Int:
    """Return the indices of maxima (ascending) with a valley of half their height between them."""
    peaks = []
    highest = lowest = 0  # indices of the highest count of this rise, and the lowest of this fall
    is_rising = True
    for i, count in enumerate(counts.tolist()):
        if is_rising and count > counts[highest]:
            highest = i
        elif is_rising and count < _VALLEY * counts[highest]:
            peaks.append(highest)
            lowest = i
            is_rising = False
        elif not is_rising and count < counts[lowest]:
            lowest = i
        elif not is_rising and _VALLEY * count > counts[lowest]:
            highest = i
            is_rising = True
    return np.array(peaks, np.int64)


def fires_by_azimuth(rays: AimedRays) -> bool:
    """Return True if rays of the same azimuth are fired at nearly one time, or have no times."""
    duration_s = float(np.ptp(rays.offset_s)) if len(rays.offset_s) else 0.0
    if duration_s == 0.0:
        return True
    column = ((rays.azimuth + np.pi) / _CELL_RAD).astype(np.int64)
    num_rays = np.bincount(column)
    mean_s = np.bincount(column, rays.offset_s) / np.maximum(num_rays, 1)
    sum_squares = np.bincount(column, (rays.offset_s - mean_s[column]) ** 2)
    spread_s = np.sqrt(sum_squares / np.maximum(num_rays, 1))[num_rays >= _MIN_PER_COLUMN]
    # Most columns decide: at the seam between two turns a column has two times.
    return not len(spread_s) or bool(np.mean(spread_s < _AT_ONCE * duration_s) > 0.5)


def _select_sectors(rays: AimedRays) -> AimedRays:
    """Return every fourth sector of many rays, which is enough to measure a layout."""
    if len(rays.azimuth) > _MANY_POINTS:
        is_sampled = np.floor(rays.azimuth / _SECTOR_RAD) % 4 == 0
        if is_sampled.mean() > 0.1:  # a narrow view may miss these sectors
            return AimedRays(*(column[is_sampled] for column in rays))
    return rays


def _sort_in_groups(group: NDArray[Any], angle: Float32) -> Float:
    """Return the angles in ascending order, each shifted by its group's number of `_APART_RAD`."""
    return np.sort(group * _APART_RAD + angle.astype(np.float64))


def _gaps_in_groups(group: NDArray[Any], angle: Float32) -> Float:
    """Return the differences between neighbouring angles of the same group."""
    gap_rad: Float = np.diff(_sort_in_groups(group, angle))
    return gap_rad[gap_rad < 2 * np.pi]  # larger gaps are between two groups


def _step_on_rings(rays: AimedRays, rings: Float) -> float:
    """Return the median azimuth difference (rad) between neighbours on a ring."""
    gap_rad = _gaps_in_groups(_nearest_ring(rings, rays.elevation), rays.azimuth)
    gap_rad = gap_rad[gap_rad > _RING_BIN_RAD]  # not between two returns of one ray
    return float(np.median(gap_rad)) if len(gap_rad) else _DEFAULT_RAD[0]


def _even_step(rays: AimedRays) -> tuple[float, float]:
    """Return the median azimuth gap (rad) at about equal elevation, and the share close to it."""
    gap_rad = _gaps_in_groups(np.floor(rays.elevation / _BAND_RAD), rays.azimuth)
    gap_rad = gap_rad[gap_rad > _MIN_GAP_RAD]
    if not len(gap_rad):
        return _DEFAULT_RAD[0], 0.0
    usual_rad = float(np.median(gap_rad))
    # The share is more than half for a spinning scanner, and a fifth for scattered returns.
    return usual_rad, float(np.mean(np.abs(gap_rad - usual_rad) < _EVEN * usual_rad))


def _table_of_rings(rings: Float, step_rad: float) -> RayTable:
    """Return the table whose spacing at a ring is the mean distance to both neighbouring rings."""
    low_rad = float(rings[0]) - _CELL_RAD  # with a margin beyond the outermost rings
    num_bins = int((float(rings[-1]) + _CELL_RAD - low_rad) / _RING_BIN_RAD) + 1
    elevation = _bin_middles(low_rad, _RING_BIN_RAD, num_bins)
    gap_rad = np.interp(elevation, rings, np.gradient(rings, edge_order=1))
    # A step of azimuth is shorter on the sphere by the cosine of the elevation.
    return RayTable.by_elevation(low_rad, _RING_BIN_RAD, step_rad * np.cos(elevation), gap_rad)


def _bin_middles(low_rad: float, bin_rad: float, num_bins: int) -> Float:
    """Return the (num_bins,) elevations in the middle of each bin."""
    return np.asarray(low_rad + (np.arange(num_bins) + 0.5) * bin_rad, np.float64)


def _table_of_lines(sweeps: Sequence[AimedRays], step_rad: float) -> RayTable:
    """Return the table of median elevation differences within sectors of 1 degree, by elevation."""
    gaps = [_line_gaps(rays, step_rad) for rays in sweeps]
    size_rad = np.concatenate([sweep_gaps.size_rad for sweep_gaps in gaps])
    middle_rad = np.concatenate([sweep_gaps.middle_rad for sweep_gaps in gaps])

    # one bin below the lowest ray and one above the highest, with their own gaps unknown
    low_rad = float(min(rays.elevation.min() for rays in sweeps)) - _LINE_BIN_RAD
    high_rad = float(max(rays.elevation.max() for rays in sweeps)) + _LINE_BIN_RAD
    num_bins = int((high_rad - low_rad) / _LINE_BIN_RAD) + 2
    bin_of_gap = ((middle_rad - low_rad) / _LINE_BIN_RAD).astype(np.int64)
    full_bins = np.flatnonzero(np.bincount(bin_of_gap, minlength=num_bins) >= _MIN_NUM)
    gap_rad = np.full(num_bins, _DEFAULT_RAD[1])
    if len(full_bins):
        medians_rad = ndimage.median(size_rad, bin_of_gap, full_bins)
        gap_rad = np.interp(np.arange(num_bins), full_bins, medians_rad)
    elevation = _bin_middles(low_rad, _LINE_BIN_RAD, num_bins)
    return RayTable.by_elevation(low_rad, _LINE_BIN_RAD, step_rad * np.cos(elevation), gap_rad)


class _LineGaps(NamedTuple):
    """The G gaps in elevation between neighbouring lines of a sweep."""

    size_rad: Float  # (G,) elevation difference
    middle_rad: Float  # (G,) elevation in the middle of the gap


def _line_gaps(rays: AimedRays, step_rad: float) -> _LineGaps:
    """Return the gaps between lines, measured within each sector of 1 degree of azimuth."""
    # Each elevation is shifted by a multiple of `_APART_RAD`, the number of its sector.
    shifted_rad = _sort_in_groups(np.floor(rays.azimuth / _CELL_RAD), rays.elevation)
    gap_rad = np.diff(shifted_rad)
    # A wide gap is due to missing returns or lies between two sectors. A gap below half a step of
    # azimuth lies within one line.
    is_gap = (gap_rad < _MAX_GAP_RAD) & (gap_rad > max(step_rad / 2, _MIN_GAP_RAD))
    size_rad = gap_rad[is_gap]
    shifted_middle_rad = shifted_rad[:-1][is_gap] + size_rad / 2
    # Elevations are small against the shift. The nearest multiple of it is therefore the shift.
    shift_rad = _APART_RAD * np.rint(shifted_middle_rad / _APART_RAD)
    return _LineGaps(size_rad, shifted_middle_rad - shift_rad)


def _table_of_density(sweeps: Sequence[AimedRays]) -> RayTable:
    """Return the table of the side of the square that a return has to itself, by direction."""
    low_rad = float(min(rays.elevation.min() for rays in sweeps))
    high_rad = float(max(rays.elevation.max() for rays in sweeps))
    num_rows = int((high_rad - low_rad) / _CELL_RAD) + 1
    num_columns = round(2 * np.pi / _CELL_RAD)
    num_returns = np.zeros((num_rows, num_columns))
    for rays in sweeps:
        row = ((rays.elevation - low_rad) / _CELL_RAD).astype(np.int64)
        column = ((rays.azimuth + np.pi) / _CELL_RAD).astype(np.int64) % num_columns
        np.add.at(num_returns, (row, column), 1)

    # Single empty cells between others are in view, too.
    is_filled = num_returns > 0
    in_view = ndimage.binary_closing(np.pad(is_filled, 1))[1:-1, 1:-1] | is_filled
    elevation = _bin_middles(low_rad, _CELL_RAD, num_rows)
    cell_sr = _CELL_RAD**2 * np.cos(elevation)[:, None] * in_view
    density = _density_in_windows(num_returns, cell_sr)

    # Cells without a density take the spacing of the nearest cell with one.
    has_density = in_view & (density > 0)
    spacing_rad = np.sqrt(len(sweeps) / np.where(has_density, density, 1.0))
    nearest_cell = ndimage.distance_transform_edt(~has_density, return_indices=True)[1]
    spacing_rad = spacing_rad[tuple(nearest_cell)].astype(np.float32)
    return RayTable(low_rad, float(_CELL_RAD), spacing_rad, spacing_rad)


def _density_in_windows(num_returns: Float, cell_sr: Float) -> Float:
    """Return the (R,C) returns per steradian in the smallest window that holds enough returns."""
    density = np.zeros(num_returns.shape)
    # From the largest window, which always counts, to a single cell: smaller windows overwrite.
    for k in range(_NUM_WINDOWS, 0, -1):
        side = 2**k - 1  # 31, 15, 7, 3, 1 cells
        num_in_window = _sum_in_windows(num_returns, side)
        window_sr = _sum_in_windows(cell_sr, side)
        is_enough = (num_in_window >= _MIN_NUM) | (k == _NUM_WINDOWS)
        window_density = num_in_window / np.maximum(window_sr, 1e-12)
        density = np.where(is_enough & (window_sr > 0), window_density, density)
    return density


def _sum_in_windows(values: Float, side: int) -> Float:
    """Return the sums of values (R,C) over square windows. The azimuth wraps around."""
    mean: Float = ndimage.uniform_filter(values, side, mode=("constant", "wrap"))
    return mean * side**2
