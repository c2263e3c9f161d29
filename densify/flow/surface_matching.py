# SPDX-License-Identifier: MIT
"""Align points with a surface by rigid motions about the vertical.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with yaw as the only rotation. A state (4,) is a
displacement x, y, z (m) and a yaw (rad) about an object's centre.
"""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.nearest import nearest_k, tree_of
from densify.geometry.types import Bool, Float, Int

GATES_M = np.repeat([0.8, 0.5, 0.3, 0.2, 0.2], 2)
MAX_WEIGHT = 60.0  # greatest sum over matches; errors of neighbours on a surface are correlated
NUM_NEAR = 12  # neighbours that span a surface
MIN_FIT = 5  # least number of matches
_SURFACE_M = 0.05  # noise of a surface point
_RIDGE = 0.02  # share of the mean variance that is added, for points on a line
_MAX_MODEL_POINTS, _NUM_ALIGNED = 1000, 250  # neighbours on a surface have the same error
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


def surface_information(points: Float, rows: Int, loose: float = 1.0) -> Float:
    """Return (N,3,3) the inverse covariance (1/m²) of a surface of points (M,3) at N places.

    ``rows`` (N,k) are those of the neighbours that span the surface. ``loose`` multiplies the
    covariance; above 1 the surface constrains less.
    """
    offset = points[rows]
    offset -= offset.mean(axis=1, keepdims=True)
    covariance = loose / rows.shape[1] * (offset.transpose(0, 2, 1) @ offset)
    ridge = _SURFACE_M**2 + _RIDGE / 3 * np.trace(covariance, axis1=1, axis2=2)
    return np.asarray(np.linalg.inv(covariance + ridge[:, None, None] * np.eye(3)))


class Model:
    """Accumulated surface of an object, to which new points are aligned."""

    def __init__(self, points: Float) -> None:
        self.points = np.zeros((0, 3))  # (M,3) object's frame, about 1000 at most, ascending in x
        self.add(points)

    def add(self, points: Float) -> None:
        """Add (N,3) points in the object's frame, thinning all points if there are too many."""
        points = np.concatenate([self.points, points])
        points = points[np.argsort(points[:, 0], kind="stable")]
        # contiguous, or the kernels are compiled for both layouts
        self.points = np.ascontiguousarray(points[:: len(points) // _MAX_MODEL_POINTS + 1])
        _, rows = nearest_k(tree_of(self.points), self.points, NUM_NEAR)
        self.information = surface_information(self.points, rows, _LOOSE)

    def covers(self, points: Float, within_m: float) -> Bool:
        """Return (N,) True for (N,3) points (object's frame) within ``within_m`` of the model."""
        covered = np.empty(len(points), np.bool_)
        _are_near(points, self.points, within_m, covered)
        return covered

    def align(
        self, points: Float, centre: Float, predicted: Float, prediction_std: Float
    ) -> Float | None:
        """Return the state (4,) that fits the model to the points, None for too few matches.

        Displacement x, y and yaw are solved with Tukey weights. The height z stays as predicted: on
        an object hit by few beams it would follow the beams. Of many points some 250 are used.

        Args:
            points: (N,3) world, metres, all at one time.
            centre: (3,) centre of the rotation, object's frame.
            predicted: (4,) state to start from.
            prediction_std: (3,) standard deviation of the predicted x, y (m) and yaw (rad).
        """
        points = np.ascontiguousarray(points[:: max(1, len(points) // _NUM_ALIGNED)])
        state, prior = predicted.copy(), prediction_std**-2
        for gate_m in GATES_M:
            H, g = np.zeros((3, 3)), np.zeros(3)
            num = _add_matches(points, state, centre, self.points, self.information, gate_m, H, g)
            if num < MIN_FIT:
                return None
            weight = min(1.0, MAX_WEIGHT / num)
            H = weight * H + np.diag(prior)
            g = weight * g + prior * (predicted - state)[[0, 1, 3]]
            state[[0, 1, 3]] += np.linalg.solve(H, g)
        return state


@inlined
def _nearest(point: Float, surface: Float, within_m: float) -> tuple[int, float]:
    """Return the row of the nearest surface point (-1 for none nearer), and its square distance."""
    # The surface ascends in x: only rows whose x is near enough are compared.
    row, square = -1, within_m**2
    middle = np.searchsorted(surface[:, 0], point[0])
    for step in (1, -1):
        i = middle if step > 0 else middle - 1
        while 0 <= i < len(surface):
            along = (surface[i, 0] - point[0]) ** 2
            if along >= square:
                break
            apart = along + (surface[i, 1] - point[1]) ** 2 + (surface[i, 2] - point[2]) ** 2
            if apart < square:
                row, square = i, apart
            i += step
    return row, square


@Kernel
def _are_near(points: Float, surface: Float, within_m: float, covered: Bool) -> None:
    """Write to ``covered`` (N,) whether a surface point is within ``within_m`` of each point."""
    for i in range(len(points)):
        covered[i] = _nearest(points[i], surface, within_m)[0] >= 0


@Kernel
def _add_matches(
    points: Float,  # (N,3) world
    state: Float,
    centre: Float,
    surface: Float,  # (M,3) object's frame, ascending in x
    information: Float,  # (M,3,3) of the surface
    gate_m: float,  # greatest distance of a match
    H: Float,
    g: Float,
) -> int:
    """Add the normal equations of x, y and yaw to H (3,3) and g (3,); return how many match."""
    J, JA = np.empty((2, 3, 3))  # J: derivative of the model's point by x, y and yaw
    J[:] = 0.0
    J[0, 0] = J[1, 1] = np.cos(state[3])
    J[0, 1] = np.sin(state[3])
    J[1, 0] = -J[0, 1]
    at_model, arm, off = np.empty((3, 3))
    num = 0
    for i in range(len(points)):
        for a in range(3):
            off[a] = points[i, a] - centre[a] - state[a]
        arm[0] = J[0, 0] * off[0] + J[0, 1] * off[1]
        arm[1] = J[1, 0] * off[0] + J[1, 1] * off[1]
        arm[2] = off[2]
        for a in range(3):
            at_model[a] = arm[a] + centre[a]
        row, square = _nearest(at_model, surface, gate_m)
        if row < 0:
            continue
        num += 1
        A, weight = information[row], (1 - square / gate_m**2) ** 2
        J[0, 2], J[1, 2] = -arm[1], arm[0]
        for a in range(3):
            off[a] = at_model[a] - surface[row, a]
        for a in range(3):
            for b in range(3):
                JA[a, b] = weight * (J[0, a] * A[0, b] + J[1, a] * A[1, b])
            g[a] += JA[a, 0] * off[0] + JA[a, 1] * off[1] + JA[a, 2] * off[2]
            for b in range(3):
                H[a, b] += JA[a, 0] * J[0, b] + JA[a, 1] * J[1, b]
    return num
