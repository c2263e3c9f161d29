# SPDX-License-Identifier: MIT
"""Registration: where the lidar was at every sweep. The one door to KISS-ICP.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify import poses
from densify.config import RegisterSettings
from densify.errors import ComputationError
from densify.types import Float, Sweep, Trajectory

_MAX_ACCELERATION_M_S2 = 30.0  # three times what tyres can do; the rest is noise of the stamps
_MAX_TURN_RATE_DEG_S = 150.0
_POSE_NOISE_M = 0.5


def register(
    sweeps: Sequence[Sweep], settings: RegisterSettings, rough: Trajectory | None = None
) -> Trajectory:
    """Poses of consecutive sweeps by lidar odometry.

    sweeps: ascending frames; raw for a first pass, deskewed for a second one.
    rough: the first pass, whose first step predicts the second sweep of this pass: without it
        odometry has to guess that the vehicle starts from rest.

    World is the first sweep's lidar frame. Raises ComputationError naming the frames where a sweep
    is too sparse to register or the motion is none a vehicle makes.
    """
    from kiss_icp.kiss_icp import KissICP

    for sweep in sweeps:
        if len(sweep) < settings.min_num_points:
            raise ComputationError(
                f"registration: sweep {sweep.frame} has {len(sweep)} points, expected at least "
                f"{settings.min_num_points}; choose another key or lower register.min_num_points"
            )
    odometry = KissICP(_kiss_icp_config(settings))
    if rough is not None and len(rough.frames) > 1:
        odometry.last_delta = poses.inverse(rough.T_world_lidar[0]) @ rough.T_world_lidar[1]
        odometry.last_pose = poses.inverse(odometry.last_delta)
    T_world_lidar = []
    no_stamps = np.empty(0)  # KISS-ICP aborts the process on equal stamps; sweeps are ours to deskew
    for sweep in sweeps:
        odometry.register_frame(sweep.points, no_stamps)
        T_world_lidar.append(odometry.last_pose)
    trajectory = Trajectory(
        frames=tuple(s.frame for s in sweeps),
        stamp_ns=np.array([s.stamp_ns for s in sweeps], np.int64),
        T_world_lidar=np.stack(T_world_lidar),
    )
    check_plausible(trajectory, settings)
    return trajectory


def check_plausible(trajectory: Trajectory, settings: RegisterSettings) -> None:
    """Raise ComputationError where the trajectory jumps as no vehicle does."""
    step_s = np.diff(trajectory.stamp_ns) * 1e-9
    pairs = list(zip(trajectory.frames, trajectory.frames[1:], strict=False))
    for (a, b), seconds in zip(pairs, step_s, strict=True):
        if seconds <= 0:
            raise ComputationError(
                f"registration: the stamp of frame {b} is {-seconds:.3f} s before that of frame {a}; "
                f"expected ascending stamps; check the recording's timestamps"
            )
    T = trajectory.T_world_lidar
    if not np.isfinite(T).all():
        bad = trajectory.frames[int(np.argmin(np.isfinite(T).all((1, 2))))]
        raise ComputationError(f"registration: the pose of frame {bad} is not finite")
    steps = [poses.log(poses.inverse(a) @ b) for a, b in zip(T[:-1], T[1:], strict=True)]
    previous_m_s: Float | None = None
    for (a, b), step, seconds in zip(pairs, steps, step_s, strict=True):
        velocity_m_s = step[3:] / seconds
        turn_deg_s = np.rad2deg(np.linalg.norm(step[:3])) / seconds
        slack_m_s = _POSE_NOISE_M / seconds
        speed_m_s = float(np.linalg.norm(velocity_m_s))
        if speed_m_s > settings.max_speed_m_s + slack_m_s or turn_deg_s > _MAX_TURN_RATE_DEG_S:
            raise ComputationError(
                f"registration jumps from frame {a} to {b}: {speed_m_s:.0f} m/s and "
                f"{turn_deg_s:.0f} deg/s, expected at most {settings.max_speed_m_s:g} m/s and "
                f"{_MAX_TURN_RATE_DEG_S:.0f} deg/s; choose another key, or use the data set's poses "
                f"(register.source=dataset)"
            )
        if previous_m_s is not None:
            change_m_s = float(np.linalg.norm(velocity_m_s - previous_m_s))
            if change_m_s > _MAX_ACCELERATION_M_S2 * seconds + slack_m_s:
                raise ComputationError(
                    f"registration jumps at frame {a}: the speed changes by {change_m_s:.1f} m/s "
                    f"within {seconds:.2f} s, expected a vehicle's; choose another key, or use the "
                    f"data set's poses (register.source=dataset)"
                )
        previous_m_s = velocity_m_s


def _kiss_icp_config(settings: RegisterSettings):  # type: ignore[no-untyped-def]
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
        mapping=MappingConfig(voxel_size=settings.voxel_size_m, max_points_per_voxel=20),
        # One thread: the parallel sum's order, and so its last bits, change from run to run.
        registration=RegistrationConfig(
            max_num_iterations=500, convergence_criterion=1e-4, max_num_threads=1
        ),
        adaptive_threshold=AdaptiveThresholdConfig(
            fixed_threshold=None, initial_threshold=2.0, min_motion_th=0.1
        ),
    )
