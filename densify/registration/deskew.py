# SPDX-License-Identifier: MIT
"""Remove the lidar's motion within a sweep, and detect sweeps that are compensated already.

Rings are cones about the spin axis only as seen from the scanner's position at each firing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.clock import share_of_turn
from densify.geometry.twists import move_with_twists
from densify.geometry.types import Float, Int, RegisteredSweep, Stretch, Sweep, Trajectory


def deskew(sweeps: Sequence[Sweep], trajectory: Trajectory) -> Stretch:
    """Return raw sweeps at their poses, with the lidar's motion within each sweep removed.

    Points fired before the reference time move with the velocity from the previous sweep, later
    points with the velocity to the next sweep. A sweep without point times keeps its points.

    Args:
        sweeps: Raw sweeps, ascending in time.
        trajectory: Poses of at least these sweeps.
    """
    registered = []
    for sweep in sweeps:
        i = trajectory.frames.index(sweep.frame)
        registered.append(deskew_sweep(sweep, trajectory.T_world_lidar[i], *twists(trajectory, i)))
    return Stretch(tuple(registered))


def deskew_sweep(
    sweep: Sweep, T_world_lidar: Float, twist_before: Float, twist_after: Float
) -> RegisteredSweep:
    """Return a deskewed copy of a sweep together with its pose.

    Args:
        sweep: The raw sweep. Without point times its points stay as they are.
        T_world_lidar: (4,4) pose of the lidar at the reference time.
        twist_before: (6,) velocity (rad/s, m/s) of the lidar before that time, lidar frame.
        twist_after: (6,) velocity of the lidar after that time.
    """
    points: Float = sweep.points
    if sweep.offset_ns is not None:
        points = move_with_twists(points, sweep.offset_ns * 1e-9, twist_before, twist_after)
    deskewed = replace(sweep, points=points)
    return RegisteredSweep(deskewed, T_world_lidar, twist_before, twist_after)


def deskew_points(sweep: Sweep, twist: Float) -> Float:
    """Return a sweep's points (N,3) deskewed by one velocity (6,), rad/s and m/s, lidar frame."""
    return deskew_sweep(sweep, np.eye(4), twist, twist).sweep.points


def twists(trajectory: Trajectory, i: int) -> tuple[Float, Float]:
    """Return the lidar's velocities (6,), rad/s and m/s, before and after sweep i, lidar frame.

    At an end of the trajectory both are equal, and 0 if it has a single sweep.
    """
    T, stamp_ns, last = trajectory.T_world_lidar, trajectory.stamp_ns, len(trajectory.frames) - 1
    if last == 0:
        return np.zeros(6), np.zeros(6)
    twist_before, twist_after = (
        poses.twist_between(T[i], T[neighbour], (stamp_ns[neighbour] - stamp_ns[i]) * 1e-9)
        for neighbour in (i - 1 if i > 0 else 1, i + 1 if i < last else i - 1)
    )
    return twist_before, twist_after


LEAST_SHARPNESS = 4.0  # least sharpness of a scanner with distinct rings
CLEARLY = 1.25  # least ratio of two sharpnesses that counts as a difference
LEAST_SPEED_M_S = 1.5  # slower motion does not smear the rings
COMPENSATED_M = 25.0  # range within which motion during the sweep is visible


class Rings(NamedTuple):
    """The `sharpness` of a sweep's rings under three assumptions; 1 for points spread evenly."""

    as_stored: float  # sharpness of the points as they are
    undone: float  # sharpness after undoing a motion compensation to ``moment``
    done: float  # sharpness after compensating the motion
    moment: str  # time, in words, to which that compensation moved the points

    @property
    def are_distinct(self) -> bool:
        """True if the rings are sharp enough for a conclusion."""
        return max(self.as_stored, self.undone) >= LEAST_SHARPNESS

    @property
    def are_compensated(self) -> bool:
        """True if the motion within the sweep is compensated already."""
        return self.are_distinct and self.undone > CLEARLY * self.as_stored


def sharpness(points: Float, origin_m: Float, bins: int = 1) -> float:
    """Return how sharply points are concentrated in rings, as seen from an origin.

    Elevations are divided into cells, and about 100 cells form a window. Sharpness is the
    probability that two returns of a window share a cell, relative to an even spread, which has 1.
    The median over the windows keeps flat ground, which lies in one window, from dominating.

    Args:
        points: (N,3) metres, in axes with z along the spin axis.
        origin_m: (3,) assumed position of the scanner, in the same axes.
        bins: Height of a cell, in multiples of 0.02 degrees.
    """
    x, y, z = (points - origin_m).T
    elevation = np.arctan2(z, np.hypot(x, y))
    cell_rad = bins * np.deg2rad(0.02)
    window_cells = max(8, 100 // bins)  # number of cells of a window
    num_windows = -(-int(np.pi / cell_rad + 1) // window_cells)  # rounded up
    cell = ((elevation + 0.5 * np.pi) / cell_rad).astype(np.int64)
    counts = np.bincount(cell, minlength=num_windows * window_cells).astype(np.float64)
    counts = counts.reshape(num_windows, window_cells)
    totals = counts.sum(axis=1)
    is_populated = totals > 0.01 * len(points)  # windows of fewer returns are ruled by chance
    if not is_populated.any():
        return 1.0
    # Two returns share a cell with probability Σ (count / total)², if even 1 / window_cells.
    probability = (counts[is_populated] ** 2).sum(axis=1) / totals[is_populated] ** 2
    return float(np.median(probability) * window_cells)


def rings_by_motion(
    points: Float, offset_s: Float, twist: Float, R: Float, origins_m: Sequence[Float]
) -> Rings:
    """Return the sharpness of a sweep's rings, as stored and with the motion undone or compensated.

    Args:
        points: (N,3) metres, lidar frame, as stored.
        offset_s: (N,) firing times since the stamp.
        twist: (6,) velocity of the lidar (rad/s, m/s), lidar frame.
        R: (3,3) rotation from the lidar axes to the scanner's axes.
        origins_m: Positions (3,) of the scanner to try, in its axes; the sharpest counts.
    """

    def best_sharpness(moved: Float) -> float:
        return max(sharpness(moved @ R.T, origin_m) for origin_m in origins_m)

    def move(since_s: Float) -> Float:
        return move_with_twists(points, since_s, twist, twist)

    # It is unknown to which time within the sweep the points were compensated.
    moments_s = {
        "its stamp": 0.0,
        "its first point": float(offset_s.min()),
        "its last point": float(offset_s.max()),
    }
    sharpness_undone = {
        moment: best_sharpness(move(moment_s - offset_s)) for moment, moment_s in moments_s.items()
    }
    sharpest_moment = max(sharpness_undone, key=sharpness_undone.__getitem__)
    return Rings(
        as_stored=best_sharpness(points),
        undone=sharpness_undone[sharpest_moment],
        done=best_sharpness(move(offset_s)),
        moment=sharpest_moment,
    )


def sample_rows(sweep: Sweep, far_m: float) -> Int:
    """Return the rows of at most 20,000 returns of a sweep that are 3 to ``far_m`` metres away."""
    range_m = np.linalg.norm(sweep.points, axis=1)
    rows = np.flatnonzero((range_m > 3.0) & (range_m < far_m))  # nearer may be the vehicle
    return rows[:: len(rows) // 20_000 + 1]


def turning_s(points: Float, period_s: float) -> Float:
    """Return the firing times (N,) of points, in seconds since the stamp, by their azimuth.

    They hold for a clockwise turn of ``period_s`` whose middle, straight ahead, is at the stamp.
    """
    return share_of_turn(points) * period_s


def find_compensated(sweep: Sweep, twist: Float, period_s: float) -> Rings | None:
    """Return the rings of a raw sweep that is compensated for motion already, else None.

    None is also returned if the vehicle is too slow, or if no scanner has distinct rings.

    Args:
        sweep: The raw sweep.
        twist: (6,) velocity of the lidar (rad/s, m/s), lidar frame.
        period_s: Time of one revolution, used for sweeps without point times.
    """
    if np.linalg.norm(twist[3:]) < LEAST_SPEED_M_S:
        return None
    for lidar in np.unique(sweep.lidar).tolist():
        returns = sweep.select(sweep.lidar == lidar)
        rows = sample_rows(returns, COMPENSATED_M)
        R = returns.axes(lidar)
        if not len(rows):
            continue
        if returns.offset_ns is None:
            offset_s = turning_s(returns.points[rows], period_s)
        else:
            offset_s = np.asarray(returns.offset_ns[rows] * 1e-9, np.float64)
        # The HDL-64E of KITTI has two separate blocks of lasers. Its rings are sharpest from 0.2 m
        # above.
        heights_m = np.linspace(-0.3, 0.3, 13)
        origins_m = [R @ returns.origin_m(lidar) + [0.0, 0.0, height_m] for height_m in heights_m]
        rings = rings_by_motion(returns.points[rows], offset_s, twist, R, origins_m)
        if rings.are_compensated:
            return rings
    return None
