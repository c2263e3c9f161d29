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
_NUM_BINS = 360  # bins of azimuth
_MEASURED = 0.2  # share of the mean number of returns; a bin with fewer may be empty by chance
_BLIND_DEG = (3, 90)  # wider gaps are the limits of a scanner's field of view

_CELL_RAD, _CELL_DEPTH = np.radians(2.0), 0.08  # size of a cell; depth as a share of the range
_USUAL_POINTS = 120_000  # a cell has some 50 rays of a sweep of so many points
_BLOCK = 8192  # rows of a block
_MIN_POINTS = 1000  # least number of points of a tested sweep
_MAX_LONE = 5  # greatest number of returns in the cell of a lone return
# Greatest share of returns single in their cell in good weather; real sweeps had up to 0.004
_MAX_SINGLE = 0.007

_RAY_RAD = np.radians(0.4)  # side of a cell of direction in which returns occlude each other
# A return is occluded if it is farther than the nearest return of its cell: share, metres.
_BEHIND, _BEHIND_M = 0.15, 1.0
_STEP_M, _NUM_STEPS = 4.0, 4  # first step of the search; number of steps, each half as long
_MAX_MOVES = 20  # greatest number of moves with one step
# Returns occluded from the scanner's position are fewer than this share of those occluded from any
# other position.
_MAX_OCCLUDED_RATIO = 0.8
# Up to this share of returns seems occluded from the scanner itself: silhouettes split beams.
_AT_SILHOUETTES = 0.01
_MIN_MOTION_M = 1.0  # least distance between the scanner's positions that shows its motion
_FLOOR_M = 30.0  # greatest distance of returns that show the floor
_LOWEST_M, _ROOF_M = 0.5, 1.8  # heights above the floor: lowest scanner, scanner on a car's roof


def _directions(points: Float) -> tuple[Float, Float, Float]:
    """Return azimuth, elevation (rad) and range (m), (N,) each, of points (N,3)."""
    x, y, z = np.ascontiguousarray(points.T)
    range_m = np.sqrt(x * x + y * y + z * z)
    elevation = np.arcsin(np.clip(z / np.maximum(range_m, 1e-9), -1, 1))
    return np.arctan2(y, x), elevation, range_m


def _cell_numbers(coordinates: Float) -> Int:
    """Return the (N,) number of the unit cell that holds each of N coordinates (D,N)."""
    number = np.zeros(coordinates.shape[1])  # whole numbers, exact up to 2^53
    for axis_coordinates in coordinates:
        cell = np.floor(axis_coordinates)
        cell -= cell.min()
        number *= cell.max() + 1
        number += cell
    return number.astype(np.int64)


# --- snow, rain and dust


def remove_lone_returns(sweep: Sweep) -> Sweep:
    """Return the sweep without lone returns if their number suggests snow, rain or dust.

    The result counts them in ``num_lone``. The volume searched around a return grows with its range
    (Charron et al., "De-noising of Lidar Point Clouds Corrupted by Snowfall", CRV 2018). It is a
    cell of direction and logarithm of range. The sweep is returned unchanged if it has few points,
    few returns alone in a cell, or more lone returns than others.
    """
    if len(sweep) < _MIN_POINTS:
        return sweep
    coordinates = _cell_coordinates(sweep)
    max_single = _MAX_SINGLE * len(sweep)
    num_in_cell = _count_in_cells(coordinates)
    if np.count_nonzero(num_in_cell == 1) <= max_single:
        return sweep
    # The larger count of two grids, half a cell apart: a surface may lie on a cell border.
    shift = [[0.0], [0.5], [0.5], [0.5]]  # none between scanners
    num_in_cell = np.maximum(num_in_cell, _count_in_cells(coordinates + shift))
    is_lone = num_in_cell <= _MAX_LONE
    is_sparse = 2 * np.count_nonzero(is_lone) > len(sweep)
    if np.count_nonzero(num_in_cell == 1) <= max_single or is_sparse:
        return sweep
    return replace(sweep.select(~is_lone), num_lone=int(is_lone.sum()))


def _cell_coordinates(sweep: Sweep) -> Float:
    """Return the (4,N) scanner, azimuth, elevation and log range of the returns, in cells."""
    origins_m, lidar = sweep.scanner_origins, sweep.lidar
    # The cells of a sparse scanner are larger: each cell has about as many rays.
    per_rad = np.sqrt(np.bincount(lidar) / _USUAL_POINTS) / _CELL_RAD
    coordinates = np.empty((4, len(sweep)))
    coordinates[0] = lidar
    # Blocks of rows whose many intermediate results stay in the processor's cache
    for first in range(0, len(sweep), _BLOCK):
        rows = slice(first, first + _BLOCK)
        points = sweep.points[rows]
        if origins_m is not None:
            points = points - origins_m[lidar[rows]]
        azimuth, elevation, range_m = _directions(points)
        coordinates[1:3, rows] = per_rad[lidar[rows]] * [azimuth, elevation]
        coordinates[3, rows] = np.log(np.maximum(range_m, 1e-3)) / _CELL_DEPTH
    return coordinates


def _count_in_cells(coordinates: Float) -> Int:
    """Return the (N,) number of returns in each return's cell, from `_cell_coordinates` (4,N)."""
    cell = _cell_numbers(coordinates)
    num_in_cell: Int = np.bincount(cell)[cell]
    return num_in_cell


# --- lost packets and blind sectors: ground or obstacles surround a vehicle


def count_by_azimuth(sweep: Sweep) -> Int:
    """Return the (360,) number of returns of a raw sweep in each degree of azimuth from -180."""
    edges_rad = np.linspace(-np.pi, np.pi, _NUM_BINS + 1)
    return np.histogram(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]), edges_rad)[0]


def lost_deg(returns: Int) -> Float:
    """Return the (n,) degrees of azimuth that each sweep lacks and others measured.

    A degree counts as measured if a quarter of the sweeps have returns in it, not just single ones.
    ``returns`` (n,360) are the numbers of returns of each sweep, from `count_by_azimuth`.
    """
    num_usual = np.quantile(returns, 0.75, axis=0)
    is_lost = (returns == 0) & (num_usual > _MEASURED * num_usual.mean())
    width_deg: Float = is_lost.sum(axis=1) * (360.0 / _NUM_BINS)
    return width_deg


def blind_sector(returns: Int) -> tuple[int, int] | None:
    """Return the first and last azimuth (deg, counterclockwise from x) that no sweep measured.

    It is the widest gap of 3 to 90 degrees. None if there is none, or if no sweep has a return.
    Wider gaps are the limits of the scanner's field of view. ``returns`` (n,360) are the numbers of
    returns of each sweep, from `count_by_azimuth`.
    """
    measured_bins = np.flatnonzero(returns.any(axis=0))
    if not len(measured_bins):
        return None
    # From each measured bin to the next, around the circle; neighbours have a gap of 0.
    gap_deg = np.diff(measured_bins, append=measured_bins[0] + _NUM_BINS) - 1
    gap_deg[gap_deg > _BLIND_DEG[1]] = 0
    widest = int(np.argmax(gap_deg))
    if gap_deg[widest] < _BLIND_DEG[0]:
        return None
    # The gap begins with the bin after the measured one. Bin 0 is at -180 degrees.
    begin = int(measured_bins[widest] + 1) % _NUM_BINS - 180
    return begin, begin + int(gap_deg[widest])


# --- the position of the scanner: from it, fewest returns lie behind others


def in_map_frame(
    sweeps: Sequence[Sweep], trajectory: Trajectory, recorded: Trajectory | None
) -> str:
    """Return why raw sweeps seem to be in the frame of a map, "" if they seem not to be.

    ``trajectory`` are the registered poses of the sweeps. They are from the ``recorded`` poses, or
    from odometry if ``recorded`` is None.
    """
    if recorded is not None:
        is_placed = are_placed(sweeps, recorded.T_world_lidar)
        return "the rays begin at the sweeps' poses" if is_placed else ""
    if is_still(trajectory.T_world_lidar) and (way_m := way_in_map(sweeps[0], sweeps[-1])):
        return f"odometry finds no motion, but the rays of both begin {way_m:.1f} m apart"
    return ""


def is_still(T_world_lidar: Float) -> bool:
    """Return True if the poses (n,4,4) of odometry hardly move, as between sweeps in a map."""
    return bool(np.linalg.norm(np.ptp(T_world_lidar[:, :3, 3], axis=0)) <= _MIN_MOTION_M / 2)


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
    origin = _search_start(last)
    position_last = _find_scanner(last.points[::2], origin)
    if np.linalg.norm(position_last - origin) < _MIN_MOTION_M:
        return 0.0
    position_first = _find_scanner(first.points[::2], _search_start(first))
    distance_m = float(np.linalg.norm((position_last - position_first)[:2]))
    return distance_m if distance_m > _MIN_MOTION_M else 0.0


def share_behind(points: Float, origin: Float) -> float:
    """Return the share of points (N,3) that lie behind others, seen from ``origin`` (3,)."""
    azimuth, elevation, range_m = _directions(points - origin)
    has_direction = range_m > 0
    if not has_direction.any():
        return 0.0
    range_m = range_m[has_direction]
    directions = np.stack([azimuth[has_direction], elevation[has_direction]])
    cell = _cell_numbers(directions / _RAY_RAD)
    nearest_m = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest_m, cell, range_m)
    return float(np.mean(range_m > (1 + _BEHIND) * nearest_m[cell] + _BEHIND_M))


def _find_scanner(points: Float, start: Float) -> Float:
    """Return the (3,) position, level with ``start`` (3,), from which a sweep was measured."""
    # A descent in steps of 4 m to 0.5 m. A position counts only if clearly fewer returns are
    # occluded there than at the start, and more than silhouettes explain.
    start_share = share_behind(points, start)
    if start_share < _AT_SILHOUETTES:
        return start
    best_position = start
    lowest_share = start_share
    for step_m in _STEP_M * 0.5 ** np.arange(_NUM_STEPS):
        for _ in range(_MAX_MOVES):
            positions = _positions_around(best_position, step_m, 8)
            shares = [share_behind(points, position) for position in positions]
            if min(shares) >= lowest_share:
                break
            best_position = positions[int(np.argmin(shares))]
            lowest_share = min(shares)
    return best_position if lowest_share < _MAX_OCCLUDED_RATIO * start_share else start


def _positions_around(position: Float, step_m: float, num: int) -> Float:
    """Return (num,3) positions ``step_m`` away from a position (3,), at its height."""
    yaw_rad = np.arange(num) * (2 * np.pi / num)
    return position + step_m * np.stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad], axis=1)


def _search_start(sweep: Sweep) -> Float:
    """Return the origin (3,) of a sweep, raised to a car's roof if it lies on the ground."""
    origin = sweep.origin_m(0)
    is_near = np.hypot(*(sweep.points - origin)[:, :2].T) < _FLOOR_M
    if not is_near.any():
        return origin
    floor_m = float(np.percentile(sweep.points[is_near, 2], 10))
    if origin[2] - floor_m > _LOWEST_M:
        return origin
    return np.array([*origin[:2], floor_m + _ROOF_M])


def _is_scanner(points: Float, position: Float, origin: Float) -> bool:
    """Return True if fewer points are occluded from the position than from origin and around."""
    other_positions = [origin, *_positions_around(position, _STEP_M, 4)]
    lowest_share = min(share_behind(points, other) for other in other_positions)
    return share_behind(points, position) < _MAX_OCCLUDED_RATIO * lowest_share
