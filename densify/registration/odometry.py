# SPDX-License-Identifier: MIT
"""Registration: where the lidar was at every sweep. The one door to KISS-ICP.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.config.errors import InputError, SweepError, UnfitSweepError, UnplacedSweepError
from densify.geometry import poses
from densify.geometry.types import Float, Int, Sweep, Trajectory

_MAX_ACCELERATION_M_S2 = 30.0  # three times what tyres can do; the rest is noise of the stamps
_MAX_TURN_RATE_DEG_S = 150.0
_POSE_NOISE_M = 0.5
_NUM_CATCHING_UP = 3  # sweeps registered, however far apart in time
_SEARCH_STEP_M, _SEARCH_STEP_S = 0.5, 0.1  # in a shorter time less in proportion
_SEARCH_POINTS = 800
_SEARCH_CLOSE_M = 1.0
_SEARCH_RAYS_RAD = (
    0.01  # what stands along the road is met by the same rays, however fast one drives
)
_STANDS_M_S, _DRIVES_M_S, _MUCH_BETTER = 2.0, 5.0, 0.6  # by radial velocities, by the search
_STANDING_M = 0.4
_OVERLAP_POINTS = 2000
_OVERLAP_M = 0.5
_OVERLAP_NS = 350_000_000  # within it a pattern that does not repeat fills its view
# Change of a sweep's pose (rad and m) below which it counts as found. The first pass only has to
# find the motion within a sweep: 3 mm over 0.1 s bend its ends by 1.5 mm. The second one starts
# `densify.registration.surfaces`: with 3 mm left there too, a highway of 32 rings slides by 0.1 m.
_ROUGHLY_CONVERGED = 3e-3
_CONVERGED = 5e-4


def register(
    sweeps: Sequence[Sweep],
    settings: RegisterSettings,
    rough: Trajectory | None = None,
) -> Trajectory:
    """Poses of sweeps by lidar odometry.

    sweeps: ascending in time; some of a recording's may be missing between them. Raw for a first
        pass, deskewed for a second one.
    rough: the first pass of the same sweeps. The second one searches around it, so that it can
        work with fine voxels and a narrow kernel. Without it the voxels are twice as large, each
        sweep is searched for where the vehicle would be if it kept its velocity; the first one by
        `searched_twist`, since odometry takes every start for standing still.

    World is the first sweep's lidar frame. Raises UnfitSweepError naming the frame where a sweep
    is too sparse to register or the stamps do not ascend. Whether the motion is one that a vehicle
    makes say `check_plausible` and `check_overlap`; a first pass may stumble where it starts from
    rest.
    """
    from kiss_icp.kiss_icp import KissICP

    frames = tuple(s.frame for s in sweeps)
    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
    check_number_of_points(sweeps, settings)
    check_stamps(frames, stamp_ns)
    step_s = np.diff(stamp_ns) * 1e-9
    voxel_size_m = settings.voxel_size_m * (2 if rough is None else 1)
    odometry = KissICP(_kiss_icp_config(settings, voxel_size_m, rough is not None))
    # KISS-ICP aborts the process on equal stamps; sweeps are ours to deskew
    no_stamps = np.empty(0)
    T_world_lidar: list[Float] = []
    for i, sweep in enumerate(sweeps):
        if i:
            if rough is not None:
                twist = _twist(rough, min(max(i - 1, _NUM_CATCHING_UP), len(sweeps) - 2))
            elif i == 1:
                twist = searched_twist(sweeps, settings)
            else:
                twist = poses.log(odometry.last_delta) / step_s[i - 2]
            odometry.last_delta = poses.exp(twist * step_s[i - 1])
        odometry.register_frame(sweep.points, no_stamps)
        T_world_lidar.append(odometry.last_pose)
    return Trajectory(frames, stamp_ns, np.stack(T_world_lidar))


def check_number_of_points(sweeps: Sequence[Sweep], settings: RegisterSettings) -> None:
    """Raise UnfitSweepError for a sweep too sparse to be placed."""
    for sweep in sweeps:
        if len(sweep) < settings.min_num_points:
            raise UnfitSweepError(
                f"registration: sweep {sweep.frame} has {len(sweep)} points from "
                f"{settings.min_range_m:g} to {settings.max_range_m:g} m away, expected at least "
                f"{settings.min_num_points}; choose another key or lower register.min_num_points, "
                f"or ask densify doctor whether they are in metres",
                sweep.frame,
            )


def _twist(trajectory: Trajectory, i: int) -> Float:
    """(6,) per second from sweep i to the next."""
    T = trajectory.T_world_lidar
    seconds = (trajectory.stamp_ns[i + 1] - trajectory.stamp_ns[i]) * 1e-9
    return poses.log(poses.inverse(T[i]) @ T[i + 1]) / seconds


def searched_twist(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """(6,) per second at the start: the velocity, up to the highest speed and without rotation,
    that best lays what stands on the ground in the first sweeps upon each other. Distances below
    the gap between rays count as none: a guard rail looks the same from a vehicle at rest and from
    one that follows it.

    Tried on a grid whose steps move the second sweep by 1 m, and around the best by 0.5 m, or less
    where it follows within 0.1 s.
    """
    cost = _misfit(sweeps)
    first_s = (sweeps[1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
    step_m = _SEARCH_STEP_M * min(1.0, first_s / _SEARCH_STEP_S)
    coarse_m = _grid(np.zeros(2), settings.max_speed_m_s * first_s, 2 * step_m)
    coarse = coarse_m[np.argmin(cost(coarse_m))]
    fine_m = _grid(coarse[:2], 2 * step_m, step_m)
    return np.append(np.zeros(3), fine_m[np.argmin(cost(fine_m))] / first_s)


def _misfit(sweeps: Sequence[Sweep]) -> Callable[[Float], Float]:
    """How badly (n,3) motions between the first two sweeps lay what stands on the ground in the
    first three upon each other; of equal ones the slowest is best."""
    standing = [_standing(s.points) for s in sweeps[:3]]
    first_s = (sweeps[1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(standing)):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _SEARCH_POINTS + 1]]
        ratio = (sweeps[i + 1].stamp_ns - sweeps[i].stamp_ns) * 1e-9 / first_s
        apart_m = _SEARCH_RAYS_RAD * np.linalg.norm(sample, axis=1)
        pairs.append((_tree(earlier), sample, ratio, apart_m))

    def cost(steps_m: Float) -> Float:
        sums = 1e-3 * np.linalg.norm(steps_m, axis=1)
        for tree, sample, ratio, apart_m in pairs:
            moved = (sample + ratio * steps_m[:, None, :]).reshape(-1, 3)
            distance_m, _ = tree.query(moved, distance_upper_bound=_SEARCH_CLOSE_M, workers=-1)
            distance_m = np.minimum(distance_m, _SEARCH_CLOSE_M).reshape(len(steps_m), -1)
            sums += np.maximum(distance_m - apart_m, 0.0).mean(1)
        return sums

    return cost


def check_measured(
    sweeps: Sequence[Sweep], velocity_m_s: Float, settings: RegisterSettings
) -> None:
    """Raise InputError where the first sweeps say that radial velocities are no such: the other way
    round they lie better on each other, or the vehicle drives where (3,) says that it stands, as if
    its own motion had been taken out."""
    if len(sweeps) < 2:
        return
    first_s = (sweeps[1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
    speed_m_s = float(np.linalg.norm(velocity_m_s))
    if speed_m_s >= _STANDS_M_S:
        other_m_s, seen, share = -velocity_m_s, "the opposite", 1.0
    else:
        other_m_s, share = searched_twist(sweeps, settings)[3:], _MUCH_BETTER
        other_speed_m_s = float(np.linalg.norm(other_m_s))
        if other_speed_m_s <= _DRIVES_M_S:
            return
        seen = f"{other_speed_m_s:.0f} m/s"
    own, other = _misfit(sweeps)(np.stack([velocity_m_s, other_m_s]) * first_s)
    if other < share * own:
        raise InputError(
            f"registration: by the radial velocities of sweep {sweeps[0].frame} the scanner goes "
            f"at {speed_m_s:.1f} m/s, by what stands at {seen}; expected m/s away from the scanner "
            f"and relative to it, as measured; change their sign, leave the vehicle's own motion "
            f"in, or leave the column out"
        )


def _grid(center: Float, reach_m: float, step_m: float) -> Float:
    """(n,3) horizontal motions around a center (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(center[0] + span, center[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def _tree(points: Float) -> cKDTree:
    """A tree for few queries: they take less time than balancing it would."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _standing(points: Float) -> Float:
    """The points above the ground: its rings go with the scanner and hide the motion."""
    if not len(points):
        return points
    x, y, z = points.T
    row, column = (np.floor(along).astype(np.int64) for along in (x, y))
    row, column = row - row.min(), column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    standing = points.take(np.flatnonzero(z > lowest[cell] + _STANDING_M), axis=0)
    return standing if len(standing) else points


def check_stamps(frames: Sequence[int], stamp_ns: Int) -> None:
    """Raise UnfitSweepError where time does not go on."""
    for (a, b), step_ns in zip(pairwise(frames), np.diff(stamp_ns), strict=True):
        if step_ns <= 0:
            found = f"{1e-6 * -step_ns:.1f} ms before it" if step_ns else "the same"
            raise UnfitSweepError(
                f"registration: the stamp of frame {b} is not after that of frame {a}, but "
                f"{found}; expected ascending stamps; check the recording's timestamps",
                b,
            )


def check_plausible(trajectory: Trajectory, settings: RegisterSettings) -> None:
    """Raise UnplacedSweepError where the trajectory jumps as no vehicle does."""
    check_stamps(trajectory.frames, trajectory.stamp_ns)
    step_s = np.diff(trajectory.stamp_ns) * 1e-9
    pairs = list(pairwise(trajectory.frames))
    T = trajectory.T_world_lidar
    if not np.isfinite(T).all():
        bad = trajectory.frames[int(np.argmin(np.isfinite(T).all((1, 2))))]
        raise UnplacedSweepError(f"registration: the pose of frame {bad} is not finite", bad)
    steps = [poses.log(poses.inverse(a) @ b) for a, b in pairwise(T)]
    previous_m_s: Float | None = None
    for (a, b), step, seconds in zip(pairs, steps, step_s, strict=True):
        velocity_m_s = step[3:] / seconds
        turn_deg_s = np.rad2deg(np.linalg.norm(step[:3])) / seconds
        slack_m_s = _POSE_NOISE_M / seconds
        speed_m_s = float(np.linalg.norm(velocity_m_s))
        if speed_m_s > settings.max_speed_m_s + slack_m_s or turn_deg_s > _MAX_TURN_RATE_DEG_S:
            raise UnplacedSweepError(
                f"registration jumps from frame {a} to {b}: {speed_m_s:.0f} m/s and "
                f"{turn_deg_s:.0f} deg/s, expected at most {settings.max_speed_m_s:g} m/s and "
                f"{_MAX_TURN_RATE_DEG_S:.0f} deg/s; {_cure(settings)}",
                b,
            )
        if previous_m_s is not None:
            change_m_s = float(np.linalg.norm(velocity_m_s - previous_m_s))
            if change_m_s > _MAX_ACCELERATION_M_S2 * seconds + slack_m_s:
                raise UnplacedSweepError(
                    f"registration jumps at frame {a}: the speed changes by {change_m_s:.1f} m/s "
                    f"within {seconds:.2f} s, expected a vehicle's; {_cure(settings)}",
                    a,
                )
        previous_m_s = velocity_m_s


def is_plausible(trajectory: Trajectory, settings: RegisterSettings) -> bool:
    """Whether a vehicle moves so, see `check_plausible`."""
    try:
        check_plausible(trajectory, settings)
    except SweepError:
        return False
    return True


def check_overlap(
    sweeps: Sequence[Sweep], trajectory: Trajectory, settings: RegisterSettings
) -> None:
    """Raise UnplacedSweepError where a sweep does not lie on those of the last third of a second:
    odometry may glide on at the expected speed over sweeps that have nothing to do with each other.
    The one sweep before would do for rings, but not for a pattern that does not repeat; where less
    than a third of a second was before, the next third must lie there both ways. Sweeps too sparse
    to tell are passed over."""
    frames, stamp_ns = trajectory.frames, trajectory.stamp_ns

    def standing(i: int) -> Float:
        return poses.transform(trajectory.T_world_lidar[i], _standing(sweeps[i].points))

    before: deque[tuple[int, cKDTree]] = deque()
    for i in range(len(sweeps)):
        points = standing(i)
        while len(before) > 1 and stamp_ns[i] - before[0][0] > _OVERLAP_NS:
            before.popleft()
        trees = [tree for _, tree in before]
        share = _share_on(points, trees)
        if share < settings.min_overlap and stamp_ns[i] - stamp_ns[0] < _OVERLAP_NS:
            end = np.searchsorted(stamp_ns, stamp_ns[i] + _OVERLAP_NS)
            after = [_tree(standing(j)) for j in range(i + 1, int(end))]
            own = _tree(points)
            both_ways = min(
                _share_on(points, trees + after), _share_on(standing(i - 1), [own, *after])
            )
            share = max(share, both_ways)
        if share < settings.min_overlap:
            raise UnplacedSweepError(
                f"registration fails from frame {frames[i - 1]} to {frames[i]}: only "
                f"{100 * share:.1f} % of what stands there lies on the sweeps before, expected at "
                f"least {100 * settings.min_overlap:.1f} %; lower register.min_overlap, or "
                f"{_cure(settings)}",
                frames[i],
            )
        before.append((int(stamp_ns[i]), _tree(points)))


def _share_on(points: Float, trees: Sequence[cKDTree]) -> float:
    """The share of (N,3) points that lie on one of the sweeps; 1 for too few to tell."""
    if min(len(points), sum(tree.n for tree in trees)) < _OVERLAP_POINTS // 10:
        return 1.0
    left = points[:: len(points) // _OVERLAP_POINTS + 1]
    num = len(left)
    for tree in trees:
        distance, _ = tree.query(left, distance_upper_bound=_OVERLAP_M)
        left = left[~np.isfinite(distance)]
    return 1 - len(left) / num


def _cure(settings: RegisterSettings) -> str:
    other = "kiss-icp" if settings.source == "dataset" else "dataset"
    return (
        f"choose another key or a smaller window, or other poses (register.source={other}); "
        f"densify doctor says what is wrong with a recording"
    )


def _kiss_icp_config(  # type: ignore[no-untyped-def]
    settings: RegisterSettings, voxel_size_m: float, second_pass: bool
):
    """Every field set here: KISS-ICP otherwise reads ``kiss_icp_*`` environment variables.

    In the second pass the kernel is as wide as a voxel (matches count up to three times that): it
    starts from the first pass, not from a guess whose error KISS-ICP would have to learn.
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
        # One thread: the parallel sum's order, and so its last bits, change from run to run.
        registration=RegistrationConfig(
            max_num_iterations=500,
            convergence_criterion=_CONVERGED if second_pass else _ROUGHLY_CONVERGED,
            max_num_threads=1,
        ),
        adaptive_threshold=AdaptiveThresholdConfig(
            fixed_threshold=voxel_size_m if second_pass else None,
            initial_threshold=2.0,
            min_motion_th=0.1,
        ),
    )
