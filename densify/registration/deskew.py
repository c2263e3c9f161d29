# SPDX-License-Identifier: MIT
"""Deskew sweeps: move every point to its position at the sweep's reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, RegisteredSweep, Stretch, Sweep, Trajectory


def deskew(sweeps: Sequence[Sweep], trajectory: Trajectory) -> Stretch:
    """Return raw sweeps at their poses, with the lidar's motion within each sweep removed.

    Points before the reference time move with the velocity from the previous sweep, points after it
    with the velocity to the next sweep. A sweep without point times keeps its points.
    """
    registered = []
    for sweep in sweeps:
        i = trajectory.frames.index(sweep.frame)
        registered.append(deskew_sweep(sweep, trajectory.T_world_lidar[i], *twists(trajectory, i)))
    return Stretch(tuple(registered))


def deskew_sweep(
    sweep: Sweep, T_world_lidar: Float, twist_before: Float, twist_after: Float
) -> RegisteredSweep:
    """Return a deskewed copy of the sweep with its (4,4) pose at the reference time.

    The twists (6,) are the lidar's velocities (rad/s, m/s, lidar frame) before and after that time.
    """
    points: Float = sweep.points
    if sweep.offset_ns is not None:
        offset_s = sweep.offset_ns[:, None] * 1e-9
        twist = np.where(offset_s < 0, twist_before, twist_after)
        points = poses.transform_each(np.asarray(offset_s * twist, np.float64), points)
    deskewed = replace(sweep, points=points)
    return RegisteredSweep(deskewed, T_world_lidar, twist_before, twist_after)


def deskew_points(sweep: Sweep, twist: Float) -> Float:
    """Return the (N,3) points deskewed by a (6,) velocity (rad/s, m/s), lidar frame."""
    return deskew_sweep(sweep, np.eye(4), twist, twist).sweep.points


def twists(trajectory: Trajectory, i: int) -> tuple[Float, Float]:
    """Return the (6,) velocities (rad/s, m/s) before and after sweep i, in its lidar frame.

    At the first and last sweep both are equal.
    """
    last = len(trajectory.frames) - 1
    if last == 0:
        return np.zeros(6), np.zeros(6)
    T = trajectory.T_world_lidar

    def toward(j: int) -> Float:
        seconds = (trajectory.stamp_ns[j] - trajectory.stamp_ns[i]) * 1e-9
        return poses.twist_between(T[i], T[j], seconds)

    return toward(i - 1 if i > 0 else 1), toward(i + 1 if i < last else i - 1)
