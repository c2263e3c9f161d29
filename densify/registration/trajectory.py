# SPDX-License-Identifier: MIT
"""Find and check the poses of consecutive sweeps, recorded or registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.config.errors import InputError, SweepError, UnfitSweepError, UnplacedSweepError
from densify.free_space.ground import find_upright
from densify.geometry import poses
from densify.geometry.nearest import is_near, tree_of
from densify.geometry.types import Float, Int, Sweep, Trajectory
from densify.registration.odometry import (
    FRESH_NS,
    MANY_POINTS,
    MAX_SPEED_M_S,
    above_ground,
    find_odometry,
    register_on_surfaces,
)

MIN_OVERLAP = 0.55
"""Least share of a sweep's points above the ground that overlap the preceding third of a second.

Correct poses gave 0.73 (16 beams, 25 m/s) to 0.98, false poses of a rosette 0.42.
"""
MIN_NUM_POINTS = 1000  # a sweep with fewer cannot be registered


class LeftOut(NamedTuple):
    """The reason why a sweep is not used."""

    reason: str  # sentence for the user
    unreadable: bool  # True if the sweep could not be read, False if it could not be registered
    # True if the sweep's own content prevents registration, as with too few points
    unfit: bool = False

    def error(self, frame: int) -> InputError | SweepError:
        """Return the error to raise if the sweep ``frame`` is indispensable."""
        if self.unreadable:
            return InputError(self.reason)
        return (UnfitSweepError if self.unfit else UnplacedSweepError)(self.reason, frame)


@dataclass(frozen=True)
class Registration:
    """The poses of a block: consecutive sweeps that are registered together."""

    # Trajectories of consecutive sweeps, each in a world of its own, including the lead-in sweeps
    # before the block
    pieces: tuple[Trajectory, ...]
    left_out: Mapping[int, LeftOut]  # frame number -> reason why the sweep is not used


def find_trajectory(
    sweeps: Sequence[Sweep], settings: RegisterSettings, recorded: Trajectory | None = None
) -> Trajectory:
    """Return the poses of raw sweeps: the recorded poses after a check, or registered ones.

    Each sweep is registered with the surfaces of earlier sweeps. If half the sweeps have at least
    30,000 points, KISS-ICP predicts the motion, else constant velocity.

    Args:
        sweeps: Raw sweeps, ascending in time.
        settings: Source of the poses, and range of the points.
        recorded: Recorded poses of these sweeps, None to register them.

    Returns:
        Poses (S,4,4) of the sweeps at their reference times. The world of registered poses is the
            lidar frame of the first sweep.

    Raises:
        UnfitSweepError: The stamps do not ascend, or a sweep has too few points to be registered.
        UnplacedSweepError: A pose is implausible. The message names the frame.
    """
    frames = tuple(sweep.frame for sweep in sweeps)
    stamp_ns = np.array([sweep.stamp_ns for sweep in sweeps], np.int64)
    _check_stamps(frames, stamp_ns)
    if recorded is not None:
        check_plausible(recorded, settings)
        points = [
            poses.transform(T, sweep.points)
            for T, sweep in zip(recorded.T_world_lidar, sweeps, strict=True)
        ]
        check_overlap(points, recorded, settings)
        return replace(recorded, R_level_lidar=find_upright(sweeps))
    _check_number_of_points(sweeps, settings)
    # In sparse sweeps KISS-ICP would align the scan patterns instead of the surfaces.
    is_dense = len(sweeps) > 1 and np.median([len(sweep) for sweep in sweeps]) >= MANY_POINTS
    twists = find_odometry(sweeps, settings) if is_dense else None
    T_world_lidar, points = register_on_surfaces(sweeps, twists)
    trajectory = Trajectory(frames, stamp_ns, T_world_lidar, R_level_lidar=find_upright(sweeps))
    check_plausible(trajectory, settings)
    check_overlap(points, trajectory, settings)
    return trajectory


def _check_number_of_points(sweeps: Sequence[Sweep], settings: RegisterSettings) -> None:
    """Raise UnfitSweepError for a sweep that is too sparse to be registered."""
    for sweep in sweeps:
        if len(sweep) < MIN_NUM_POINTS:
            raise UnfitSweepError(
                f"registration: sweep {sweep.frame} has {len(sweep)} points from "
                f"{settings.min_range_m:g} to {settings.max_range_m:g} m away, expected at least "
                f"{MIN_NUM_POINTS}; choose another key, or ask densify doctor whether they are in "
                f"metres",
                sweep.frame,
            )


def _check_stamps(frames: Sequence[int], stamp_ns: Int) -> None:
    """Raise UnfitSweepError where the stamps do not ascend."""
    for (previous, frame), step_ns in zip(pairwise(frames), np.diff(stamp_ns), strict=True):
        if step_ns <= 0:
            difference = f"{1e-6 * -step_ns:.1f} ms before it" if step_ns else "the same"
            raise UnfitSweepError(
                f"registration: the stamp of frame {frame} is not after that of frame {previous}, "
                f"but {difference}; expected ascending stamps; check the recording's timestamps",
                frame,
            )


def check_plausible(trajectory: Trajectory, settings: RegisterSettings) -> None:
    """Raise UnplacedSweepError if the trajectory has a motion that no vehicle can make."""
    T = trajectory.T_world_lidar
    if not np.isfinite(T).all():
        frame = trajectory.frames[int(np.argmin(np.isfinite(T).all((1, 2))))]
        raise UnplacedSweepError(f"registration: the pose of frame {frame} is not finite", frame)
    previous_twist = None
    for i, (previous_frame, frame) in enumerate(pairwise(trajectory.frames), 1):
        twist = poses.twist_to(T, trajectory.stamp_ns, i)
        step_s = float(trajectory.stamp_ns[i] - trajectory.stamp_ns[i - 1]) * 1e-9
        jump = find_jump(twist, previous_twist, step_s)
        if jump:
            raise UnplacedSweepError(
                f"registration jumps from frame {previous_frame} to {frame}: {jump}; "
                f"{_advice(settings)}",
                frame,
            )
        previous_twist = twist


def find_jump(twist: Float, previous_twist: Float | None, step_s: float) -> str:
    """Return a clause that says why no vehicle can make a step between two sweeps, "" if one can.

    Args:
        twist: (6,) velocity of the step (rad/s, m/s).
        previous_twist: (6,) velocity of the previous step, None if unknown.
        step_s: Duration of the step.
    """
    # Errors of both poses, 0.5 m, appear as a speed, the greater the shorter the step. No vehicle
    # turns by more than 150 degrees a second.
    slack_m_s = 0.5 / step_s
    speed_m_s, turn_deg_s = np.linalg.norm(twist[3:]), np.rad2deg(np.linalg.norm(twist[:3]))
    if not (speed_m_s <= MAX_SPEED_M_S + slack_m_s and turn_deg_s <= 150.0):
        return (
            f"{speed_m_s:.0f} m/s and {turn_deg_s:.0f} deg/s, expected at most "
            f"{MAX_SPEED_M_S:g} m/s and 150 deg/s"
        )
    if previous_twist is None:
        return ""
    change_m_s = float(np.linalg.norm(twist[3:] - previous_twist[3:]))
    # Up to 30 m/s² pass, three times the grip of tyres, for noise of the stamps.
    if change_m_s > 30.0 * step_s + slack_m_s:
        return (
            f"the speed changes by {change_m_s:.1f} m/s within {step_s:.2f} s, expected a vehicle's"
        )
    return ""


def check_overlap(
    points: Sequence[Float], trajectory: Trajectory, settings: RegisterSettings
) -> None:
    """Raise UnplacedSweepError if a sweep overlaps too little with the preceding third of a second.

    Odometry can continue at constant velocity over sweeps of another place. The test needs several
    earlier sweeps, because a scan pattern may not repeat. Sweeps with under 200 points pass.

    Args:
        points: (N,3) of each sweep, deskewed, metres, world.
        trajectory: Poses of these sweeps.
        settings: Source of the poses, for the advice in the message.
    """
    frames, stamp_ns = trajectory.frames, trajectory.stamp_ns
    points_above = [above_ground(sweep_points) for sweep_points in points]
    trees = [tree_of(sweep_points) for sweep_points in points_above]
    for i in range(1, len(points)):
        # At least the previous sweep counts, however long ago it was.
        first_fresh = min(int(np.searchsorted(stamp_ns, stamp_ns[i] - FRESH_NS)), i - 1)
        share = _share_on(points_above[i], trees[first_fresh:i])
        if share < MIN_OVERLAP and stamp_ns[i] - stamp_ns[0] < FRESH_NS:
            # Few sweeps precede sweep i, hence those of the following third of a second count too.
            # They must also hold the points of the sweep before i: otherwise all sweeps from i on
            # could be of another place, and match each other.
            end = int(np.searchsorted(stamp_ns, stamp_ns[i] + FRESH_NS))
            share_on_others = _share_on(points_above[i], [*trees[:i], *trees[i + 1 : end]])
            previous_share = _share_on(points_above[i - 1], trees[i:end])
            share = max(share, min(share_on_others, previous_share))
        if share < MIN_OVERLAP:
            raise UnplacedSweepError(
                f"registration fails from frame {frames[i - 1]} to {frames[i]}: only "
                f"{100 * share:.1f} % of the points above the ground lie on the sweeps before, "
                f"expected at least {100 * MIN_OVERLAP:.1f} %; {_advice(settings)}",
                frames[i],
            )


def _share_on(points: Float, trees: Sequence[cKDTree]) -> float:
    """Return the share of (N,3) points within 0.5 m of any tree's points; 1 for few points."""
    if min(len(points), sum(tree.n for tree in trees)) < 200:
        return 1.0  # too few points for a decision
    sample = points[:: len(points) // 2000 + 1]
    unmatched = sample
    for tree in trees:
        unmatched = unmatched[~is_near(tree, unmatched, 0.5)]
    return 1 - len(unmatched) / len(sample)


def _advice(settings: RegisterSettings) -> str:
    """Return what the user can do about implausible poses."""
    alternative = "kiss-icp" if settings.source == "dataset" else "dataset"
    return (
        f"choose another key or a smaller window, or other poses (register.source={alternative}); "
        f"densify doctor says what is wrong with a recording"
    )
