# SPDX-License-Identifier: MIT
"""Estimate the velocity at dense sweeps by KISS-ICP (Vizzo et al., RA-L 2023) on a sample."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int, Sweep
from densify.registration.alignment import subsample

_MOST_STEP_M = 60.0  # sweeps farther apart hardly overlap
_MOST_STEPS = 1000  # of the grid, that are tried at once
MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
# Change of a pose (rad and m) below which KISS-ICP stops. 3 mm in 0.1 s bend a sweep by 1.5 mm.
_CONVERGED = 3e-3

_STEP_M, _STEP_S = 0.5, 0.1  # steps of the speed search; smaller in proportion for shorter times
_NUM_SAMPLES = 800
_CLOSE_M = 1.0
_RAYS_RAD = 0.01  # angle between rays; objects along the road meet the same rays at any speed
_ABOVE_GROUND_M = 0.4


def find_odometry(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """Return the (S,6) approximate velocity (rad/s, m/s) before each of S raw sweeps, by KISS-ICP.

    A sample of the points above the ground is registered: with rings on flat ground, a highway of
    64 rings looks as if the vehicle were at rest. Prediction starts from `search_twist`, and sweeps
    of a fast scanner are registered about 0.1 s apart, because KISS-ICP assumes a start at rest. S
    is at least 2. The first velocity is that before the second sweep.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
    rows = [batch[0] for batch in Clock(stamp_ns).batches()]
    rows = rows if len(rows) > 1 else [0, len(sweeps) - 1]
    points = [above_ground(subsample(sweeps[row]).points) for row in rows]
    config = KISSConfig.model_construct()  # unlike KISSConfig(), without environment variables
    config.data.max_range, config.data.min_range = settings.max_range_m, settings.min_range_m
    config.data.deskew = False  # KISS-ICP aborts the process on equal times of points
    config.mapping.voxel_size = settings.voxel_size_m
    config.registration.convergence_criterion = _CONVERGED
    # One thread: the order of a parallel sum, and with it the last bits, change between runs.
    config.registration.max_num_threads = 1
    odometry, no_times = KissICP(config), np.empty(0)
    odometry.register_frame(points[0], no_times)
    twists = [search_twist(stamp_ns[rows], [sweeps[row].points for row in rows])]
    for sweep_points, seconds in zip(points[1:], np.diff(stamp_ns[rows]) * 1e-9, strict=True):
        odometry.last_delta = poses.exp(twists[-1] * seconds)
        odometry.register_frame(sweep_points, no_times)
        twists.append(poses.log(odometry.last_delta) / seconds)
    step = np.searchsorted(stamp_ns[rows], stamp_ns).clip(1, len(rows) - 1)
    return np.stack(twists)[step]


def search_twist(stamp_ns: Int, points: Sequence[Float]) -> Float:
    """Return the (6,) initial velocity (rad/s, m/s), without rotation, by a grid search.

    It best aligns the points above the ground in the first three sweeps. Distances below the
    spacing of neighbouring rays count as 0, because a guard rail looks the same from a vehicle at
    rest and from a vehicle that moves along the rail. The grid moves the second sweep by steps of 1
    m, then by 0.5 m around the best position, or less for sweeps less than 0.1 s apart. Each
    sweep's points (N,3) are in its lidar frame.
    """
    step_s = np.diff(stamp_ns[:3]) * 1e-9
    step_m = _STEP_M * min(1.0, step_s[0] / _STEP_S)
    points_above = [above_ground(p) for p in points[:3]]
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(points_above)):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _NUM_SAMPLES + 1]]
        ratio = step_s[i] / step_s[0]
        apart_m = _RAYS_RAD * np.linalg.norm(sample, axis=1)
        pairs.append((tree_of(earlier), sample, ratio, apart_m))

    def cost(steps_m: Float) -> Float:
        chunks = np.array_split(steps_m, len(steps_m) // _MOST_STEPS + 1)
        return np.concatenate([cost_of_few(chunk) for chunk in chunks])

    def cost_of_few(steps_m: Float) -> Float:
        cost_m = 1e-3 * np.linalg.norm(steps_m, axis=1)
        for tree, sample, ratio, apart_m in pairs:
            moved = (sample + ratio * steps_m[:, None, :]).reshape(-1, 3)
            distance_m, _ = tree.query(moved, distance_upper_bound=_CLOSE_M, workers=-1)
            distance_m = np.minimum(distance_m, _CLOSE_M).reshape(len(steps_m), -1)
            cost_m += np.maximum(distance_m - apart_m, 0.0).mean(1)
        return cost_m

    coarse_m = _grid(np.zeros(2), min(MAX_SPEED_M_S * step_s[0], _MOST_STEP_M), 2 * step_m)
    coarse = coarse_m[np.argmin(cost(coarse_m))]
    fine_m = _grid(coarse[:2], 2 * step_m, step_m)
    return np.append(np.zeros(3), fine_m[np.argmin(cost(fine_m))] / step_s[0])


def _grid(center: Float, reach_m: float, step_m: float) -> Float:
    """Return (n,3) horizontal motions on a square grid around a centre (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(center[0] + span, center[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def above_ground(points: Float) -> Float:
    """Return the points over 0.4 m above the lowest in their 1 m grid cell; all if none is."""
    if not len(points):
        return points
    x, y, z = points.T
    row, column = (np.floor(coordinate).astype(np.int64) for coordinate in (x, y))
    row, column = row - row.min(), column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    above = points.take(np.flatnonzero(z > lowest[cell] + _ABOVE_GROUND_M), axis=0)
    return above if len(above) else points
