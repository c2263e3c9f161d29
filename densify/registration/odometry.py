# SPDX-License-Identifier: MIT
"""Estimate odometry of dense sweeps by KISS-ICP, in two passes, from a searched initial speed.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int, Sweep, Trajectory
from densify.registration.deskew import deskew

_NUM_CATCHING_UP = 3  # first sweeps, whose poses in the first pass are less exact
# Change of a sweep's pose (rad and m) below which KISS-ICP stops. The first pass only has to find
# the motion within a sweep: 3 mm over 0.1 s bend its ends by 1.5 mm. The second pass is the start
# of `densify.registration.surfaces`: with 3 mm there too, a highway of 32 rings slides by 0.1 m.
_FIRST_PASS, _SECOND_PASS = 3e-3, 5e-4

MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
_STEP_M, _STEP_S = 0.5, 0.1  # steps of the speed search; smaller in proportion for shorter times
_NUM_SAMPLES = 800
_CLOSE_M = 1.0
_RAYS_RAD = 0.01  # angle between rays; objects along the road meet the same rays at any speed
_ABOVE_GROUND_M = 0.4


def find_odometry(
    sweeps: Sequence[Sweep], settings: RegisterSettings
) -> tuple[Trajectory, list[Sweep]]:
    """Return the trajectory of raw, dense sweeps, and the sweeps deskewed by the first pass.

    Sweeps of a fast scanner are registered in batches (`densify.geometry.clock.Clock.batches`),
    because a few points of one sweep are not enough. Sweep by sweep, a highway at 20 Hz looks as if
    the vehicle were at rest: 19 m off after 0.75 s.

    Args:
        sweeps: Raw sweeps, ascending in time, one or more.

    Returns:
        The (S,4,4) trajectory in the frame of the first sweep, and S deskewed sweeps.
    """
    stamp_ns, frames = np.array([s.stamp_ns for s in sweeps], np.int64), [s.frame for s in sweeps]
    groups = [list(rows) for rows in Clock(stamp_ns).batches()]
    if len(groups) in (1, len(sweeps)):
        T_world_lidar = register(stamp_ns, [s.points for s in sweeps], settings)
        rough = Trajectory(tuple(frames), stamp_ns, T_world_lidar)
        deskewed = [s.sweep for s in deskew(sweeps, rough).sweeps]
        T_world_lidar = register(stamp_ns, [s.points for s in deskewed], settings, rough)
        return replace(rough, T_world_lidar=T_world_lidar), deskewed
    middle_ns = np.array([(stamp_ns[g[0]] + stamp_ns[g[-1]]) // 2 for g in groups])
    points = [np.concatenate([sweeps[i].points for i in rows]) for rows in groups]
    known = Trajectory(
        tuple(frames[rows[0]] for rows in groups),
        middle_ns,
        register(middle_ns, points, settings),
    )
    rough = Trajectory(tuple(frames), stamp_ns, _between(known, stamp_ns))
    deskewed = [s.sweep for s in deskew(sweeps, rough).sweeps]
    known = replace(known, T_world_lidar=_between(rough, middle_ns))
    points = []
    for rows, T_world_joined in zip(groups, known.T_world_lidar, strict=True):
        T_joined_lidar = poses.inverse(T_world_joined) @ rough.T_world_lidar[rows]
        moved = zip(T_joined_lidar, (deskewed[i].points for i in rows), strict=True)
        points.append(np.concatenate([poses.transform(T, p) for T, p in moved]))
    known = replace(known, T_world_lidar=register(middle_ns, points, settings, known))
    return replace(rough, T_world_lidar=_between(known, stamp_ns)), deskewed


def register(
    stamp_ns: Int,
    points: Sequence[Float],
    settings: RegisterSettings,
    rough: Trajectory | None = None,
) -> Float:
    """Return ``T_first_lidar`` (S,4,4) of S sweeps, registered one after another by KISS-ICP.

    The first pass predicts each sweep at constant velocity, starting from `search_twist`, because
    KISS-ICP assumes a start at rest. Its voxels are twice as large.

    Args:
        stamp_ns: (S,) ascending.
        points: (N,3) of each sweep; raw in the first pass, deskewed in the second.
        rough: Trajectory of the first pass, from which the second pass predicts each sweep; None
            for the first pass.
    """
    from kiss_icp.kiss_icp import KissICP

    step_s = np.diff(stamp_ns) * 1e-9
    voxel_size_m = settings.voxel_size_m * (2 if rough is None else 1)
    odometry = KissICP(_kiss_icp_config(settings, voxel_size_m, rough is not None))
    no_stamps = np.empty(0)  # KISS-ICP aborts the process on equal stamps; we deskew ourselves
    T_world_lidar: list[Float] = []
    for i in range(len(points)):
        if i:
            if rough is not None:
                to = min(max(i, _NUM_CATCHING_UP + 1), len(points) - 1)
                twist = poses.twist_to(rough.T_world_lidar, stamp_ns, to)
            elif i == 1:
                twist = search_twist(stamp_ns, points)
            else:
                twist = poses.log(odometry.last_delta) / step_s[i - 2]
            odometry.last_delta = poses.exp(twist * step_s[i - 1])
        odometry.register_frame(points[i], no_stamps)
        T_world_lidar.append(odometry.last_pose)
    return np.stack(T_world_lidar)


def _between(known: Trajectory, stamp_ns: Int) -> Float:
    """Return (n,4,4) poses of ``known`` at n other times, at constant velocity between sweeps."""
    T_world_lidar = []
    for time_ns in stamp_ns:
        later = int(np.searchsorted(known.stamp_ns, time_ns, side="right"))
        k = min(max(later, 1), len(known.stamp_ns) - 1) - 1
        a_ns, b_ns = known.stamp_ns[k : k + 2]
        a, b = known.T_world_lidar[k : k + 2]
        T_world_lidar.append(poses.interpolate(a, b, (time_ns - a_ns) / (b_ns - a_ns)))
    return np.stack(T_world_lidar)


def _kiss_icp_config(  # type: ignore[no-untyped-def]
    settings: RegisterSettings, voxel_size_m: float, second_pass: bool
):
    """Return the configuration of KISS-ICP, with every field set.

    A field left unset would be read from ``kiss_icp_*`` environment variables. In the second pass
    the matching threshold is one voxel, because the prediction is good.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import (
        AdaptiveThresholdConfig,
        DataConfig,
        MappingConfig,
        RegistrationConfig,
    )

    return KISSConfig(
        out_dir="",
        data=DataConfig(
            max_range=settings.max_range_m, min_range=settings.min_range_m, deskew=False
        ),
        mapping=MappingConfig(voxel_size=voxel_size_m, max_points_per_voxel=20),
        # One thread: the order of a parallel sum, and with it the last bits, change between runs.
        registration=RegistrationConfig(
            max_num_iterations=500,
            convergence_criterion=_SECOND_PASS if second_pass else _FIRST_PASS,
            max_num_threads=1,
        ),
        adaptive_threshold=AdaptiveThresholdConfig(
            fixed_threshold=voxel_size_m if second_pass else None,
            initial_threshold=2.0,
            min_motion_th=0.1,
        ),
    )


def search_twist(stamp_ns: Int, points: Sequence[Float]) -> Float:
    """Return the (6,) initial velocity (rad/s, m/s), without rotation, by a grid search.

    The velocity is the one that best aligns the points above the ground in the first three sweeps.
    Distances below the spacing of neighbouring rays count as 0, because a guard rail looks the same
    from a vehicle at rest and from a vehicle that moves along the rail. The grid moves the second
    sweep by steps of 1 m, then by 0.5 m around the best position. Steps are smaller for sweeps less
    than 0.1 s apart.

    Args:
        stamp_ns: (S,) ascending.
        points: (N,3) metres of each of the S sweeps, in its lidar frame.
    """
    step_s = np.diff(stamp_ns[:3]) * 1e-9
    step_m = _STEP_M * min(1.0, step_s[0] / _STEP_S)
    above = [above_ground(p) for p in points[:3]]
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(above)):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _NUM_SAMPLES + 1]]
        ratio = step_s[i] / step_s[0]
        apart_m = _RAYS_RAD * np.linalg.norm(sample, axis=1)
        pairs.append((tree_of(earlier), sample, ratio, apart_m))

    def cost(steps_m: Float) -> Float:
        sums = 1e-3 * np.linalg.norm(steps_m, axis=1)
        for tree, sample, ratio, apart_m in pairs:
            moved = (sample + ratio * steps_m[:, None, :]).reshape(-1, 3)
            distance_m, _ = tree.query(moved, distance_upper_bound=_CLOSE_M, workers=-1)
            distance_m = np.minimum(distance_m, _CLOSE_M).reshape(len(steps_m), -1)
            sums += np.maximum(distance_m - apart_m, 0.0).mean(1)
        return sums

    coarse_m = _grid(np.zeros(2), MAX_SPEED_M_S * step_s[0], 2 * step_m)
    coarse = coarse_m[np.argmin(cost(coarse_m))]
    fine_m = _grid(coarse[:2], 2 * step_m, step_m)
    return np.append(np.zeros(3), fine_m[np.argmin(cost(fine_m))] / step_s[0])


def _grid(center: Float, reach_m: float, step_m: float) -> Float:
    """Return (n,3) horizontal motions on a square grid around a centre (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(center[0] + span, center[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def above_ground(points: Float) -> Float:
    """Return the points more than 0.4 m above the lowest point of their 1 m grid cell.

    Rings on flat ground move with the vehicle and would hide its motion. If no point is above, all
    points are returned.
    """
    if not len(points):
        return points
    x, y, z = points.T
    row, column = (np.floor(along).astype(np.int64) for along in (x, y))
    row, column = row - row.min(), column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    above = points.take(np.flatnonzero(z > lowest[cell] + _ABOVE_GROUND_M), axis=0)
    return above if len(above) else points
