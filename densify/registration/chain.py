# SPDX-License-Identifier: MIT
"""Poses of sweeps beyond a window, one after another and in one pass. A door to small_gicp.

Koide et al., "Voxelized GICP for Fast and Accurate 3D Point Cloud Registration", ICRA 2021;
Koide, "small_gicp: Efficient and parallel algorithms for point cloud registration", JOSS 2024.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from densify.config import RegisterSettings
from densify.errors import InputError
from densify.geometry import poses
from densify.registration.deskew import placed
from densify.types import Float, Int, RegisteredSweep, Sweep

_VOXEL_M, _LEAF_M, _NUM_NEIGHBORS = 0.5, 1.0, 10
_MANY_POINTS = 30_000  # before they are thinned to voxels
_MATCH_M = 2.0
_NUM_KNOWN = 6  # sweeps of the window that the map starts with
_LONGEST_GAP_S = 0.4  # between two sweeps of the chain
_TOGETHER = 6  # sweeps that are chosen at the same speed
_MAX_ACCELERATION_M_S2, _POSE_NOISE_M = 30.0, 0.5


def follow(
    known: Sequence[RegisteredSweep],
    frames: Sequence[int],
    stamp_ns: Int,
    read: Callable[[int], Sweep],
    prepare: Callable[[Sequence[int]], None],
    reach_m: float,
    step_m: float,
    settings: RegisterSettings,
) -> Iterator[tuple[Sweep, Float, Float, Float]]:
    """Raw sweeps along the drive, ``T_world_lidar`` (4,4) in the world of those known, and the
    (6,) twists per second before and after its reference time, by which it is to be deskewed.

    known: registered sweeps, the nearest to the others last. frames, stamp_ns: the others,
    ascending or descending in time, beginning beside the last known one. read: a raw sweep.
    prepare: called with frames that are read next. reach_m: of travel. step_m: about from one sweep
    to the next; those between are not read.

    Every sweep is laid on a map of Gaussian voxels made of the sweeps before it, from where it
    would be at constant velocity. The chain ends where a sweep cannot be read, is too sparse, does
    not lie on the map or moves as no vehicle does.
    """
    import small_gicp

    voxels = small_gicp.GaussianVoxelMap(_LEAF_M)
    for s in known[-_NUM_KNOWN:]:
        voxels.insert(_surface(_some(s.sweep)), s.T_world_lidar)
    last = known[-1]
    T_world_lidar, last_ns = last.T_world_lidar, last.sweep.stamp_ns
    backwards = len(frames) > 0 and int(stamp_ns[0]) < last_ns
    twist = last.twist_before if backwards else last.twist_after
    travel_m, row = 0.0, 0
    while travel_m < reach_m and row < len(frames):
        rows = _next_rows(stamp_ns, row, last_ns, step_m, float(np.linalg.norm(twist[3:])))
        prepare([frames[r] for r in rows])
        for r in rows:
            try:
                sweep = read(frames[r])
            except InputError:
                return
            if len(sweep) < settings.min_num_points:
                return
            step_s = (sweep.stamp_ns - last_ns) * 1e-9
            surface = _surface(placed(_some(sweep), T_world_lidar, twist, twist).sweep)
            found = small_gicp.align(
                voxels,
                surface,
                T_world_lidar @ poses.exp(twist * step_s),
                max_correspondence_distance=_MATCH_M,
                num_threads=1,  # the order of a parallel sum changes from run to run
            )
            T_now = np.asarray(found.T_target_source)
            new = poses.log(poses.inverse(T_world_lidar) @ T_now) / step_s
            share = found.num_inliers / max(surface.size(), 1)
            if share < settings.min_overlap or not _plausible(twist, new, step_s, settings):
                return
            travel_m += float(np.linalg.norm(new[3:])) * abs(step_s)
            twist, T_world_lidar, last_ns = new, T_now, sweep.stamp_ns
            voxels.insert(surface, T_world_lidar)
            yield sweep, T_world_lidar, twist, twist
            if travel_m >= reach_m:
                return
        row = rows[-1] + 1


def _next_rows(stamp_ns: Int, row: int, last_ns: int, step_m: float, speed_m_s: float) -> list[int]:
    """The next few sweeps, about ``step_m`` apart at this speed."""
    gap_ns = 1e9 * min(_LONGEST_GAP_S, step_m / max(speed_m_s, 1e-3))
    rows: list[int] = []
    for r in range(row, len(stamp_ns)):
        # One more sweep would be nearer to the gap wanted than this one.
        beyond = abs(int(stamp_ns[min(r + 1, len(stamp_ns) - 1)]) - last_ns)
        if (abs(int(stamp_ns[r]) - last_ns) + beyond) / 2 >= gap_ns:
            rows.append(r)
            last_ns = int(stamp_ns[r])
        if len(rows) == _TOGETHER:
            break
    return rows or [len(stamp_ns) - 1]


def _surface(sweep: Sweep):  # type: ignore[no-untyped-def]
    """Points thinned to voxels, with the covariance of their neighbours."""
    import small_gicp

    return small_gicp.preprocess_points(sweep.points, _VOXEL_M, _NUM_NEIGHBORS, 1)[0]


def _some(sweep: Sweep) -> Sweep:
    """Every few points of a sweep that holds many."""
    step = max(1, len(sweep) // _MANY_POINTS)
    return sweep if step == 1 else sweep.select(slice(None, None, step))


def _plausible(before: Float, after: Float, step_s: float, settings: RegisterSettings) -> bool:
    slack_m_s = _POSE_NOISE_M / abs(step_s)
    change_m_s = float(np.linalg.norm(after[3:] - before[3:]))
    return bool(
        np.isfinite(after).all()
        and np.linalg.norm(after[3:]) <= settings.max_speed_m_s + slack_m_s
        and change_m_s <= _MAX_ACCELERATION_M_S2 * abs(step_s) + slack_m_s
    )
