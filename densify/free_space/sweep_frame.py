# SPDX-License-Identifier: MIT
"""Find the position from which a sweep was measured: from it, fewest returns lie behind others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.geometry.types import Float, Sweep

MAP_FRAME_REMEDY = (
    "give the poses that placed the sweeps, with sweeps: {frame: poses} in densify.yaml; of a bag, "
    "name the topic of the sweeps as measured (#points=) or the odometry (#poses=)"
)
_CELL_RAD = np.radians(0.4)
_BEHIND, _BEHIND_M = 0.15, 1.0  # farther than the nearest return of the cell: share, metres
_STEP_M, _NUM_STEPS = 4.0, 4  # of the search, each half of the one before
_NUM_WAYS = 8  # directions of a step
_MOST_MOVES = 20  # of each step
_LESS = 0.8  # of the occluded returns of a sweep remain at a place that is not the origin
_APART_M = 1.0  # least distance between the scanner's places that shows its motion
_NEAR_M, _LOWEST_M, _ROOF_M = 30.0, 0.5, 1.8  # heights of scanners above the ground


def _around(position: Float, step_m: float, num: int = _NUM_WAYS) -> Float:
    """Return (num,3) positions ``step_m`` away from a position (3,), at its height."""
    yaw_rad = np.arange(num) * (2 * np.pi / num)
    return position + step_m * np.stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad], axis=1)


def share_behind(points: Float, origin: Float) -> float:
    """Return the share of points (N,3) that lie behind others, seen from ``origin`` (3,)."""
    ray = points - origin
    range_m = np.linalg.norm(ray, axis=1)
    ray, range_m = ray[range_m > 0], range_m[range_m > 0]
    if not len(ray):
        return 0.0
    azimuth = np.floor(np.arctan2(ray[:, 1], ray[:, 0]) / _CELL_RAD).astype(np.int64)
    elevation = np.floor(np.arcsin(np.clip(ray[:, 2] / range_m, -1, 1)) / _CELL_RAD)
    cell = (azimuth - azimuth.min()) * 1000 + elevation.astype(np.int64) + 500
    nearest_m = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest_m, cell, range_m)
    return float(np.mean(range_m > (1 + _BEHIND) * nearest_m[cell] + _BEHIND_M))


def scanner_place(points: Float, start: Float) -> Float:
    """Return the position (3,) at the height of ``start`` (3,) from which a sweep was measured.

    The search is a descent in steps of 4 m to 0.5 m. A position counts only if clearly fewer
    returns are occluded there than at ``start``.
    """
    at_start = share_behind(points, start)
    best, lowest_share = start, at_start
    for step_m in _STEP_M * 0.5 ** np.arange(_NUM_STEPS):
        for _ in range(_MOST_MOVES):
            positions = _around(best, step_m)
            shares = [share_behind(points, position) for position in positions]
            if min(shares) >= lowest_share:
                break
            best, lowest_share = positions[int(np.argmin(shares))], min(shares)
    return best if lowest_share < _LESS * at_start else start


def is_still(T_world_lidar: Float) -> bool:
    """Return True if the poses (n,4,4) of odometry hardly move, as between sweeps in a map."""
    return bool(np.linalg.norm(np.ptp(T_world_lidar[:, :3, 3], axis=0)) <= _APART_M / 2)


def way_in_map(first: Sweep, last: Sweep) -> float:
    """Return the distance (m) between the positions from which two raw sweeps were measured.

    It is 0 for sweeps in their scanner's own frame. Sweeps between which odometry finds no motion
    are in the frame of a map if their rays begin apart.
    """
    start = _start(last)
    end = scanner_place(last.points[::2], start)
    if np.linalg.norm(end - start) < _APART_M:
        return 0.0
    distance_m = float(np.linalg.norm((end - scanner_place(first.points[::2], _start(first)))[:2]))
    return distance_m if distance_m > _APART_M else 0.0


def _start(sweep: Sweep) -> Float:
    """Return the origin (3,) of a sweep, on a car's roof if it lies on the ground."""
    origin = sweep.origin_m(0)
    is_near = np.hypot(*(sweep.points - origin)[:, :2].T) < _NEAR_M
    if not is_near.any():
        return origin
    floor_m = float(np.percentile(sweep.points[is_near, 2], 10))
    if origin[2] - floor_m > _LOWEST_M:
        return origin
    return np.array([*origin[:2], floor_m + _ROOF_M])


def are_placed(sweeps: Sequence[Sweep], T_world_lidar: Float) -> bool:
    """Return True if the rays of sweeps begin at their poses (n,4,4): both are in the world.

    The poses must then not be applied again. Fewer returns lie behind others seen from the pose
    than seen from positions around it at the same height, and than seen from the origin. Two
    sweeps decide: those whose poses are farthest from the origin, if more than 4 m away, where no
    scanner is mounted.
    """
    triples = [
        (s.points, s.origin_m(0), T[:3, 3]) for s, T in zip(sweeps, T_world_lidar, strict=True)
    ]
    # by the distance of the pose (2) from the origin (1)
    farthest = sorted(triples, key=lambda p: float(np.linalg.norm(p[2] - p[1])))[-2:]
    return all(
        np.linalg.norm(pose_m - origin) > _STEP_M and _is_scanner(points, pose_m, origin)
        for points, origin, pose_m in farthest
    )


def _is_scanner(points: Float, position: Float, origin: Float) -> bool:
    alternatives = [origin, *_around(position, _STEP_M, 4)]
    lowest_share = min(share_behind(points, alternative) for alternative in alternatives)
    return share_behind(points, position) < _LESS * lowest_share
