# SPDX-License-Identifier: MIT
"""Rigid motions about the vertical, and alignment of points with a surface.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with yaw as the only rotation. A state (4,) is a
displacement x y z (m) and a yaw (rad) about an object's centre.
"""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel
from densify.geometry.nearest import nearest, nearest_k, tree_of
from densify.geometry.types import Bool, Float, Int

GATES_M = np.repeat([0.8, 0.5, 0.3, 0.2, 0.2], 2)  # greatest distance of a match, step by step
MAX_WEIGHT = 60.0  # of all matches together: neighbours on a surface do not err independently
NUM_NEAR = 12  # neighbours that span a surface
MIN_FIT = 5  # matches
_SURFACE_M = 0.05  # noise of a surface point
_RIDGE = 0.02  # of the mean variance, for points on a line
_MAX_MODEL_POINTS = 1500
_MANY_ALIGNED = 300  # more do not locate an object better, as their weight is bounded
_LOOSE = 10.0  # of the covariance: sliding along a surface must not be held up by its own points


def apply(state: Float, points: Float, centre: Float) -> Float:
    """Move (N,3) points of an object by a state (4,) or by one state each (N,4).

    centre: (3,) or (N,3).
    """
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def undo(state: Float, points: Float, centre: Float) -> Float:
    """Inverse of `apply`."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(arms: Float, yaw: float | Float) -> Float:
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = arms.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def surface_information(points: Float, near: Int, loose: float = 1.0) -> Float:
    """Return (N,3,3) the inverse covariance (1/m²) of the surface around each point.

    points: (M,3). near: (N,k) rows of each point's neighbours. loose: factor of the covariance.
    """
    away = points[near]
    away -= away.mean(axis=1, keepdims=True)
    covariance = loose / near.shape[1] * (away.transpose(0, 2, 1) @ away)
    ridge = _SURFACE_M**2 + _RIDGE / 3 * np.trace(covariance, axis1=1, axis2=2)
    return np.asarray(np.linalg.inv(covariance + ridge[:, None, None] * np.eye(3)))


class Model:
    """The accumulated points of an object, to which other points are aligned."""

    def __init__(self, points: Float) -> None:
        self.points = np.zeros((0, 3))
        self.add(points)

    def add(self, points: Float) -> None:
        """Add (N,3) points in the object's frame."""
        points = np.concatenate([self.points, points])
        if len(points) > _MAX_MODEL_POINTS:
            points = points[:: len(points) // _MAX_MODEL_POINTS + 1]
        self.points, self._tree = points, tree_of(points)
        _, near = nearest_k(self._tree, points, NUM_NEAR)
        self.information = surface_information(points, near, _LOOSE)

    def covers(self, points: Float, within_m: float) -> Bool:
        """Return (N,) True for the (N,3) points closer to the model than ``within_m``."""
        distance_m, _ = nearest(self._tree, points, within_m)
        return np.isfinite(distance_m)

    def align(
        self, points: Float, centre: Float, predicted: Float, prediction_std: Float
    ) -> Float | None:
        """Return the state (4,) in which the model fits the points; None for too few matches.

        The height is not aligned: what few beams hit would climb with the beams. Weights are
        Tukey's.

        points: (N,3), all at one time. centre: (3,). predicted: (4,) where to start.
        prediction_std: (3,) standard deviation of the predicted x, y (m) and yaw (rad).
        """
        points = points[:: len(points) // _MANY_ALIGNED + 1]
        state, prior = predicted.copy(), prediction_std**-2
        for gate_m in GATES_M:
            at_model = undo(state, points, centre)
            distance_m, row = nearest(self._tree, at_model, gate_m)
            H, g = np.diag(prior), prior * (predicted - state)[[0, 1, 3]]
            arms = at_model - centre
            off = at_model - self.points[row]
            num = _add_matches(
                arms, off, row, distance_m / gate_m, self.information, float(state[3]), H, g
            )
            if num < MIN_FIT:
                return None
            state[[0, 1, 3]] += np.linalg.solve(H, g)
        return state


@Kernel
def _add_matches(
    arms: Float,
    off: Float,
    row: Int,
    away: Float,
    information: Float,
    yaw: float,
    H: Float,
    g: Float,
) -> int:
    """Add the normal equations of the matches to H (3,3) and g (3,), in place.

    arms: (N,3) m, from the centre to the points, in the model's frame. off: (N,3) m, from their
    matches. row: (N,) of the matches in the model, -1 for none. away: (N,) distance as a share of
    the gate. information: (M,3,3) of the model's points. yaw: rad, of the object.

    Returns the number of matches.
    """
    num = 0
    for i in range(len(row)):
        num += row[i] >= 0
    scale = min(1.0, MAX_WEIGHT / max(num, 1))
    cos, sin = np.cos(yaw), np.sin(yaw)
    J, JA = np.zeros((3, 3)), np.zeros((3, 3))  # J: of the model's point by x, y and yaw
    J[0, 0], J[1, 0], J[0, 1], J[1, 1] = cos, -sin, sin, cos
    for i in range(len(row)):
        if row[i] < 0:
            continue
        A, weight = information[row[i]], scale * (1 - away[i] ** 2) ** 2
        J[0, 2], J[1, 2] = -arms[i, 1], arms[i, 0]
        for a in range(3):
            for c in range(3):
                JA[a, c] = weight * (J[0, a] * A[0, c] + J[1, a] * A[1, c])
        for a in range(3):
            g[a] += JA[a, 0] * off[i, 0] + JA[a, 1] * off[i, 1] + JA[a, 2] * off[i, 2]
            for b in range(3):
                H[a, b] += JA[a, 0] * J[0, b] + JA[a, 1] * J[1, b]
    return num
