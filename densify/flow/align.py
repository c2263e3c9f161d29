# SPDX-License-Identifier: MIT
"""Aligning points with an object's accumulated shape, by translation and yaw.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with the vertical as the only axis to turn
about and no motion along it: what moves on the ground hardly tilts within a second, and rises and
falls as the ground does. Free to climb, what few beams hit climbs with the beams.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from densify.types import Bool, Float

GATES_M = (0.8, 0.5, 0.3, 0.2, 0.2)
MIN_FIT = 5  # points
_MAX_MODEL_POINTS = 1500
_SURFACE_M = 0.05  # noise of a surface point
_MAX_WEIGHT = 60.0
_OUTLINE_M = 0.05
_LOOSE = 10.0  # along the surface: sliding along it must not be held up by its own points
_PLANAR = [0, 1, 3]


class Model:
    """An object's accumulated points with the inverse covariance of the surface around each."""

    def __init__(self, points: Float) -> None:
        self.points = np.zeros((0, 3))
        self.add(points)

    def add(self, points: Float) -> None:
        points = np.concatenate([self.points, points])
        if len(points) > _MAX_MODEL_POINTS:
            points = points[:: len(points) // _MAX_MODEL_POINTS + 1]
        self.points = points
        self._prepare()

    def nearest(self, points: Float, within_m: float) -> tuple[Float, np.ndarray]:
        """Distance to the nearest model point, inf beyond ``within_m``, and its index."""
        distance, index = self._tree.query(points, distance_upper_bound=within_m)
        return np.asarray(distance), np.asarray(index)

    def _prepare(self) -> None:
        self._tree = cKDTree(self.points)
        k = min(12, len(self.points))
        _, near = self._tree.query(self.points, k)
        x = self.points[np.reshape(near, (len(self.points), k))]
        x = x - x.mean(1, keepdims=True)
        covariance = _LOOSE * np.einsum("nki,nkj->nij", x, x) / k
        scale = np.trace(covariance, axis1=1, axis2=2)[:, None, None] / 3
        noise = _SURFACE_M**2 * np.eye(3)
        self.information = np.linalg.inv(covariance + noise + 0.02 * scale * np.eye(3))


def align(
    model: Model, points: Float, centre: Float, predicted: Float, prediction_std: Float
) -> Float | None:
    """The state (4,) in which the model covers the points: x y z displacement (m) and yaw (rad).

    points: (N,3), all at one time. centre: (3,) about which the object turns. predicted: (4,) where
    to start, trusted within ``prediction_std`` (3,) in x y and yaw, and altogether in z. None where
    too few points have a partner.
    """
    state = predicted.copy()
    for gate_m in GATES_M:
        for _ in range(2):
            at_model = undo(state, points, centre)
            distance, nearest = model.nearest(at_model, gate_m)
            near = np.isfinite(distance)
            if near.sum() < MIN_FIT:
                return None
            matched = nearest[near]
            weight = _robust(distance[near] / gate_m)[:, None, None]
            state[_PLANAR] += _gauss_newton(
                at_model[near] - centre,
                at_model[near] - model.points[matched],
                model.information[matched] * weight,
                state[3],
                (predicted - state)[_PLANAR],
                prediction_std,
            )
    return state


def _robust(distance: Float) -> Float:
    """Tukey's weights of distances as shares of the gate, all together at most ``_MAX_WEIGHT``:
    neighbours on a surface do not err independently."""
    weight: Float = (1 - distance**2) ** 2
    return weight * min(1.0, _MAX_WEIGHT / len(weight))


def _gauss_newton(
    arm: Float,
    residual: Float,
    information: Float,
    yaw: float,
    to_prediction: Float,
    prediction_std: Float,
) -> Float:
    """(3,) step of x y and yaw that lowers the weighted residuals and stays near the prediction.

    arm: (N,3) of the points about the centre, residual: (N,3) to the model, both in the model's
    orientation. information: (N,3,3).
    """
    prior = 1 / prediction_std**2
    J = np.zeros((len(arm), 3, 3))
    J[:, :, :2] = -_turned(np.eye(3)[:2], -yaw).T
    J[:, 0, 2], J[:, 1, 2] = arm[:, 1], -arm[:, 0]
    JA = np.einsum("nik,nij->nkj", J, information)
    H = np.einsum("nkj,njl->kl", JA, J) + np.diag(prior)
    g = np.einsum("nkj,nj->k", JA, residual) - prior * to_prediction
    return -np.linalg.solve(H, g)


def apply(state: Float, points: Float, centre: Float) -> Float:
    """(4,) or (N,4), (N,3) -> (N,3) the object's points in that state."""
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def undo(state: Float, points: Float, centre: Float) -> Float:
    """Inverse of `apply`."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(arms: Float, yaw: float | Float) -> Float:
    """(N,3), () or (N,) -> (N,3) about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = arms.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def within_outline(at: Float, outline: Float) -> Bool:
    """(N,2), (M,2) -> (N,) True inside the convex hull, where there is one."""
    try:
        hull = ConvexHull(outline)
    except (QhullError, ValueError):  # too few points, or all on a line
        return np.zeros(len(at), bool)
    return (at @ hull.equations[:, :2].T + hull.equations[:, 2] < _OUTLINE_M).all(1)
