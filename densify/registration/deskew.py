# SPDX-License-Identifier: MIT
"""Deskewing: move every point of a sweep to where it would be at the sweep's reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, RegisteredSweep, Stretch, Sweep, Trajectory


def deskew(sweeps: Sequence[Sweep], trajectory: Trajectory) -> Stretch:
    """Undo the lidar's own motion within each sweep, and place the sweeps in the world.

    The part of a sweep before its reference time moves with the twist from the previous sweep, the
    part after it with the twist to the next one. A sweep without point times keeps its points.

    sweeps: raw, a subset of the trajectory's frames.
    """
    registered = []
    for sweep in sweeps:
        i = trajectory.frames.index(sweep.frame)
        registered.append(deskew_sweep(sweep, trajectory.T_world_lidar[i], *twists(trajectory, i)))
    return Stretch(tuple(registered))


def deskew_sweep(
    sweep: Sweep, T_world_lidar: Float, twist_before: Float, twist_after: Float
) -> RegisteredSweep:
    """Deskew one raw sweep by the (6,) twists per second before and after its reference time."""
    points: Float = sweep.points
    if sweep.offset_ns is not None:
        offset_s = sweep.offset_ns[:, None] * 1e-9
        twist = np.where(offset_s < 0, twist_before, twist_after)
        points = poses.transform_each(np.asarray(offset_s * twist, np.float64), points)
    deskewed = replace(sweep, points=points)
    return RegisteredSweep(deskewed, T_world_lidar, twist_before, twist_after)


def twists(trajectory: Trajectory, i: int) -> tuple[Float, Float]:
    """Return the (6,) twists per second before and after sweep i; at an end, both are the same."""
    last = len(trajectory.frames) - 1
    if last == 0:
        return np.zeros(6), np.zeros(6)
    T = trajectory.T_world_lidar

    def toward(j: int) -> Float:
        seconds = (trajectory.stamp_ns[j] - trajectory.stamp_ns[i]) * 1e-9
        return poses.twist_between(T[i], T[j], seconds)

    return toward(i - 1 if i > 0 else 1), toward(i + 1 if i < last else i - 1)
