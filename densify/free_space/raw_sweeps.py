# SPDX-License-Identifier: MIT
"""Judge raw sweeps: returns without neighbours, missing directions, sweeps in a map's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.geometry.types import Float, Int, Sweep, Trajectory

MAP_FRAME_REMEDY = (
    "give the poses that placed the sweeps, with sweeps: {frame: poses} in densify.yaml; of a bag, "
    "name the topic of the sweeps as measured (#points=) or the odometry (#poses=)"
)
LOST_DEG = 2.0
"""Width without returns from which a sweep is reported, a packet of a fast scanner."""
_NUM_BINS = 360
_MEASURED = 0.2  # of the mean number of returns of a bin; with fewer a bin may be empty by chance
_BLIND_DEG = (3, 90)  # wider gaps are the limits of a scanner's field of view

_CELL_RAD, _CELL_DEPTH = np.radians(2.0), 0.08  # depth as a share of the range
_USUAL_POINTS = 120_000  # a cell has some 50 rays of a sweep of so many points
_MIN_POINTS = 1000  # of a tested sweep
_MAX_LONE = 5  # returns in the cell of a lone return
_MAX_ALONE = 0.007  # share of returns alone in a cell; real sweeps in good weather had up to 0.004

_RAY_RAD = np.radians(0.4)
_BEHIND, _BEHIND_M = 0.15, 1.0  # farther than the nearest return of the cell: share, metres
_STEP_M, _NUM_STEPS = 4.0, 4  # of the search, each half of the one before
_MAX_MOVES = 20  # of each step
_LESS = 0.8  # of the occluded returns of a sweep remain at a place that is not the origin
_APART_M = 1.0  # least distance between the scanner's positions that shows its motion
_FLOOR_M, _LOWEST_M, _ROOF_M = 30.0, 0.5, 1.8  # reach of the floor; heights of scanners above it


def _directions(points: Float) -> tuple[Float, Float, Float]:
    """Return azimuth, elevation (rad) and range (m), (N,) each, of points (N,3)."""
    x, y, z = np.ascontiguousarray(points.T)
    range_m = np.sqrt(x * x + y * y + z * z)
    elevation = np.arcsin(np.clip(z / np.maximum(range_m, 1e-9), -1, 1))
    return np.arctan2(y, x), elevation, range_m


def _numbered(coordinates: Float) -> Int:
    """Return the (N,) number of the unit cell that holds each of N coordinates (D,N)."""
    cell = np.floor(coordinates).astype(np.int64)
    cell -= cell.min(axis=1, keepdims=True)
    return np.ravel_multi_index(tuple(cell), tuple(cell.max(axis=1) + 1))


# --- snow, rain and dust


def without_lone(sweep: Sweep) -> Sweep:
    """Remove lone returns, counting ``num_lone``, if their number suggests snow, rain or dust.

    The volume searched around a return grows with its range (Charron et al., "De-noising of Lidar
    Point Clouds Corrupted by Snowfall", CRV 2018). It is a cell of direction and logarithm of
    range.
    """
    if len(sweep) < _MIN_POINTS:
        return sweep
    coordinates, max_alone = _in_cells(sweep), _MAX_ALONE * len(sweep)
    num = _count_in_cells(coordinates)
    if np.count_nonzero(num == 1) <= max_alone:
        return sweep
    # The larger count of two grids, half a cell apart: a surface may lie on a cell border.
    num = np.maximum(num, _count_in_cells(coordinates + [[0.0], [0.5], [0.5], [0.5]]))
    lone = num <= _MAX_LONE
    is_noise = 2 * np.count_nonzero(lone) > len(sweep)
    if np.count_nonzero(num == 1) <= max_alone or is_noise:
        return sweep
    return replace(sweep.select(~lone), num_lone=int(lone.sum()))


def _in_cells(sweep: Sweep) -> Float:
    """Return the (4,N) scanner, azimuth, elevation and log range of the returns, in cells."""
    origins_m, lidar = sweep.scanner_origins, sweep.lidar
    points = sweep.points if origins_m is None else sweep.points - origins_m[lidar]
    azimuth, elevation, range_m = _directions(points)
    per_rad = (np.sqrt(np.bincount(lidar) / _USUAL_POINTS) / _CELL_RAD)[lidar]
    depth = np.log(np.maximum(range_m, 1e-3)) / _CELL_DEPTH
    return np.stack([lidar, azimuth * per_rad, elevation * per_rad, depth])


def _count_in_cells(coordinates: Float) -> Int:
    """Return the (N,) number of returns in each return's cell, from `_in_cells` (4,N)."""
    cell = _numbered(coordinates)
    num: Int = np.bincount(cell)[cell]
    return num


# --- lost packets and blind sectors: ground or obstacles surround a vehicle


def by_azimuth(sweep: Sweep) -> Int:
    """Return the (360,) number of returns of a raw sweep in each degree of azimuth from -180."""
    edges_rad = np.linspace(-np.pi, np.pi, _NUM_BINS + 1)
    return np.histogram(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]), edges_rad)[0]


def lost_deg(returns: Int) -> Float:
    """Return the (n,) degrees of azimuth that each sweep lacks and others measured.

    A degree counts as measured if a quarter of the sweeps have returns in it, not just single ones.
    ``returns`` are the (n,360) numbers of `by_azimuth` of each sweep.
    """
    usual = np.quantile(returns, 0.75, axis=0)
    lost = (returns == 0) & (usual > _MEASURED * usual.mean())
    width_deg: Float = lost.sum(axis=1) * (360.0 / _NUM_BINS)
    return width_deg


def blind_sector(returns: Int) -> tuple[int, int] | None:
    """Return the first and last azimuth (deg, counterclockwise from x) that no sweep measured.

    It is the widest gap of 3 to 90 degrees, else None: wider gaps limit the scanner's field of
    view. ``returns`` are as in `lost_deg`.
    """
    measured = np.flatnonzero(returns.any(axis=0))
    if not len(measured):
        return None
    width = np.diff(measured, append=measured[0] + _NUM_BINS) - 1
    width[width > _BLIND_DEG[1]] = 0
    widest = int(np.argmax(width))
    if width[widest] < _BLIND_DEG[0]:
        return None
    begin = int(measured[widest] + 1) % _NUM_BINS - 180
    return begin, begin + int(width[widest])


# --- the position of the scanner: from it, fewest returns lie behind others


def in_map_frame(
    sweeps: Sequence[Sweep], trajectory: Trajectory, recorded: Trajectory | None
) -> str:
    """Return why raw sweeps seem to be in the frame of a map, "" if they seem not to be.

    ``trajectory`` are their registered poses, by the ``recorded`` poses or, if None, by odometry.
    """
    if recorded is not None:
        is_placed = are_placed(sweeps, recorded.T_world_lidar)
        return "the rays begin at the sweeps' poses" if is_placed else ""
    if is_still(trajectory.T_world_lidar) and (way_m := way_in_map(sweeps[0], sweeps[-1])):
        return f"odometry finds no motion, but the rays of both begin {way_m:.1f} m apart"
    return ""


def is_still(T_world_lidar: Float) -> bool:
    """Return True if the poses (n,4,4) of odometry hardly move, as between sweeps in a map."""
    return bool(np.linalg.norm(np.ptp(T_world_lidar[:, :3, 3], axis=0)) <= _APART_M / 2)


def are_placed(sweeps: Sequence[Sweep], T_world_lidar: Float) -> bool:
    """Return True if the rays of sweeps begin at their poses (n,4,4): both are in the world.

    The poses must then not be applied again. Fewer returns lie behind others seen from the pose
    than seen from positions around it at the same height, and than seen from the origin. Two
    sweeps decide: those whose poses are farthest from the origin, if more than 4 m away, where no
    scanner is mounted.
    """
    origins = np.stack([sweep.origin_m(0) for sweep in sweeps])
    distance_m = np.linalg.norm(T_world_lidar[:, :3, 3] - origins, axis=1)
    return all(
        distance_m[i] > _STEP_M
        and _is_scanner(sweeps[i].points, T_world_lidar[i, :3, 3], origins[i])
        for i in np.argsort(distance_m, kind="stable")[-2:]
    )


def way_in_map(first: Sweep, last: Sweep) -> float:
    """Return the distance (m) between the positions from which two raw sweeps were measured.

    It is 0 for sweeps in their scanner's own frame. Sweeps between which odometry finds no motion
    are in the frame of a map if their rays begin apart.
    """
    start = _start(last)
    end = _scanner_position(last.points[::2], start)
    if np.linalg.norm(end - start) < _APART_M:
        return 0.0
    begin = _scanner_position(first.points[::2], _start(first))
    distance_m = float(np.linalg.norm((end - begin)[:2]))
    return distance_m if distance_m > _APART_M else 0.0


def share_behind(points: Float, origin: Float) -> float:
    """Return the share of points (N,3) that lie behind others, seen from ``origin`` (3,)."""
    azimuth, elevation, range_m = _directions(points - origin)
    rows = range_m > 0
    if not rows.any():
        return 0.0
    cell = _numbered(np.stack([azimuth[rows], elevation[rows]]) / _RAY_RAD)
    nearest_m = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest_m, cell, range_m[rows])
    return float(np.mean(range_m[rows] > (1 + _BEHIND) * nearest_m[cell] + _BEHIND_M))


def _scanner_position(points: Float, start: Float) -> Float:
    """Return the (3,) position, level with ``start`` (3,), from which a sweep was measured."""
    # A descent in steps of 4 m to 0.5 m. A position counts only if clearly fewer returns are
    # occluded there than at the start.
    at_start = share_behind(points, start)
    best, lowest_share = start, at_start
    for step_m in _STEP_M * 0.5 ** np.arange(_NUM_STEPS):
        for _ in range(_MAX_MOVES):
            positions = _around(best, step_m, 8)
            shares = [share_behind(points, position) for position in positions]
            if min(shares) >= lowest_share:
                break
            best, lowest_share = positions[int(np.argmin(shares))], min(shares)
    return best if lowest_share < _LESS * at_start else start


def _around(position: Float, step_m: float, num: int) -> Float:
    """Return (num,3) positions ``step_m`` away from a position (3,), at its height."""
    yaw_rad = np.arange(num) * (2 * np.pi / num)
    return position + step_m * np.stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad], axis=1)


def _start(sweep: Sweep) -> Float:
    """Return the origin (3,) of a sweep, on a car's roof if it lies on the ground."""
    origin = sweep.origin_m(0)
    is_near = np.hypot(*(sweep.points - origin)[:, :2].T) < _FLOOR_M
    if not is_near.any():
        return origin
    floor_m = float(np.percentile(sweep.points[is_near, 2], 10))
    if origin[2] - floor_m > _LOWEST_M:
        return origin
    return np.array([*origin[:2], floor_m + _ROOF_M])


def _is_scanner(points: Float, position: Float, origin: Float) -> bool:
    """Return True if fewer points are occluded from the position than from all alternatives."""
    alternatives = [origin, *_around(position, _STEP_M, 4)]
    lowest_share = min(share_behind(points, alternative) for alternative in alternatives)
    return share_behind(points, position) < _LESS * lowest_share
