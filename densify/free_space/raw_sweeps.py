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
_STEP_M = 4.0  # first step of the search for the scanner's position
# Returns occluded from the scanner's position are fewer than this share of those occluded from any
# other position.
_MAX_OCCLUDED_RATIO = 0.8
_MIN_MOTION_M = 1.0  # least distance between the scanner's positions that shows its motion


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

    The result counts the lone returns in ``num_lone``: up to five in a cell of direction and
    logarithm of range, which grows with the range (Charron et al., "De-noising of Lidar Point
    Clouds Corrupted by Snowfall", CRV 2018). The sweep is returned unchanged if it has fewer than
    1000 points, few returns alone in a cell, or more lone returns than others.
    """
    if len(sweep) < 1000:  # the share of lone returns would be chance
        return sweep
    coordinates = _cell_coordinates(sweep)
    # In good weather up to 0.4 % of the returns of real sweeps are single in their cell.
    max_single = 0.007 * len(sweep)
    num_in_cell = _count_in_cells(coordinates)
    if np.count_nonzero(num_in_cell == 1) <= max_single:
        return sweep
    # The larger count of two grids, half a cell apart: a surface may lie on a cell border.
    shift = [[0.0], [0.5], [0.5], [0.5]]  # the scanner's number is not shifted
    num_in_cell = np.maximum(num_in_cell, _count_in_cells(coordinates + shift))
    is_lone = num_in_cell <= 5
    is_sparse = 2 * np.count_nonzero(is_lone) > len(sweep)
    if np.count_nonzero(num_in_cell == 1) <= max_single or is_sparse:
        return sweep
    return replace(sweep.select(~is_lone), num_lone=int(is_lone.sum()))


def _cell_coordinates(sweep: Sweep) -> Float:
    """Return the (4,N) scanner, azimuth, elevation and log range of the returns, in cells."""
    origins_m, lidar = sweep.scanner_origins, sweep.lidar
    # Cells are 2 degrees wide, and 8 % of the range deep. In a sweep of 120,000 points a cell has
    # some 50 rays. The cells of a sparser scanner are larger, and have about as many rays.
    per_rad = np.sqrt(np.bincount(lidar) / 120_000) / np.radians(2.0)
    coordinates = np.empty((4, len(sweep)))
    coordinates[0] = lidar
    # Blocks of rows whose many intermediate results stay in the processor's cache
    for first in range(0, len(sweep), 8192):
        rows = slice(first, first + 8192)
        points = sweep.points[rows]
        if origins_m is not None:
            points = points - origins_m[lidar[rows]]
        azimuth, elevation, range_m = _directions(points)
        coordinates[1:3, rows] = per_rad[lidar[rows]] * [azimuth, elevation]
        coordinates[3, rows] = np.log(np.maximum(range_m, 1e-3)) / 0.08
    return coordinates


def _count_in_cells(coordinates: Float) -> Int:
    """Return the (N,) number of returns in each return's cell, from `_cell_coordinates` (4,N)."""
    cell = _cell_numbers(coordinates)
    return np.asarray(np.bincount(cell)[cell], np.int64)


# --- lost packets and blind sectors: ground or obstacles surround a vehicle


def count_by_azimuth(sweep: Sweep) -> Int:
    """Return the numbers of returns (360,) of a raw sweep, by degree of azimuth from -180 on."""
    edges_rad = np.linspace(-np.pi, np.pi, 361)
    return np.histogram(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]), edges_rad)[0]


def lost_deg(returns: Int) -> Float:
    """Return the number (n,) of degrees of azimuth that each sweep lacks and other sweeps measured.

    A degree counts as measured if a quarter of the sweeps have more than single returns in it.
    ``returns`` (n,360) are the numbers of returns of each sweep by degree of azimuth.
    """
    num_usual = np.quantile(returns, 0.75, axis=0)
    # A degree with much fewer returns than the mean may be empty by chance.
    is_lost = (returns == 0) & (num_usual > 0.2 * num_usual.mean())
    return is_lost.sum(axis=1).astype(np.float64)


def blind_sector(returns: Int) -> tuple[int, int] | None:
    """Return the widest sector of azimuth that no sweep measured, None if there is none.

    The sector is 3 to 90 degrees wide. Without any return the result is None. ``returns`` (n,360)
    are the numbers of returns of each of n sweeps by degree of azimuth from -180 on.

    Returns:
        begin_deg: Azimuth of the right edge, -180 to 179, counterclockwise from x.
        end_deg: Azimuth of the left edge. It exceeds 180 if the sector contains the backward
            direction.
    """
    measured_deg = np.flatnonzero(returns.any(axis=0))
    if not len(measured_deg):
        return None
    # Width between each measured degree and the next, around the circle: 0 between neighbours
    gap_deg = np.diff(measured_deg, append=measured_deg[0] + 360) - 1
    gap_deg[gap_deg > 90] = 0  # a limit of the field of view
    widest = int(np.argmax(gap_deg))
    if gap_deg[widest] < 3:  # may be chance
        return None
    # The gap begins after the measured degree. Number 0 is at -180 degrees.
    begin_deg = int(measured_deg[widest] + 1) % 360 - 180
    return begin_deg, begin_deg + int(gap_deg[widest])


# --- the position of the scanner: from it, fewest returns lie behind others


def in_map_frame(
    sweeps: Sequence[Sweep], trajectory: Trajectory, recorded: Trajectory | None
) -> str:
    """Return why raw sweeps seem to be in the frame of a map, or "" if they do not seem to be.

    Args:
        sweeps: Raw sweeps in ascending order of time.
        trajectory: Registered poses of the sweeps.
        recorded: Recorded poses of the sweeps, None if the trajectory is from odometry.
    """
    if recorded is not None:
        begins_at_poses = rays_begin_at_poses(sweeps, recorded.T_world_lidar)
        return "the rays begin at the sweeps' poses" if begins_at_poses else ""
    if is_still(trajectory.T_world_lidar) and (way_m := way_in_map(sweeps[0], sweeps[-1])):
        return f"odometry finds no motion, but the rays of both begin {way_m:.1f} m apart"
    return ""


def is_still(T_world_lidar: Float) -> bool:
    """Return True if odometry's poses (n,4,4) move by at most 0.5 m, as of sweeps in a map."""
    return bool(np.linalg.norm(np.ptp(T_world_lidar[:, :3, 3], axis=0)) <= _MIN_MOTION_M / 2)


def rays_begin_at_poses(sweeps: Sequence[Sweep], T_world_lidar: Float) -> bool:
    """Return True if the rays of raw sweeps begin at the poses of the sweeps.

    The points are then in the world frame, and the poses (n,4,4) must not be applied again. The two
    sweeps whose poses are farthest from the scanner's origin decide. A pose must be over 4 m away,
    where no scanner is mounted. From this position clearly fewer returns must be occluded than from
    the origin and from positions around.
    """
    positions = T_world_lidar[:, :3, 3]
    origins = np.stack([sweep.origin_m(0) for sweep in sweeps])
    distance_m = np.linalg.norm(positions - origins, axis=1)
    farthest_two = np.argsort(distance_m, kind="stable")[-2:]
    return all(
        distance_m[i] > _STEP_M and _rays_begin_at(positions[i], sweeps[i].points, origins[i])
        for i in farthest_two
    )


def _rays_begin_at(position: Float, points: Float, origin: Float) -> bool:
    """Return True if fewer points (N,3) are occluded from the position (3,) than from others."""
    others = [origin, *_positions_around(position, _STEP_M, 4)]
    lowest_share = min(_share_behind(points, other) for other in others)
    position_share = _share_behind(points, position)
    return position_share < _MAX_OCCLUDED_RATIO * lowest_share


def way_in_map(first: Sweep, last: Sweep) -> float:
    """Return the distance in metres between the positions from which two raw sweeps were measured.

    It is 0 for sweeps in their scanner's own frame. Distances up to 1 m count as 0. Sweeps between
    which odometry finds no motion are in the frame of a map if their rays begin apart.
    """
    start = _search_start(last)
    position_last = _find_scanner(last, start)
    if np.linalg.norm(position_last - start) < _MIN_MOTION_M:
        return 0.0
    position_first = _find_scanner(first, _search_start(first))
    distance_m = float(np.linalg.norm((position_last - position_first)[:2]))
    return distance_m if distance_m > _MIN_MOTION_M else 0.0


def _share_behind(points: Float, origin: Float) -> float:
    """Return the share of points (N,3) that lie behind others, seen from ``origin`` (3,)."""
    azimuth, elevation, range_m = _directions(points - origin)
    has_direction = range_m > 0
    if not has_direction.any():
        return 0.0
    range_m = range_m[has_direction]
    # Returns occlude each other within cells of 0.4 degrees.
    directions = np.stack([azimuth[has_direction], elevation[has_direction]])
    cell = _cell_numbers(directions / np.radians(0.4))
    nearest_m = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest_m, cell, range_m)
    # At a low angle the returns of one surface in a cell differ in range, hence the wide margin.
    return float(np.mean(range_m > 1.15 * nearest_m[cell] + 1.0))


def _find_scanner(sweep: Sweep, start: Float) -> Float:
    """Return the (3,) position, level with ``start`` (3,), from which a sweep was measured."""
    # A descent in steps of 4 m to 0.5 m. The result counts only if clearly fewer returns are
    # occluded from it than from the start. Silhouettes split beams, hence up to 1 % of the returns
    # seem occluded from the scanner itself.
    points = sweep.points[::2]
    start_share = lowest_share = _share_behind(points, start)
    if start_share < 0.01:
        return start
    best_position = start
    for step_m in _STEP_M * 0.5 ** np.arange(4):
        for _ in range(20):  # limits the time
            positions = _positions_around(best_position, step_m, 8)
            shares = [_share_behind(points, position) for position in positions]
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
    """Return the origin (3,) of a sweep, raised to a car's roof if the origin is on the ground."""
    origin = sweep.origin_m(0)
    is_near = np.hypot(*(sweep.points - origin)[:, :2].T) < 30.0
    if not is_near.any():
        return origin
    floor_m = float(np.percentile(sweep.points[is_near, 2], 10))
    is_above_floor = origin[2] - floor_m > 0.5
    return origin if is_above_floor else np.array([*origin[:2], floor_m + 1.8])
