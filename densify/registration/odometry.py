# SPDX-License-Identifier: MIT
"""Lidar odometry of dense sweeps by KISS-ICP, in two passes.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.types import Float, Int, Sweep, Trajectory
from densify.registration.deskew import deskew
from densify.registration.start_speed import search_twist

_NUM_CATCHING_UP = 3  # sweeps registered, however far apart in time
# Change of a sweep's pose (rad and m) below which KISS-ICP stops. The first pass only has to find
# the motion within a sweep: 3 mm over 0.1 s bend its ends by 1.5 mm. The second pass is the start
# of `densify.registration.surfaces`: with 3 mm there too, a highway of 32 rings slides by 0.1 m.
_FIRST_PASS, _SECOND_PASS = 3e-3, 5e-4


def find_odometry(
    sweeps: Sequence[Sweep], settings: RegisterSettings
) -> tuple[Trajectory, list[Sweep]]:
    """Return the trajectory of raw, dense sweeps, and the sweeps deskewed by the first pass.

    Sweeps of a fast scanner are grouped in time (`densify.geometry.clock.Clock.batches`), so that
    sparse sweeps are not registered against each other. One by one, the sweeps of a highway at
    20 Hz look as if the vehicle stood: 19 m off after 0.75 s.

    sweeps: ascending in time, one or more.
    """
    stamp_ns, frames = _stamps_ns(sweeps), tuple(s.frame for s in sweeps)
    groups = [list(rows) for rows in Clock(stamp_ns).batches()]
    grouped = len(groups) not in (1, len(sweeps))
    if grouped:
        together = [[sweeps[i] for i in rows] for rows in groups]
        joined = [_joined(group, [s.points for s in group]) for group in together]
        rough = _between(register(joined, settings), frames, stamp_ns)
    else:
        rough = register(sweeps, settings)
    deskewed = [s.sweep for s in deskew(sweeps, rough).sweeps]
    if not grouped:
        return register(deskewed, settings, rough), deskewed
    middles_ns = np.array([_middle_ns(stamp_ns[rows]) for rows in groups])
    start = _between(rough, tuple(frames[rows[0]] for rows in groups), middles_ns)
    joined = []
    for rows, T_world_joined in zip(groups, start.T_world_lidar, strict=True):
        T_joined_world, members = poses.inverse(T_world_joined), [deskewed[i] for i in rows]
        T_joined_lidar = T_joined_world @ rough.T_world_lidar[rows]
        points = [
            poses.transform(T, s.points) for s, T in zip(members, T_joined_lidar, strict=True)
        ]
        joined.append(_joined(members, points))
    return _between(register(joined, settings, start), frames, stamp_ns), deskewed


def register(
    sweeps: Sequence[Sweep], settings: RegisterSettings, rough: Trajectory | None = None
) -> Trajectory:
    """Register sweeps one after the other with KISS-ICP; the world is the first sweep's lidar.

    The first pass starts each sweep at constant velocity, the first one at `search_twist`, because
    KISS-ICP assumes a start at rest. Its voxels are twice as large.

    sweeps: ascending in time; raw in the first pass, deskewed in the second.
    rough: the trajectory of the first pass, around which the second pass searches.
    """
    from kiss_icp.kiss_icp import KissICP

    stamp_ns = _stamps_ns(sweeps)
    step_s = np.diff(stamp_ns) * 1e-9
    voxel_size_m = settings.voxel_size_m * (2 if rough is None else 1)
    odometry = KissICP(_kiss_icp_config(settings, voxel_size_m, rough is not None))
    no_stamps = np.empty(0)  # KISS-ICP aborts the process on equal stamps; we deskew ourselves
    T_world_lidar: list[Float] = []
    for i, sweep in enumerate(sweeps):
        if i:
            if rough is not None:
                twist = _twist(rough, min(max(i - 1, _NUM_CATCHING_UP), len(sweeps) - 2))
            elif i == 1:
                twist = search_twist(sweeps)
            else:
                twist = poses.log(odometry.last_delta) / step_s[i - 2]
            odometry.last_delta = poses.exp(twist * step_s[i - 1])
        odometry.register_frame(sweep.points, no_stamps)
        T_world_lidar.append(odometry.last_pose)
    return Trajectory(tuple(s.frame for s in sweeps), stamp_ns, np.stack(T_world_lidar))


def _twist(trajectory: Trajectory, i: int) -> Float:
    """Return the (6,) twist per second from sweep i to the next."""
    seconds = (trajectory.stamp_ns[i + 1] - trajectory.stamp_ns[i]) * 1e-9
    T = trajectory.T_world_lidar
    return poses.twist_between(T[i], T[i + 1], seconds)


def _joined(sweeps: Sequence[Sweep], points: Sequence[Float]) -> Sweep:
    """Return all points as one sweep in the middle of the sweeps' reference times."""
    together = np.concatenate(points)
    num = len(together)
    return Sweep(
        sweeps[0].frame,
        _middle_ns(_stamps_ns(sweeps)),
        together,
        np.zeros(num, np.float32),
        None,
        np.zeros(num, np.uint8),
        np.arange(num, dtype=np.int64),
    )


def _between(known: Trajectory, frames: tuple[int, ...], stamp_ns: Int) -> Trajectory:
    """Interpolate poses at other times, at constant velocity between the known ones and beyond."""
    T_world_lidar = []
    for time_ns in stamp_ns:
        later = int(np.searchsorted(known.stamp_ns, time_ns, side="right"))
        k = min(max(later, 1), len(known.stamp_ns) - 1) - 1
        a_ns, b_ns = known.stamp_ns[k : k + 2]
        a, b = known.T_world_lidar[k : k + 2]
        T_world_lidar.append(poses.interpolate(a, b, (time_ns - a_ns) / (b_ns - a_ns)))
    return Trajectory(frames, stamp_ns, np.stack(T_world_lidar))


def _middle_ns(stamp_ns: Int) -> int:
    return int(stamp_ns[0] + (stamp_ns[-1] - stamp_ns[0]) // 2)


def _stamps_ns(sweeps: Sequence[Sweep]) -> Int:
    return np.array([s.stamp_ns for s in sweeps], np.int64)


def _kiss_icp_config(  # type: ignore[no-untyped-def]
    settings: RegisterSettings, voxel_size_m: float, second_pass: bool
):
    """Set every field here: KISS-ICP otherwise reads ``kiss_icp_*`` environment variables.

    In the second pass the kernel is as wide as a voxel, because the first pass is a good start.
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
