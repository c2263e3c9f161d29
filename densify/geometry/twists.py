# SPDX-License-Identifier: MIT
"""Move points with constant velocities, each point for a time of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float
from densify.geometry.compiled import Kernel


def move_with_twists(
    points: Float, seconds: NDArray[np.floating], twist_before: Float, twist_after: Float
) -> Float:
    """Return the points (N,3), metres, each moved by ``exp(seconds * twist)`` for its own time.

    Args:
        points: (N,3) metres.
        seconds: (N,) time for which each point moves, negative for a motion backwards.
        twist_before: (6,) velocity (rad/s, m/s) of points with negative seconds.
        twist_after: (6,) velocity of the other points.
    """
    twists = np.array([twist_before, twist_after], np.float64)
    speed_rad_s = np.linalg.norm(twists[:, :3], axis=1)
    axes = twists[:, :3] / np.where(speed_rad_s > 0, speed_rad_s, 1)[:, None]
    moved = np.empty(points.shape)
    _move.over_rows(
        len(points),
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(seconds, np.float64),
        axes,
        speed_rad_s,
        twists[:, 3:].copy(),
        moved,
    )
    return moved


@Kernel
def _move(begin, end, points, seconds, axes, speed_rad_s, velocity_m_s, moved):  # type: ignore[no-untyped-def]
    """Fill ``moved`` (N,3) by the formula of Rodrigues, with one axis (2,3) for each sign."""
    # p' = p + sin(wt) a×p + (1 - cos(wt)) a×(a×p) + t v, with axis a, angular speed w, velocity v
    for i in range(begin, end):
        t = seconds[i]
        w = 0 if t < 0 else 1
        ax, ay, az = axes[w, 0], axes[w, 1], axes[w, 2]
        sin, versine = np.sin(speed_rad_s[w] * t), 1 - np.cos(speed_rad_s[w] * t)
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cx, cy, cz = ay * z - az * y, az * x - ax * z, ax * y - ay * x  # axis x point
        moved[i, 0] = x + sin * cx + versine * (ay * cz - az * cy) + t * velocity_m_s[w, 0]
        moved[i, 1] = y + sin * cy + versine * (az * cx - ax * cz) + t * velocity_m_s[w, 1]
        moved[i, 2] = z + sin * cz + versine * (ax * cy - ay * cx) + t * velocity_m_s[w, 2]
