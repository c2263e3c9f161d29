# SPDX-License-Identifier: MIT
"""Registration: where the lidar was at every sweep. The one door to KISS-ICP.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.errors import SweepError
from densify.geometry import poses
from densify.types import Float, Sweep, Trajectory

_MAX_ACCELERATION_M_S2 = 30.0  # three times what tyres can do; the rest is noise of the stamps
_MAX_TURN_RATE_DEG_S = 150.0
_POSE_NOISE_M = 0.5
_NUM_CATCHING_UP = 3
_SEARCH_STEP_M = 0.5
_SEARCH_POINTS = 800
_STANDING_M = 0.4
_OVERLAP_POINTS = 2000
_OVERLAP_M = 0.5


def register(
    sweeps: Sequence[Sweep], settings: RegisterSettings, rough: Trajectory | None = None
) -> Trajectory:
    """Poses of consecutive sweeps by lidar odometry.

    sweeps: ascending frames; raw for a first pass, deskewed for a second one.
    rough: the first pass. It tells the second one how fast the vehicle starts and lets it work
        with the fine voxels; without it they are twice as large and the start is searched for,
        since odometry by itself takes every start for standing still.

    World is the first sweep's lidar frame. Raises SweepError naming the frames where a sweep
    is too sparse to register or, in the second pass, the motion is none a vehicle makes.
    """
    from kiss_icp.kiss_icp import KissICP

    for sweep in sweeps:
        if len(sweep) < settings.min_num_points:
            raise SweepError(
                f"registration: sweep {sweep.frame} has {len(sweep)} points, expected at least "
                f"{settings.min_num_points}; choose another key or lower register.min_num_points",
                sweep.frame,
            )
    voxel_size_m = settings.voxel_size_m * (2 if rough is None else 1)
    odometry = KissICP(_kiss_icp_config(settings, voxel_size_m))
    if len(sweeps) > 1:
        odometry.last_delta = _searched_step(sweeps, settings) if rough is None else _step(rough)
        odometry.last_pose = poses.inverse(odometry.last_delta)
    T_world_lidar = []
    no_stamps = np.empty(
        0
    )  # KISS-ICP aborts the process on equal stamps; sweeps are ours to deskew
    for sweep in sweeps:
        odometry.register_frame(sweep.points, no_stamps)
        T_world_lidar.append(odometry.last_pose)
    trajectory = Trajectory(
        frames=tuple(s.frame for s in sweeps),
        stamp_ns=np.array([s.stamp_ns for s in sweeps], np.int64),
        T_world_lidar=np.stack(T_world_lidar),
    )
    if rough is not None:  # a first pass may stumble where it starts from rest
        check_plausible(trajectory, settings)
        check_overlap(sweeps, trajectory, settings)
    return trajectory


def _step(rough: Trajectory) -> Float:
    """(4,4) motion of one sweep to the next at the start, from where odometry has caught up."""
    i = min(_NUM_CATCHING_UP, len(rough.frames) - 2)
    return poses.inverse(rough.T_world_lidar[i]) @ rough.T_world_lidar[i + 1]


def _searched_step(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """(4,4) motion of one sweep to the next: the translation on a grid, up to the highest speed,
    that best lays what stands on the ground in the first sweeps upon each other."""
    standing = [_standing(s.points) for s in sweeps[:3]]
    seconds = (sweeps[1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
    num = int(np.clip(settings.max_speed_m_s * seconds / _SEARCH_STEP_M, 0, 20))
    span = np.arange(-num, num + 1) * _SEARCH_STEP_M
    x, y = np.meshgrid(span, span, indexing="ij")
    steps = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    cost = 1e-3 * np.linalg.norm(steps, axis=1)
    for earlier, later in pairwise(standing):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _SEARCH_POINTS + 1]]
        moved = (sample + steps[:, None, :]).reshape(-1, 3)
        distance, _ = cKDTree(earlier).query(moved, distance_upper_bound=1.0, workers=-1)
        cost += np.minimum(distance, 1.0).reshape(len(steps), -1).mean(1)
    return poses.exp(np.append(np.zeros(3), steps[np.argmin(cost)]))


def _standing(points: Float) -> Float:
    """The points above the ground: its rings go with the scanner and hide the motion."""
    if not len(points):
        return points
    cell = np.floor(points[:, :2]).astype(np.int64)
    cell -= cell.min(0)
    lowest = np.full(cell.max(0) + 1, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), points[:, 2])
    standing = points[points[:, 2] > lowest[cell[:, 0], cell[:, 1]] + _STANDING_M]
    return standing if len(standing) else points


def check_plausible(trajectory: Trajectory, settings: RegisterSettings) -> None:
    """Raise SweepError where the trajectory jumps as no vehicle does."""
    step_s = np.diff(trajectory.stamp_ns) * 1e-9
    pairs = list(pairwise(trajectory.frames))
    for (a, b), seconds in zip(pairs, step_s, strict=True):
        if seconds <= 0:
            raise SweepError(
                f"registration: the stamp of frame {b} is not after that of frame {a}, but "
                f"{1e3 * -seconds:.1f} ms before it; expected ascending stamps; check the "
                f"recording's timestamps",
                b,
            )
    T = trajectory.T_world_lidar
    if not np.isfinite(T).all():
        bad = trajectory.frames[int(np.argmin(np.isfinite(T).all((1, 2))))]
        raise SweepError(f"registration: the pose of frame {bad} is not finite", bad)
    steps = [poses.log(poses.inverse(a) @ b) for a, b in pairwise(T)]
    previous_m_s: Float | None = None
    for (a, b), step, seconds in zip(pairs, steps, step_s, strict=True):
        velocity_m_s = step[3:] / seconds
        turn_deg_s = np.rad2deg(np.linalg.norm(step[:3])) / seconds
        slack_m_s = _POSE_NOISE_M / seconds
        speed_m_s = float(np.linalg.norm(velocity_m_s))
        if speed_m_s > settings.max_speed_m_s + slack_m_s or turn_deg_s > _MAX_TURN_RATE_DEG_S:
            raise SweepError(
                f"registration jumps from frame {a} to {b}: {speed_m_s:.0f} m/s and "
                f"{turn_deg_s:.0f} deg/s, expected at most {settings.max_speed_m_s:g} m/s and "
                f"{_MAX_TURN_RATE_DEG_S:.0f} deg/s; {_cure(settings)}",
                b,
            )
        if previous_m_s is not None:
            change_m_s = float(np.linalg.norm(velocity_m_s - previous_m_s))
            if change_m_s > _MAX_ACCELERATION_M_S2 * seconds + slack_m_s:
                raise SweepError(
                    f"registration jumps at frame {a}: the speed changes by {change_m_s:.1f} m/s "
                    f"within {seconds:.2f} s, expected a vehicle's; {_cure(settings)}",
                    a,
                )
        previous_m_s = velocity_m_s


def check_overlap(
    sweeps: Sequence[Sweep], trajectory: Trajectory, settings: RegisterSettings
) -> None:
    """Raise SweepError where a sweep does not lie on the one before it: odometry may glide
    on at the expected speed over sweeps that have nothing to do with each other. Sweeps too sparse
    to tell are passed over."""
    world = [
        poses.transform(T, _standing(s.points))
        for s, T in zip(sweeps, trajectory.T_world_lidar, strict=True)
    ]
    for (a, b), (earlier, later) in zip(pairwise(trajectory.frames), pairwise(world), strict=True):
        if min(len(earlier), len(later)) < _OVERLAP_POINTS // 10:
            continue
        sample = later[:: len(later) // _OVERLAP_POINTS + 1]
        distance, _ = cKDTree(earlier).query(sample, distance_upper_bound=_OVERLAP_M)
        overlap = float(np.isfinite(distance).mean())
        if overlap < settings.min_overlap:
            raise SweepError(
                f"registration fails from frame {a} to {b}: only {100 * overlap:.0f} % of what "
                f"stands there lies on the sweep before, expected at least "
                f"{100 * settings.min_overlap:.0f} %; {_cure(settings)}, or lower "
                f"register.min_overlap",
                b,
            )


def _cure(settings: RegisterSettings) -> str:
    other = "kiss-icp" if settings.source == "dataset" else "dataset"
    return f"choose another key or a smaller window, or other poses (register.source={other})"


def _kiss_icp_config(settings: RegisterSettings, voxel_size_m: float):  # type: ignore[no-untyped-def]
    """Every field set here: KISS-ICP otherwise reads ``kiss_icp_*`` environment variables."""
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
        # One thread: the parallel sum's order, and so its last bits, change from run to run.
        registration=RegistrationConfig(
            max_num_iterations=500, convergence_criterion=1e-4, max_num_threads=1
        ),
        adaptive_threshold=AdaptiveThresholdConfig(
            fixed_threshold=None, initial_threshold=2.0, min_motion_th=0.1
        ),
    )
