# SPDX-License-Identifier: MIT
"""Deskewing: move every point of a sweep to where it would be at the sweep's reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.compiled import Kernel
from densify.geometry.types import Float, RegisteredSweep, Stretch, Sweep, Trajectory

_SMALL_RAD = 1e-3  # below it the sine's series is exact


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
        points = np.empty(points.shape)
        twist = np.stack([twist_before, twist_after])
        _move.over_rows(len(points), sweep.points, sweep.offset_ns * 1e-9, twist, points)
    deskewed = replace(sweep, points=points)
    registered = RegisteredSweep(deskewed, T_world_lidar, twist_before, twist_after)
    if sweep.radial_velocity_m_s is None:
        return registered
    ray, own_m_s = registered.rays()
    over_ground = sweep.radial_velocity_m_s + np.einsum("ni,ni->n", ray, own_m_s)
    measured = replace(deskewed, radial_velocity_m_s=over_ground.astype(np.float32))
    return replace(registered, sweep=measured)


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


@Kernel
def _move(begin, end, points, offset_s, twists, moved):  # type: ignore[no-untyped-def]
    """Fill ``moved`` (N,3) with ``exp(offset · twist) @ point``.

    The sums are in the order of SciPy's Rotation, for the same bits.

    points: (N,3). offset_s: (N,). twists: (2,6) for offsets below 0 and for the others.
    """
    for i in range(begin, end):
        time_s = offset_s[i]
        twist = twists[0 if time_s < 0 else 1]
        rx, ry, rz = time_s * twist[0], time_s * twist[1], time_s * twist[2]
        angle = np.sqrt(rx * rx + ry * ry + rz * rz)
        if angle <= _SMALL_RAD:
            square = angle * angle
            scale = 0.5 - square / 48 + square * square / 3840
        else:
            scale = np.sin(angle / 2) / angle
        x, y, z, w = scale * rx, scale * ry, scale * rz, np.cos(angle / 2)
        xx, yy, zz, ww = x * x, y * y, z * z, w * w
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        ahead = (xx - yy - zz + ww) * a + 2 * (x * z + y * w) * c + 2 * (x * y - z * w) * b
        left = 2 * (x * y + z * w) * a + 2 * (y * z - x * w) * c + (-xx + yy - zz + ww) * b
        up = 2 * (x * z - y * w) * a + (-xx - yy + zz + ww) * c + 2 * (y * z + x * w) * b
        moved[i, 0] = ahead + time_s * twist[3]
        moved[i, 1] = left + time_s * twist[4]
        moved[i, 2] = up + time_s * twist[5]
