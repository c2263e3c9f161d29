# SPDX-License-Identifier: MIT
"""Rigid motions about the vertical, and what their aligners take for a match with a surface.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with yaw as the only rotation. Two aligners find
such motions: that of an object's points with its accumulated shape (`densify.flow.tracking.align`),
whose height the ground tells, and that of many groups at once between two clouds, whose points were
measured at times of their own and whose height is free (`densify.flow.pairs.hypotheses`).
"""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float

GATES_M = (0.8, 0.5, 0.3, 0.2, 0.2)  # distances of partners, in turn, twice each
SURFACE_M = 0.05  # noise of a surface point
MAX_WEIGHT = 60.0  # of all matches together: neighbours on a surface do not err independently
NUM_NEAR = 12  # neighbours that tell a surface
RIDGE = 0.02  # of their mean variance, where they lie on a line


def apply(state: Float, points: Float, centre: Float) -> Float:
    """The object's points (N,3) in a state, or one each: x y z displacement (m) and yaw (rad) about
    ``centre``. state: (4,), (1,4) or (N,4). centre: (3,) or (N,3)."""
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def undo(state: Float, points: Float, centre: Float) -> Float:
    """Inverse of `apply`."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(arms: Float, yaw: float | Float) -> Float:
    """(N,3), () or (N,) -> (N,3) about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = arms.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)
