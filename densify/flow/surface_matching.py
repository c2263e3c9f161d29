# SPDX-License-Identifier: MIT
"""Align points with a surface by rigid motions about the vertical.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with yaw as the only rotation. A state (4,) is a
displacement x, y, z (m) and a yaw (rad) about an object's centre.
"""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel
from densify.geometry.nearest import nearest, nearest_k, tree_of
from densify.geometry.types import Bool, Float, Int

GATES_M = np.repeat([0.8, 0.5, 0.3, 0.2, 0.2], 2)  # greatest distance of a match, for each step
MAX_WEIGHT = 60.0  # greatest sum over matches; errors of neighbours on a surface are correlated
NUM_NEAR = 12  # neighbours that span a surface
MIN_FIT = 5  # least number of matches
_SURFACE_M = 0.05  # noise of a surface point
_RIDGE = 0.02  # share of the mean variance that is added, for points on a line
_MAX_MODEL_POINTS = 1500
_LOOSE = 10.0  # factor of the covariance: surface points must not stop a slide along the surface


def apply(state: Float, points: Float, centre: Float) -> Float:
    """Return the (N,3) points of an object, turned about its centre and displaced.

    The state is (4,) or, one for each point, (N,4); the centre is (3,) or (N,3).
    """
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def undo(state: Float, points: Float, centre: Float) -> Float:
    """Return the (N,3) points moved back by the inverse of `apply`, with the same arguments."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(arms: Float, yaw: float | Float) -> Float:
    """Return (N,3) vectors ``arms``, turned by ``yaw`` (rad) about the vertical."""
    (x, y, _), c, s = arms.T, np.cos(yaw), np.sin(yaw)
    turned = arms.copy()
    turned[:, 0] = c * x - s * y
    turned[:, 1] = s * x + c * y
    return turned


def surface_information(points: Float, near: Int, loose: float = 1.0) -> Float:
    """Return (N,3,3) the inverse covariance (1/m²) of a surface of points (M,3) at N places.

    ``near`` (N,k) are rows of the neighbours that span the surface. ``loose`` multiplies the
    covariance; above 1 the surface constrains less.
    """
    away = points[near]
    away -= away.mean(axis=1, keepdims=True)
    covariance = loose / near.shape[1] * (away.transpose(0, 2, 1) @ away)
    ridge = _SURFACE_M**2 + _RIDGE / 3 * np.trace(covariance, axis1=1, axis2=2)
    return np.asarray(np.linalg.inv(covariance + ridge[:, None, None] * np.eye(3)))


class Model:
    """Accumulated surface of an object, to which new points are aligned."""

    def __init__(self, points: Float) -> None:
        self.points = np.zeros((0, 3))  # (M,3) object's frame, about 1500 at most
        self.add(points)

    def add(self, points: Float) -> None:
        """Add (N,3) points in the object's frame, thinning all points if there are too many."""
        points = np.concatenate([self.points, points])
        if len(points) > _MAX_MODEL_POINTS:
            points = points[:: len(points) // _MAX_MODEL_POINTS + 1]
        self.points, self._tree = points, tree_of(points)
        _, near = nearest_k(self._tree, points, NUM_NEAR)
        self.information = surface_information(points, near, _LOOSE)

    def covers(self, points: Float, within_m: float) -> Bool:
        """Return (N,) True for (N,3) points (object's frame) within ``within_m`` of the model."""
        distance_m, _ = nearest(self._tree, points, within_m)
        return np.isfinite(distance_m)

    def align(
        self, points: Float, centre: Float, predicted: Float, prediction_std: Float
    ) -> Float | None:
        """Return the state (4,) that fits the model to the points, None for too few matches.

        Displacement x, y and yaw are solved with Tukey weights. The height z stays as predicted: on
        an object hit by few beams it would follow the beams.

        Args:
            points: (N,3) world, metres, all at one time.
            centre: (3,) centre of the rotation, object's frame.
            predicted: (4,) state to start from.
            prediction_std: (3,) standard deviation of the predicted x, y (m) and yaw (rad).
        """
        state, prior = predicted.copy(), prediction_std**-2
        for gate_m in GATES_M:
            at_model = undo(state, points, centre)
            distance_m, row = nearest(self._tree, at_model, gate_m)
            num = np.count_nonzero(row >= 0)
            if num < MIN_FIT:
                return None
            most, yaw = min(1.0, MAX_WEIGHT / num), float(state[3])
            H, g = np.diag(prior), prior * (predicted - state)[[0, 1, 3]]
            off, share = at_model - self.points[row], distance_m / gate_m
            _add_matches(at_model - centre, off, row, share, self.information, yaw, most, H, g)
            state[[0, 1, 3]] += np.linalg.solve(H, g)
        return state


@Kernel
def _add_matches(
    arms: Float,  # (N,3) from the centre to the points, object's frame
    off: Float,  # (N,3) from the matched model points to the points
    row: Int,  # (N,) matched model points, -1 for none
    share: Float,  # (N,) distance to the match as a share of the greatest distance
    information: Float,  # (M,3,3) of the model points
    yaw: float,
    most: float,  # greatest weight of a match
    H: Float,
    g: Float,
) -> None:
    """Add the normal equations of x, y and yaw to H (3,3) and g (3,), in place."""
    J, JA = np.empty((2, 3, 3))  # J: derivative of the model's point by x, y and yaw
    J[:] = 0.0
    J[0, 0] = J[1, 1] = np.cos(yaw)
    J[0, 1] = np.sin(yaw)
    J[1, 0] = -J[0, 1]
    for i in range(len(row)):
        if row[i] < 0:
            continue
        A, weight = information[row[i]], most * (1 - share[i] ** 2) ** 2
        J[0, 2], J[1, 2] = -arms[i, 1], arms[i, 0]
        for a in range(3):
            for b in range(3):
                JA[a, b] = weight * (J[0, a] * A[0, b] + J[1, a] * A[1, b])
            g[a] += JA[a, 0] * off[i, 0] + JA[a, 1] * off[i, 1] + JA[a, 2] * off[i, 2]
            for b in range(3):
                H[a, b] += JA[a, 0] * J[0, b] + JA[a, 1] * J[1, b]
