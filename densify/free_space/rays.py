# SPDX-License-Identifier: MIT
"""Measure the rays of a scanner, and how they sample directions: in rings, lines, or unordered.

Only in the scanner's frame at the firing time do the returns form rings. Angles are in radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Float, Float32, Int, RegisteredSweep

FEW_POINTS = 200  # too few to measure anything
_DEFAULT_RAD = tuple(np.deg2rad([0.18, 0.40]))  # of a 64-beam scanner, along and between its rings
_MANY_POINTS, _SECTOR_RAD = 15_000, np.deg2rad(5.0)  # of these, every fourth sector is enough

# Bins of elevation in which rings and lines are found; cells of direction, and columns of azimuth
_RING_BIN_RAD, _LINE_BIN_RAD, _CELL_RAD = np.deg2rad([0.02, 0.5, 1.0])
_MIN_NUM = 24  # returns or gaps that give a mean: of a ring, of a bin, of a cell
_EVEN = 0.2  # share of the usual gap by which a ray may be off its place
_VALLEY = 0.5  # greatest count between two rings, as a share of both peaks
_MIN_RING_SHARE = 0.8  # of the returns are on rings

_BAND_RAD = np.deg2rad(0.1)  # returns of about equal elevation
_MIN_GAP_RAD, _MAX_GAP_RAD = 1e-4, np.deg2rad(4.0)
_MIN_EVEN_SHARE = 0.5  # of the gaps along lines are even
_MIN_PER_COLUMN = 5
_APART_RAD = 4 * np.pi  # more than twice the range of angles
_AT_ONCE = 0.03  # share of the duration of a sweep

_NUM_WINDOWS = 5  # of 1, 3, 7, 15, 31 cells, for the density of an unordered scanner

BLOCK = 128  # points that a kernel moves together
_PI, _HALF_PI = np.float32(np.pi), np.float32(0.5 * np.pi)
_HALF, _ZERO = np.float32(0.5), np.float32(0)
# Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.47: arctan within 1e-5 rad, far
# less than a cell.
_A1, _A3, _A5, _A7, _A9 = (
    np.float32(a) for a in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
)


@inlined
def azimuth_of(x, y):  # type: ignore[no-untyped-def]
    """Return the azimuth of (x, y) in radians, positive to the left."""
    # The series is faster than the system's arctan2, and the same with every version of it.
    ax, ay = abs(x), abs(y)
    steep = ay > ax
    ratio = ax / ay if steep else (ay / ax if ax > _ZERO else _ZERO)
    square = ratio * ratio
    angle = ratio * (_A1 + square * (_A3 + square * (_A5 + square * (_A7 + square * _A9))))
    if steep:
        angle = _HALF_PI - angle
    if x < _ZERO:
        angle = _PI - angle
    return -angle if y < _ZERO else angle


@inlined
def at_time(x, y, z, time_s, twists):  # type: ignore[no-untyped-def]
    """Move a point from the reference time to the lidar frame at ``time_s``: undo deskewing."""
    # The rotation is taken to second order, because within a sweep it stays below 0.1 rad.
    w = 0 if time_s < _ZERO else 1
    rx, ry, rz = twists[w, 0] * time_s, twists[w, 1] * time_s, twists[w, 2] * time_s
    px, py, pz = x - twists[w, 3] * time_s, y - twists[w, 4] * time_s, z - twists[w, 5] * time_s
    tx, ty, tz = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px
    return (
        px - tx + _HALF * (ry * tz - rz * ty),
        py - ty + _HALF * (rz * tx - rx * tz),
        pz - tz + _HALF * (rx * ty - ry * tx),
    )


@inlined
def from_scanner(x, y, z, size, origin, R):  # type: ignore[no-untyped-def]
    """Move ``size`` points from the lidar frame to the scanner's origin and axes R, in place."""
    for k in range(size):
        x[k], y[k], z[k] = x[k] - origin[0], y[k] - origin[1], z[k] - origin[2]
    if R[0, 0] + R[1, 1] + R[2, 2] < 3:
        for k in range(size):
            x[k], y[k], z[k] = (
                R[0, 0] * x[k] + R[0, 1] * y[k] + R[0, 2] * z[k],
                R[1, 0] * x[k] + R[1, 1] * y[k] + R[1, 2] * z[k],
                R[2, 0] * x[k] + R[2, 1] * y[k] + R[2, 2] * z[k],
            )


@Kernel
def aim(begin, end, points, offset_s, origin, axes, twists, rays):  # type: ignore[no-untyped-def]
    """Fill ``rays`` (3,N) with azimuth and elevation (rad) and range (m) of a scanner's points.

    Each deskewed point is moved to the scanner's frame at its firing time. All arrays are float32.

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
            x[k], y[k], z[k] = at_time(
                points[i, 0], points[i, 1], points[i, 2], offset_s[i], twists
            )
        from_scanner(x, y, z, size, origin, axes)
        for k in range(size):
            horizontal_m = np.sqrt(x[k] * x[k] + y[k] * y[k])
            rays[0, start + k] = azimuth_of(x[k], y[k])
            rays[1, start + k] = azimuth_of(horizontal_m, z[k])
            rays[2, start + k] = np.sqrt(horizontal_m * horizontal_m + z[k] * z[k])


class Aimed(NamedTuple):
    """The N rays of one scanner at their firing times, in its frame; (N,) float32 each."""

    azimuth: Float32  # azimuth in radians, positive to the left
    elevation: Float32  # elevation in radians, positive upwards
    range_m: Float32
    offset_s: Float32  # firing time in seconds after the reference time of the sweep


def aimed(registered: RegisteredSweep, lidar: int) -> Aimed:
    """Return the rays of one scanner, with deskewing undone."""
    sweep, rows = registered.sweep, np.flatnonzero(registered.sweep.lidar == lidar)
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
    return Aimed(rays[0], rays[1], rays[2], offset_s)


class RayTable(NamedTuple):
    """Angles between neighbouring rays in B bins of elevation by C bins of azimuth, radians."""

    # Lowest elevation of bin 0. The outermost bins also stand for all elevations beyond.
    low_rad: float
    bin_rad: float  # height of a bin of elevation
    across: Float32  # (B,C) float32 angle between rays along the azimuth
    # (B,C) float32 angle between rays along the elevation. Bins of azimuth start at -pi; C is 1 if
    # the azimuth does not matter.
    along: Float32

    @staticmethod
    def by_elevation(low_rad: float, bin_rad: float, across: Float, along: Float) -> RayTable:
        """Return the table of the angles (B,) ``across`` and ``along`` of each bin of elevation."""
        columns = (column[:, None].astype(np.float32) for column in (across, along))
        return RayTable(low_rad, float(bin_rad), *columns)

    def at(self, azimuth: NDArray[np.floating], elevation: NDArray[np.floating]) -> Float:
        """Return the (N,2) angles ``across`` and ``along`` at N directions in radians."""
        rows, columns = self.along.shape
        row = np.clip((elevation - self.low_rad) / self.bin_rad, 0, rows - 1).astype(np.int64)
        column = ((azimuth + np.pi) * (columns / (2 * np.pi))).astype(np.int64) % columns
        return np.stack([self.across[row, column], self.along[row, column]], 1).astype(np.float64)


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


def measure(sweeps: Sequence[Aimed]) -> Layout:
    """Return the layout of one scanner, measured in its rays of a few sweeps.

    Lasers that do not share an origin, as in KITTI's HDL-64E, mix their rings at close range. Their
    returns still follow at even steps along the azimuth: such a scanner samples in lines.
    """
    if sum(len(rays.azimuth) for rays in sweeps) < FEW_POINTS:
        step, along = _DEFAULT_RAD
        return Layout(
            None, False, step, RayTable.by_elevation(0.0, 1.0, np.array([step]), np.array([along]))
        )
    sampled = [_some_sectors(rays) for rays in sweeps]
    rings = find_rings(np.concatenate([rays.elevation for rays in sampled]))
    if rings is not None:
        step = float(np.median([_step_along(rays, rings) for rays in sampled]))
        return Layout(rings, False, step, _table_of_rings(rings, step))
    step, even_share = np.median([_even_step(rays) for rays in sampled], axis=0).tolist()
    if even_share >= _MIN_EVEN_SHARE and fires_by_azimuth(sampled[0]):
        return Layout(None, False, step, _table_of_lines(sweeps, step))
    table = _table_of_density(sweeps)
    step = float(np.median(table.at(sweeps[0].azimuth, sweeps[0].elevation)[:, 0]))
    return Layout(None, True, step, table)


def find_rings(elevation: Float32) -> Float | None:
    """Return the (K,) ascending elevations of the rings, None if the returns are not on rings.

    Merged scanners, processed clouds, and lasers that do not share an origin have none. Rings are
    separate peaks of a fine histogram of (N,) elevations that hold nearly all returns. Each ring is
    the mean elevation of the returns close to it.
    """
    of_return = ((elevation + 0.5 * np.pi) / _RING_BIN_RAD).astype(np.int64)
    returns = np.bincount(of_return, minlength=int(np.pi / _RING_BIN_RAD) + 2).astype(float)
    count = ndimage.gaussian_filter1d(returns, 1.0)
    peaks = _peaks(count)
    if not 3 <= len(peaks) <= len(elevation) / _MIN_NUM:
        return None
    rings: Float = (peaks + 0.5) * _RING_BIN_RAD - 0.5 * np.pi
    nearest = np.searchsorted(0.5 * (rings[1:] + rings[:-1]), elevation)
    close = np.abs(elevation - rings[nearest]) < _EVEN * np.gradient(rings)[nearest]
    if close.mean() < _MIN_RING_SHARE:
        return None
    total = np.bincount(nearest[close], elevation[close].astype(float), len(rings))
    return total / np.bincount(nearest[close], minlength=len(rings))


def _peaks(count: Float) -> Int:
    """Return the indices of maxima (ascending) with a valley of half their height between them."""
    peaks, top, bottom, rises = [], 0, 0, True
    for i, num in enumerate(count.tolist()):
        if rises and num > count[top]:
            top = i
        elif rises and num < _VALLEY * count[top]:
            peaks.append(top)
            bottom, rises = i, False
        elif not rises and num < count[bottom]:
            bottom = i
        elif not rises and _VALLEY * num > count[bottom]:
            top, rises = i, True
    return np.array(peaks, np.int64)


def fires_by_azimuth(rays: Aimed) -> bool:
    """Return True if rays of the same azimuth are fired at nearly one time, or have no times."""
    duration_s = float(np.ptp(rays.offset_s)) if len(rays.offset_s) else 0.0
    if duration_s == 0.0:
        return True
    column = ((rays.azimuth + np.pi) / _CELL_RAD).astype(np.int64)
    num = np.bincount(column)
    mean_s = np.bincount(column, rays.offset_s) / np.maximum(num, 1)
    square = np.bincount(column, (rays.offset_s - mean_s[column]) ** 2)
    spread_s = np.sqrt(square / np.maximum(num, 1))[num >= _MIN_PER_COLUMN]
    return not len(spread_s) or bool(np.mean(spread_s < _AT_ONCE * duration_s) > 0.5)


def _some_sectors(rays: Aimed) -> Aimed:
    """Return every fourth sector of an all-round view, which is enough evidence."""
    if len(rays.azimuth) > _MANY_POINTS:
        in_sector = np.floor(rays.azimuth / _SECTOR_RAD) % 4 == 0
        if in_sector.mean() > 0.1:
            return Aimed(*(column[in_sector] for column in rays))
    return rays


def _in_groups(group: NDArray[Any], angle: Float32) -> Float:
    """Return the angles in ascending order, group by group, with large gaps between groups."""
    return np.sort(group * _APART_RAD + angle.astype(np.float64))


def _gaps(group: NDArray[Any], angle: Float32) -> Float:
    """Return the differences between neighbouring angles of the same group, see `_in_groups`."""
    gaps: Float = np.diff(_in_groups(group, angle))
    return gaps[gaps < 2 * np.pi]


def _step_along(rays: Aimed, rings: Float) -> float:
    """Return the median azimuth difference between neighbours on a ring."""
    ring = np.searchsorted(0.5 * (rings[1:] + rings[:-1]), rays.elevation)
    along = _gaps(ring, rays.azimuth)
    along = along[along > _RING_BIN_RAD]
    return float(np.median(along)) if len(along) else _DEFAULT_RAD[0]


def _even_step(rays: Aimed) -> tuple[float, float]:
    """Return the usual azimuth step of returns of about equal elevation, and its share of them."""
    gap = _gaps(np.floor(rays.elevation / _BAND_RAD), rays.azimuth)
    gap = gap[gap > _MIN_GAP_RAD]
    if not len(gap):
        return _DEFAULT_RAD[0], 0.0
    usual = float(np.median(gap))
    # The share is more than half for a spinning scanner, and a fifth for scattered returns.
    return usual, float(np.mean(np.abs(gap - usual) < _EVEN * usual))


def _table_of_rings(rings: Float, step_rad: float) -> RayTable:
    """Return the table whose spacing at a ring is the mean distance to both neighbouring rings."""
    low = float(rings[0]) - _CELL_RAD
    num_bins = int((float(rings[-1]) + _CELL_RAD - low) / _RING_BIN_RAD) + 1
    elevation = low + (np.arange(num_bins) + 0.5) * _RING_BIN_RAD
    along = np.interp(elevation, rings, np.gradient(rings, edge_order=1))
    return RayTable.by_elevation(low, _RING_BIN_RAD, step_rad * np.cos(elevation), along)


def _table_of_lines(sweeps: Sequence[Aimed], step_rad: float) -> RayTable:
    """Return the table of median elevation differences within sectors of 1 degree, by elevation."""
    gaps, middles = [], []
    for rays in sweeps:
        ordered = _in_groups(np.floor(rays.azimuth / _CELL_RAD), rays.elevation)
        gap = np.diff(ordered)
        # not across missing returns, and not within one line
        kept = (gap < _MAX_GAP_RAD) & (gap > max(step_rad / 2, _MIN_GAP_RAD))
        gaps.append(gap[kept])
        middle = ordered[:-1][kept] + gap[kept] / 2
        middles.append(middle - _APART_RAD * np.rint(middle / _APART_RAD))
    low = float(min(r.elevation.min() for r in sweeps)) - _LINE_BIN_RAD
    high = float(max(r.elevation.max() for r in sweeps)) + _LINE_BIN_RAD
    num_bins = int((high - low) / _LINE_BIN_RAD) + 2
    in_bin = ((np.concatenate(middles) - low) / _LINE_BIN_RAD).astype(np.int64)
    bins = np.flatnonzero(np.bincount(in_bin, minlength=num_bins) >= _MIN_NUM)
    along = np.full(num_bins, _DEFAULT_RAD[1])
    if len(bins):
        medians = ndimage.median(np.concatenate(gaps), in_bin, bins)
        along = np.interp(np.arange(num_bins), bins, medians)
    elevation = low + (np.arange(num_bins) + 0.5) * _LINE_BIN_RAD
    return RayTable.by_elevation(low, _LINE_BIN_RAD, step_rad * np.cos(elevation), along)


def _table_of_density(sweeps: Sequence[Aimed]) -> RayTable:
    """Return the table of the side of the square that a return has to itself, by direction."""
    # Returns are counted in the smallest window around each cell of a degree that holds enough.
    low = float(min(r.elevation.min() for r in sweeps))
    rows = int((float(max(r.elevation.max() for r in sweeps)) - low) / _CELL_RAD) + 1
    columns = round(2 * np.pi / _CELL_RAD)
    count = np.zeros((rows, columns))
    for rays in sweeps:
        row = ((rays.elevation - low) / _CELL_RAD).astype(np.int64)
        column = ((rays.azimuth + np.pi) / _CELL_RAD).astype(np.int64) % columns
        np.add.at(count, (row, column), 1)
    in_view = ndimage.binary_closing(np.pad(count > 0, 1))[1:-1, 1:-1] | (count > 0)
    cell_sr = _CELL_RAD**2 * np.cos(low + (np.arange(rows) + 0.5) * _CELL_RAD)[:, None] * in_view
    density = np.zeros((rows, columns))
    for k in range(_NUM_WINDOWS, 0, -1):
        num_in_window, sr = (_in_windows(values, 2**k - 1) for values in (count, cell_sr))
        enough = (num_in_window >= _MIN_NUM) | (k == _NUM_WINDOWS)
        density = np.where(enough & (sr > 0), num_in_window / np.maximum(sr, 1e-12), density)
    known = in_view & (density > 0)
    spacing = np.sqrt(len(sweeps) / np.where(known, density, 1.0))
    nearest = ndimage.distance_transform_edt(~known, return_indices=True)[1]
    spacing = spacing[tuple(nearest)].astype(np.float32)
    return RayTable(low, float(_CELL_RAD), spacing, spacing)


def _in_windows(values: Float, cells: int) -> Float:
    """Return the sums of values (R,C) over square windows. The azimuth wraps around."""
    mean: Float = ndimage.uniform_filter(values, cells, mode=("constant", "wrap"))
    return mean * cells**2
