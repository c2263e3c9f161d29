# SPDX-License-Identifier: MIT
"""Deskewing: every point of a sweep where it would have been at the sweep's reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, RegisteredSweep, Stretch, Sweep, Trajectory
from densify.registration import deskewing as kernels


def deskew(sweeps: Sequence[Sweep], trajectory: Trajectory) -> Stretch:
    """Undo the lidar's own motion within each sweep, and place the sweeps in the world.

    sweeps: raw, a subset of the trajectory's frames. The half of a sweep before
    its reference time moves with the twist from the previous sweep, the half after it with the
    twist to the next one. Sweeps without per-point times keep their points as they are.
    All columns stay aligned.
    """
    registered = []
    for sweep in sweeps:
        i = trajectory.frames.index(sweep.frame)
        registered.append(placed(sweep, trajectory.T_world_lidar[i], *twists(trajectory, i)))
    return Stretch(tuple(registered))


def placed(sweep: Sweep, T_world_lidar: Float, before: Float, after: Float) -> RegisteredSweep:
    """The raw sweep deskewed, by the (6,) twists per second before and after its reference time."""
    points: Float = sweep.points
    if sweep.offset_ns is not None:
        points = np.empty(points.shape)
        kernels.move.over_rows(
            len(points), sweep.points, sweep.offset_ns * 1e-9, np.stack([before, after]), points
        )
    straight = RegisteredSweep(replace(sweep, points=points), T_world_lidar, before, after)
    if sweep.radial_velocity_m_s is None:
        return straight
    ray, own_m_s = straight.rays()
    over_ground = sweep.radial_velocity_m_s + np.einsum("ni,ni->n", ray, own_m_s)
    measured = replace(straight.sweep, radial_velocity_m_s=over_ground.astype(np.float32))
    return replace(straight, sweep=measured)


def twists(trajectory: Trajectory, i: int) -> tuple[Float, Float]:
    """(6,) per second before and after sweep i; at an end both are the one that exists."""

    def toward(j: int) -> Float | None:
        if not 0 <= j < len(trajectory.frames):
            return None
        seconds = (trajectory.stamp_ns[j] - trajectory.stamp_ns[i]) * 1e-9
        T = trajectory.T_world_lidar
        return poses.log(poses.inverse(T[i]) @ T[j]) / seconds

    before, after = toward(i - 1), toward(i + 1)
    if before is None and after is None:
        return np.zeros(6), np.zeros(6)
    return (
        before if before is not None else after,  # type: ignore[return-value]
        after if after is not None else before,
    )
