# SPDX-License-Identifier: MIT
"""Measure scanners in their sweeps: position, field of view, and the pattern of their rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float, Float32, Int, RegisteredSweep

FEW_POINTS = 200  # with fewer returns nothing can be measured
_DEFAULT_RAD = tuple(np.deg2rad([0.18, 0.40]))  # gaps of a 64-beam scanner: on a ring, to the next
# Heights of the bins of elevation in which rings and lines are found; side of a cell of direction
_RING_BIN_RAD, _LINE_BIN_RAD, _CELL_RAD = np.deg2rad([0.02, 0.5, 1.0])
_MIN_NUM = 24  # least number of returns or gaps for a mean in a ring, a bin or a cell
_EVEN = 0.2  # greatest deviation of a ray from an even spacing, as a share of the usual gap
_MIN_GAP_RAD = 1e-4  # smaller gaps are noise
_APART_RAD = 4 * np.pi  # shift between groups of angles, twice the range of angles

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
    """Return the azimuth of (x, y) in radians, -pi to pi, positive to the left."""
    # The series is faster than the system's arctan2, and does not change with the system's version.
    # The series holds up to 45 degrees. Symmetries give the other octants.
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
def _aim(begin, end, points, offset_s, origin, axes, twists, rays):  # type: ignore[no-untyped-def]
    """Fill ``rays`` (3,N) with azimuth and elevation (rad) and range (m) of points (N,3).

    Each point is moved from the lidar frame at the reference time to the scanner's frame at its
    firing time, ``offset_s`` (N,) after the reference time. All arrays are float32.
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
    """Return the rays of scanner number ``lidar``, each in its frame at the ray's firing time."""
    sweep = registered.sweep
    rows = np.flatnonzero(sweep.lidar == lidar)
    offset_s = np.zeros(len(rows), np.float32)
    if sweep.offset_ns is not None:
        offset_s = (sweep.offset_ns[rows] * 1e-9).astype(np.float32)
    rays = np.empty((3, len(rows)), np.float32)
    _aim.over_rows(
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

    def at(self, azimuth: NDArray[np.floating], elevation: NDArray[np.floating]) -> Float:
        """Return the gaps (N,2) in azimuth and in elevation at N directions, all in radians."""
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


class RayGrid(NamedTuple):
    """Directions in cells of about one ray each; columns go left from azimuth -pi, rows up."""

    low_rad: float  # lowest elevation of the first bin
    bin_rad: float  # height of a bin of elevation
    row_of: Float  # (B+1,) number of rows below each border of a bin, may be a fraction
    num_rows: int
    num_columns: int


@dataclass(frozen=True)
class SensorModel(Layout):
    """One scanner, with its pattern of rays."""

    origin_m: Float  # (3,) origin of its rays, lidar frame
    axes: Float  # (3,3) rotation from the lidar frame to the scanner's axes
    elevation_rad: tuple[float, float]  # (2,) elevations of the lowest and the highest ray
    # (2,) azimuths of the rightmost and the leftmost ray: -pi and pi for an all-round view, right >
    # left if the view includes the backward direction
    azimuth_rad: tuple[float, float]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep], lidar: int) -> SensorModel:
        """Return the model of scanner number ``lidar``, measured in up to three deskewed sweeps."""
        with_returns = [
            registered for registered in sweeps if (registered.sweep.lidar == lidar).any()
        ]
        # The middle sweep of each third of the sweeps with returns, for different surroundings
        middles = (np.arange(3) + 0.5) * len(with_returns) / 3
        sampled = [with_returns[index] for index in np.unique(middles.astype(int))]
        rays_of_sweep = [aim_rays(registered, lidar) for registered in sampled]
        elevation = np.concatenate([rays.elevation for rays in rays_of_sweep])
        azimuth = np.concatenate([rays.azimuth for rays in rays_of_sweep])
        return SensorModel(
            **vars(measure_layout(rays_of_sweep)),
            origin_m=sampled[0].sweep.origin_m(lidar),
            axes=sampled[0].sweep.axes(lidar),
            elevation_rad=(float(elevation.min()), float(elevation.max())),
            azimuth_rad=_find_view(azimuth),
        )

    @property
    def grid(self) -> RayGrid:
        """The grid of directions: a row for each ring or line, square cells for unordered rays."""
        low_rad, bin_rad, _, gap_rad = self.table
        if self.unordered:
            # A row for each bin, and cells as small as the closest rays. The densest 5 % of the
            # directions are left out: their spacing is measured in few returns.
            side_rad = float(np.percentile(gap_rad, 5))
            num_rows = int((self.elevation_rad[1] - low_rad) / side_rad) + 1
            num_columns = round(2 * np.pi / side_rad)
            return RayGrid(low_rad, side_rad, np.arange(num_rows + 1.0), num_rows, num_columns)
        if self.rings_rad is None:
            row_of = np.append(0.0, np.cumsum(bin_rad / gap_rad[:, 0].astype(np.float64)))
        else:
            # A ring lies in the middle of its row, half a row above the row's lower border.
            borders_rad = low_rad + bin_rad * np.arange(len(gap_rad) + 1)
            row_of = 0.5 + np.interp(borders_rad, self.rings_rad, np.arange(len(self.rings_rad)))
        # The row at the last border, counted from 0, and one row for directions above it
        num_rows = int(row_of[-1]) + 2
        return RayGrid(low_rad, bin_rad, row_of, num_rows, round(2 * np.pi / self.azimuth_step_rad))

    def sees(self, azimuth: Float, elevation: Float) -> Bool:
        """Return the mask (N,) of directions, in radians, within the scanner's field of view."""
        right, left = self.azimuth_rad
        # Both angles are counted to the left from the right end.
        in_view = (azimuth - right) % (2 * np.pi) <= (left - right) % (2 * np.pi)
        if left - right >= 2 * np.pi:  # all round, where the width modulo 2 pi is 0
            in_view[:] = True
        low, high = self.elevation_rad
        return in_view & (elevation >= low) & (elevation <= high)

    def gap_m(self, points: Float) -> tuple[Float, Bool]:
        """Return the gap from points (N,3), lidar frame, to the next ring, and which are in view.

        Returns:
            gap_m: (N,) metres at the point's range: spacing of rings or rays, plus a beam's width.
            in_view: (N,) True for points within the field of view.
        """
        ray = points - self.origin_m
        is_turned = not np.array_equal(self.axes, np.eye(3))
        x, y, z = (ray @ self.axes.T if is_turned else ray).T
        horizontal_m = np.hypot(x, y)
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, horizontal_m)
        # Most beams are 3 mrad, a sixth of a degree, wide.
        gap_rad = self.table.at(azimuth, elevation)[:, 1] + np.deg2rad(1 / 6)
        return np.hypot(horizontal_m, z) * gap_rad, self.sees(azimuth, elevation)


@dataclass(frozen=True)
class Sensors:
    """The scanners of a recording, by their number in `densify.geometry.types.Sweep.lidar`."""

    models: Mapping[int, SensorModel]

    @staticmethod
    def of(sweeps: Sequence[RegisteredSweep]) -> Sensors:
        """Return the models of all scanners that have returns in the deskewed sweeps."""
        numbers = np.unique([n for s in sweeps for n in np.unique(s.sweep.lidar)]).tolist()
        return Sensors({number: SensorModel.of(sweeps, number) for number in numbers})

    @property
    def origins_m(self) -> Float:
        """The (S,3) origins by scanner number, lidar frame; zeros for numbers without a scanner."""
        origins_m = np.zeros((1 + max(self.models, default=0), 3))
        for number, model in self.models.items():
            origins_m[number] = model.origin_m
        return origins_m

    def gap_m(self, points: Float, lidar: NDArray[np.uint8]) -> Float:
        """Return gaps (N,) in m from points, lidar frame, to the next ring of their scanners."""
        gap_m = np.zeros(len(points))
        for number, model in self.models.items():
            rows = np.flatnonzero(lidar == number)
            gap_m[rows] = model.gap_m(points[rows])[0]
        return gap_m

    def finest_gap_m(self, points: Float) -> Float:
        """Return the distances (N,) in m from points, lidar frame, to the next ring of any scanner.

        Only scanners with the point in view count. A point out of view gets the largest distance.
        """
        gaps_m, in_view = zip(*(model.gap_m(points) for model in self.models.values()), strict=True)
        finest_m = np.where(in_view, gaps_m, np.inf).min(axis=0)
        return np.where(np.isfinite(finest_m), finest_m, np.max(gaps_m, axis=0))


def _find_view(azimuth: Float32) -> tuple[float, float]:
    """Return the azimuths (rad) of the right and left end of the field of view of rays (N,)."""
    angles = np.unique(azimuth).astype(np.float64)
    gap_rad = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(np.argmax(gap_rad))
    if gap_rad[widest] < np.pi / 4:  # a building can cause it: the view is all round
        return -np.pi, np.pi
    # The view begins to the left of the widest gap, and ends at the gap's right side.
    return float(angles[(widest + 1) % len(angles)]), float(angles[widest])


def measure_layout(sweeps: Sequence[AimedRays]) -> Layout:
    """Return the layout of one scanner, measured in the rays of a few sweeps.

    Most returns of rings have one of a few elevations. Lasers that do not share an origin, as in
    KITTI's HDL-64E, mix their rings at close range, but their returns follow at even steps along
    the azimuth: lines. A scanner without rings and lines is unordered. Fewer than 200 returns give
    the default, lines with the spacing of a 64-beam scanner.
    """
    if sum(len(rays.azimuth) for rays in sweeps) < FEW_POINTS:
        gaps_rad = (np.full((1, 1), gap_rad, np.float32) for gap_rad in _DEFAULT_RAD)
        return Layout(None, False, _DEFAULT_RAD[0], RayTable(0.0, 1.0, *gaps_rad))
    sampled = [_select_sectors(rays) for rays in sweeps]

    rings = find_rings(np.concatenate([rays.elevation for rays in sampled]))
    if rings is not None:
        step_rad = float(np.median([_step_on_rings(rays, rings) for rays in sampled]))
        return Layout(rings, False, step_rad, _table_of_rings(rings, step_rad))

    step_rad, even_share = np.median([_even_step(rays) for rays in sampled], axis=0).tolist()
    # More than half of the rays of a spinning scanner are spaced evenly, of scattered rays a fifth.
    if even_share >= 0.5 and fires_by_azimuth(sampled[0]):
        return Layout(None, False, step_rad, _table_of_lines(sweeps, step_rad))

    table = _table_of_density(sweeps)
    azimuth_gap_rad = table.at(sweeps[0].azimuth, sweeps[0].elevation)[:, 0]
    return Layout(None, True, float(np.median(azimuth_gap_rad)), table)


def find_rings(elevation: Float32) -> Float | None:
    """Return the elevations of a scanner's rings, or None if the returns are not on rings.

    Rings are peaks in the number of returns by elevation. They are accepted if 80 % of the returns
    are closer to a ring than a fifth of the ring spacing. ``elevation`` (N,) of the returns and the
    result (K,), ascending, are in radians.
    """
    # The last bin but one holds the zenith; one more is spare for rounding.
    num_bins = int(np.pi / _RING_BIN_RAD) + 2
    bin_of_return = ((elevation + 0.5 * np.pi) / _RING_BIN_RAD).astype(np.int64)
    num_in_bin = np.bincount(bin_of_return, minlength=num_bins).astype(float)
    peaks = _find_peaks(ndimage.gaussian_filter1d(num_in_bin, 1.0))
    # Fewer than three peaks have no pattern. Peaks of fewer than 24 returns on average are noise.
    if not 3 <= len(peaks) <= len(elevation) / _MIN_NUM:
        return None

    # The middle of each peak's bin
    rings: Float = (peaks + 0.5) * _RING_BIN_RAD - 0.5 * np.pi
    ring = _nearest_ring(rings, elevation)
    is_close = np.abs(elevation - rings[ring]) < _EVEN * np.gradient(rings)[ring]
    # Of elevations that are spread evenly, twice `_EVEN`, 40 %, are close by chance.
    if is_close.mean() < 0.8:
        return None
    # The middle of a bin may be half a bin off. The mean of a ring's returns is more exact.
    sum_rad = np.bincount(ring[is_close], elevation[is_close].astype(float), len(rings))
    return sum_rad / np.bincount(ring[is_close], minlength=len(rings))


def _nearest_ring(rings: Float, elevation: Float32) -> Int:
    """Return the (N,) index of the ring (K,) nearest to each elevation."""
    return np.searchsorted(0.5 * (rings[1:] + rings[:-1]), elevation)


def _find_peaks(counts: Float) -> Int:
    """Return the ascending indices of maxima that are separated by valleys of half their height."""
    peaks = []
    extreme = 0  # index of the highest count of this rise, or of the lowest of this fall
    is_rising = True
    for i, count in enumerate(counts.tolist()):
        if is_rising and count > counts[extreme]:
            extreme = i
        elif is_rising and count < 0.5 * counts[extreme]:
            peaks.append(extreme)
            extreme, is_rising = i, False
        elif not is_rising and count < counts[extreme]:
            extreme = i
        elif not is_rising and 0.5 * count > counts[extreme]:
            extreme, is_rising = i, True
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
    # Fewer than five rays do not show the spread of a column's firing times.
    spread_s = np.sqrt(sum_squares / np.maximum(num_rays, 1))[num_rays >= 5]
    # 0.03 of a turn are 11 degrees. Most columns decide: a column at the seam has two times.
    return not len(spread_s) or bool(np.mean(spread_s < 0.03 * duration_s) > 0.5)


def _select_sectors(rays: AimedRays) -> AimedRays:
    """Return every fourth sector if the rays are many: enough rays to measure a layout."""
    if len(rays.azimuth) > 15_000:
        is_sampled = np.floor(rays.azimuth / np.deg2rad(5.0)) % 4 == 0
        if is_sampled.mean() > 0.1:  # a narrow view may miss these sectors
            return AimedRays(*(column[is_sampled] for column in rays))
    return rays


def _sort_in_groups(group: NDArray[Any], angle: Float32) -> Float:
    """Return ascending angles, each shifted by `_APART_RAD` times the number of its group."""
    return np.sort(group * _APART_RAD + angle.astype(np.float64))


def _gaps_in_groups(group: NDArray[Any], angle: Float32, min_rad: float) -> Float:
    """Return the gaps above ``min_rad`` between neighbouring angles of the same group."""
    gap_rad: Float = np.diff(_sort_in_groups(group, angle))
    return gap_rad[(gap_rad > min_rad) & (gap_rad < 2 * np.pi)]  # larger gaps are between groups


def _step_on_rings(rays: AimedRays, rings: Float) -> float:
    """Return the median azimuth difference (rad) between neighbours on a ring."""
    # Smaller differences are between two returns of one ray.
    ring = _nearest_ring(rings, rays.elevation)
    gap_rad = _gaps_in_groups(ring, rays.azimuth, _RING_BIN_RAD)
    return float(np.median(gap_rad)) if len(gap_rad) else _DEFAULT_RAD[0]


def _even_step(rays: AimedRays) -> tuple[float, float]:
    """Return the median azimuth gap (rad) at about equal elevation, and the share of even gaps."""
    band = np.floor(rays.elevation / np.deg2rad(0.1))
    gap_rad = _gaps_in_groups(band, rays.azimuth, _MIN_GAP_RAD)
    if not len(gap_rad):
        return _DEFAULT_RAD[0], 0.0
    usual_rad = float(np.median(gap_rad))
    return usual_rad, float(np.mean(np.abs(gap_rad - usual_rad) < _EVEN * usual_rad))


def _bin_middles(low_rad: float, bin_rad: float, num_bins: int) -> Float:
    """Return the (num_bins,) elevations in the middle of each bin."""
    return np.asarray(low_rad + (np.arange(num_bins) + 0.5) * bin_rad, np.float64)


def _table_by_elevation(
    low_rad: float, bin_rad: float, step_rad: float, elevation_gap_rad: Float
) -> RayTable:
    """Return a table with equal steps of azimuth, and the (B,) elevation gaps of its B bins."""
    # A step of azimuth is shorter on the sphere by the cosine of the elevation.
    elevation = _bin_middles(low_rad, bin_rad, len(elevation_gap_rad))
    gaps_rad = step_rad * np.cos(elevation), elevation_gap_rad
    columns = (gap_rad[:, None].astype(np.float32) for gap_rad in gaps_rad)
    return RayTable(low_rad, float(bin_rad), *columns)


def _table_of_rings(rings: Float, step_rad: float) -> RayTable:
    """Return the table whose spacing at a ring is the mean distance to both neighbouring rings."""
    low_rad = float(rings[0]) - _CELL_RAD  # with a margin beyond the outermost rings
    num_bins = int((float(rings[-1]) + _CELL_RAD - low_rad) / _RING_BIN_RAD) + 1
    elevation = _bin_middles(low_rad, _RING_BIN_RAD, num_bins)
    gap_rad = np.interp(elevation, rings, np.gradient(rings, edge_order=1))
    return _table_by_elevation(low_rad, _RING_BIN_RAD, step_rad, gap_rad)


def _table_of_lines(sweeps: Sequence[AimedRays], step_rad: float) -> RayTable:
    """Return the table of median elevation differences within sectors of 1 degree, by elevation."""
    sizes_rad, middles_rad = [], []  # of the gaps between neighbouring lines, for each sweep
    for rays in sweeps:
        # Each elevation is shifted by a multiple of `_APART_RAD`, the number of its sector.
        shifted_rad = _sort_in_groups(np.floor(rays.azimuth / _CELL_RAD), rays.elevation)
        gap_rad = np.diff(shifted_rad)
        # A gap above 4 degrees is due to missing returns or lies between two sectors. A gap below
        # half a step of azimuth lies within one line.
        is_gap = (gap_rad < np.deg2rad(4.0)) & (gap_rad > max(step_rad / 2, _MIN_GAP_RAD))
        middle_rad = shifted_rad[:-1][is_gap] + gap_rad[is_gap] / 2
        # Elevations are small, so the nearest multiple of `_APART_RAD` is the shift of the sector.
        middles_rad.append(middle_rad - _APART_RAD * np.rint(middle_rad / _APART_RAD))
        sizes_rad.append(gap_rad[is_gap])

    # The table has one bin below the lowest ray and one above the highest. Both have no gaps.
    low_rad = float(min(rays.elevation.min() for rays in sweeps)) - _LINE_BIN_RAD
    high_rad = float(max(rays.elevation.max() for rays in sweeps)) + _LINE_BIN_RAD
    num_bins = int((high_rad - low_rad) / _LINE_BIN_RAD) + 2
    bin_of_gap = ((np.concatenate(middles_rad) - low_rad) / _LINE_BIN_RAD).astype(np.int64)
    full_bins = np.flatnonzero(np.bincount(bin_of_gap, minlength=num_bins) >= _MIN_NUM)
    gap_rad = np.full(num_bins, _DEFAULT_RAD[1])
    if len(full_bins):
        medians_rad = ndimage.median(np.concatenate(sizes_rad), bin_of_gap, full_bins)
        gap_rad = np.interp(np.arange(num_bins), full_bins, medians_rad)
    return _table_by_elevation(low_rad, _LINE_BIN_RAD, step_rad, gap_rad)


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

    # Single empty cells between filled cells are in view, too.
    is_filled = num_returns > 0
    in_view = ndimage.binary_closing(np.pad(is_filled, 1))[1:-1, 1:-1] | is_filled
    elevation = _bin_middles(low_rad, _CELL_RAD, num_rows)
    cell_sr = _CELL_RAD**2 * np.cos(elevation)[:, None] * in_view

    # Returns per steradian in the smallest window that holds enough returns. Smaller windows
    # overwrite the largest, which always counts.
    density = np.zeros(num_returns.shape)
    for side in (31, 15, 7, 3, 1):
        num_in_window = _sum_in_windows(num_returns, side)
        window_sr = _sum_in_windows(cell_sr, side)
        is_enough = (num_in_window >= _MIN_NUM) | (side == 31)
        window_density = num_in_window / np.maximum(window_sr, 1e-12)
        density = np.where(is_enough & (window_sr > 0), window_density, density)

    # A cell without a density takes the spacing of the nearest cell with a density.
    has_density = in_view & (density > 0)
    spacing_rad = np.sqrt(len(sweeps) / np.where(has_density, density, 1.0))
    nearest_cell = ndimage.distance_transform_edt(~has_density, return_indices=True)[1]
    spacing_rad = spacing_rad[tuple(nearest_cell)].astype(np.float32)
    return RayTable(low_rad, float(_CELL_RAD), spacing_rad, spacing_rad)


def _sum_in_windows(values: Float, side: int) -> Float:
    """Return the sums of values (R,C) over square windows. The azimuth wraps around."""
    mean: Float = ndimage.uniform_filter(values, side, mode=("constant", "wrap"))
    return mean * side**2
