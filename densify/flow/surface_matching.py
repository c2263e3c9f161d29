# SPDX-License-Identifier: MIT
"""Align points with a surface by rigid motions about the vertical.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with yaw as the only rotation. A state (4,) is a
displacement x, y, z (m) and a yaw (rad) about an object's centre.
"""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float

GATES_M = np.repeat([0.8, 0.5, 0.3, 0.2, 0.2], 2)  # greatest distance of a match, per round
# Greatest sum of the matches' weights: errors of neighbours on a surface are correlated.
_MAX_WEIGHT = 60.0
NUM_NEAR = 12  # number of neighbours that span a surface
MIN_FIT = 5  # least number of matches
_SURFACE_M = 0.05  # standard deviation of a surface point
_RIDGE = 0.02  # share of the mean variance that is added, for points on a line
# Points of a model, and points that are aligned: more would be neighbours with the same error
_MAX_MODEL_POINTS, _NUM_ALIGNED = 1000, 250
# Factor of the covariance: points of a surface must not stop a motion along the surface.
_LOOSE = 10.0


def apply(state: Float, points: Float, centre: Float) -> Float:
    """Return points (N,3), turned about a centre and displaced by a state (4,) or states (N,4)."""
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def undo(state: Float, points: Float, centre: Float) -> Float:
    """Return the points (N,3) as they were before `apply` with the same state and centre."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(vectors: Float, yaw: float | Float) -> Float:
    """Return vectors (N,3), turned about the vertical by one yaw (rad), or by (N,) yaws."""
    x, y, _ = vectors.T
    cos, sin = np.cos(yaw), np.sin(yaw)
    turned = vectors.copy()
    turned[:, 0] = cos * x - sin * y
    turned[:, 1] = sin * x + cos * y
    return turned


class Model:
    """Accumulated surface of an object, to which new points are aligned."""

    def __init__(self, points: Float) -> None:
        """Start the model with points (N,3), metres, in the object's frame."""
        self.points = np.zeros((0, 3))  # (M,3) object's frame, about 1000 at most, ascending in x
        self.add(points)

    def add(self, points: Float) -> None:
        """Add points (N,3) in the object's frame, in place; above 1000 in all they are thinned."""
        points = np.concatenate([self.points, points])
        points = points[np.argsort(points[:, 0], kind="stable")]
        # contiguous, or the kernels are compiled for both layouts
        self.points = np.ascontiguousarray(points[:: len(points) // _MAX_MODEL_POINTS + 1])
        # (M,3,3) inverse covariances (1/m²) of the surface at the points, NaN until one is needed
        self._information = np.full((len(self.points), 3, 3), np.nan)

    def covers(self, points: Float, within_m: float) -> Bool:
        """Return the (N,) mask of points (N,3, object's frame) within ``within_m`` of the model."""
        covered = np.empty(len(points), np.bool_)
        _are_near(points, self.points, within_m, covered)
        return covered

    def align(
        self, points: Float, centre: Float, predicted: Float, prediction_std: Float
    ) -> Float | None:
        """Return the state (4,) that fits the model to the points, None for fewer than 5 matches.

        Displacement x, y and yaw are solved with Tukey weights. The height z stays as predicted: on
        an object hit by few beams it would follow the beams. Of many points about 250 are used.

        Args:
            points: (N,3) world, metres, all at one time.
            centre: (3,) centre of the rotation, object's frame.
            predicted: (4,) state to start from.
            prediction_std: (3,) standard deviation of the predicted x, y (m) and yaw (rad).
        """
        points = np.ascontiguousarray(points[:: max(1, len(points) // _NUM_ALIGNED)])
        state = predicted.copy()
        prior = prediction_std**-2
        aligned = _align(points, centre, predicted, prior, self.points, self._information, state)
        return state if aligned else None


@inlined
def _nearest(point: Float, surface: Float, within_m: float) -> tuple[int, float]:
    """Return the row in ``surface`` (M,3), ascending in x, and squared distance; -1 for none."""
    # The search starts at the point's x, and ends where x alone is farther than the nearest point.
    nearest_row, nearest_squared = -1, within_m**2
    middle, end = 0, len(surface)
    while middle < end:  # binary search; numpy's takes 0.5 s to compile
        half = (middle + end) // 2
        if surface[half, 0] < point[0]:
            middle = half + 1
        else:
            end = half
    for step in (1, -1):
        row = middle if step > 0 else middle - 1
        while 0 <= row < len(surface):
            x_squared = (surface[row, 0] - point[0]) ** 2
            if x_squared >= nearest_squared:
                break
            squared = (
                x_squared + (surface[row, 1] - point[1]) ** 2 + (surface[row, 2] - point[2]) ** 2
            )
            if squared < nearest_squared:
                nearest_row, nearest_squared = row, squared
            row += step
    return nearest_row, nearest_squared


@Kernel
def _are_near(points: Float, surface: Float, within_m: float, covered: Bool) -> None:
    """Mark points (N,3) within a distance of the surface (M,3, ascending in x) in ``covered``."""
    for i in range(len(points)):
        covered[i] = _nearest(points[i], surface, within_m)[0] >= 0


@Kernel
def _align(
    points: Float,  # (N,3) world
    centre: Float,  # (3,) centre of the rotation, object's frame
    predicted: Float,  # (4,) predicted state
    prior: Float,  # (3,) inverse variances of the predicted x, y and yaw
    surface: Float,  # (M,3) object's frame, ascending in x
    information: Float,  # (M,3,3) of the surface, NaN where it is not known yet
    state: Float,  # (4,) the state to start from, and the result
) -> bool:
    """Fit ``state`` in place, so that the points lie on the surface; False for few matches."""
    # Gauss-Newton (iterated least squares), a step per gate. A point in the object's frame moves by
    # -J d if x, y and yaw of the state change by d. With the inverse covariance A and Tukey's
    # weight w of each match, the step d solves
    #   H d = g
    #   H = Σ w Jᵀ A J
    #   g = Σ w Jᵀ A residual
    J = np.zeros((3, 3))  # rows: x, y, z of the point; columns: x, y, yaw; the row of z stays 0
    from_centre, turned, in_object, residual = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for gate_m in GATES_M:
        # The first two columns of J are the rotation from the world to the object's frame.
        J[0, 0] = J[1, 1] = np.cos(state[3])
        J[0, 1] = np.sin(state[3])
        J[1, 0] = -J[0, 1]
        H, g = np.zeros((3, 3)), np.zeros(3)
        num_matches = 0
        for i in range(len(points)):
            # The point in the object's frame: moved back, then turned back
            for a in range(3):
                from_centre[a] = points[i, a] - centre[a] - state[a]
            turned[0] = J[0, 0] * from_centre[0] + J[0, 1] * from_centre[1]
            turned[1] = J[1, 0] * from_centre[0] + J[1, 1] * from_centre[1]
            turned[2] = from_centre[2]
            for a in range(3):
                in_object[a] = turned[a] + centre[a]
            row, squared = _nearest(in_object, surface, gate_m)
            if row < 0:
                continue
            num_matches += 1
            for a in range(3):
                residual[a] = in_object[a] - surface[row, a]
            if np.isnan(information[row, 0, 0]):
                _inform(surface, row, information[row])
            # A yaw of the state by +d turns the point by -d about the centre, hence the point moves
            # by d (turned y, -turned x). Column 2 of J is minus this vector.
            J[0, 2] = -turned[1]
            J[1, 2] = turned[0]
            weight = (1 - squared / gate_m**2) ** 2
            _add_match(J, information[row], weight, residual, H, g)
        if num_matches < MIN_FIT:
            return False
        # The matches together weigh at most `_MAX_WEIGHT` against the prediction.
        _step(H, g, min(1.0, _MAX_WEIGHT / num_matches), predicted, prior, state)
    return True


@inlined
def _add_match(
    J: Float, information: Float, weight: float, residual: Float, H: Float, g: Float
) -> None:
    """Add w Jᵀ A J of a match to H (3,3), and w Jᵀ A residual to g (3,), in place."""
    A = information
    for a in range(3):
        # Row a of w Jᵀ A; row 2 of J is 0.
        JA_x = weight * (J[0, a] * A[0, 0] + J[1, a] * A[1, 0])
        JA_y = weight * (J[0, a] * A[0, 1] + J[1, a] * A[1, 1])
        JA_z = weight * (J[0, a] * A[0, 2] + J[1, a] * A[1, 2])
        g[a] += JA_x * residual[0] + JA_y * residual[1] + JA_z * residual[2]
        for b in range(3):
            H[a, b] += JA_x * J[0, b] + JA_y * J[1, b]


@inlined
def _step(H: Float, g: Float, weight: float, predicted: Float, prior: Float, state: Float) -> None:
    """Move ``state`` in place to the least-squares fit of the matches and the prediction."""
    # The prediction is one more measurement, with the inverse variances ``prior``. The step d
    # solves (weight H + diag(prior)) d = weight g + prior (predicted - state).
    inverse = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            H[a, b] *= weight
        axis = a if a < 2 else 3  # of the state: x, y, yaw
        H[a, a] += prior[a]
        g[a] = weight * g[a] + prior[a] * (predicted[axis] - state[axis])
    _invert(H, inverse)
    for a in range(3):
        axis = a if a < 2 else 3
        state[axis] += inverse[a, 0] * g[0] + inverse[a, 1] * g[1] + inverse[a, 2] * g[2]


@inlined
def _inform(surface: Float, row: int, information: Float) -> None:
    """Write the inverse covariance (3,3) of the surface (M,3), ascending in x, at one row."""
    # Phase 1: the nearest points (the point itself is among them), sorted by distance. The search
    # goes from the row to both sides, and ends where x alone is farther than the last near point.
    near_row = np.empty(min(NUM_NEAR, len(surface)), np.int64)
    near_squared = np.empty(len(near_row))
    for k in range(len(near_row)):
        near_squared[k] = np.inf
    for step in (1, -1):
        other = row if step > 0 else row - 1
        while 0 <= other < len(surface):
            if (surface[other, 0] - surface[row, 0]) ** 2 >= near_squared[-1]:
                break
            squared = 0.0
            for a in range(3):
                squared += (surface[other, a] - surface[row, a]) ** 2
            if squared < near_squared[-1]:
                # Farther points move up by one place, and the last point is dropped.
                k = len(near_row) - 1
                while k > 0 and near_squared[k - 1] > squared:
                    near_row[k] = near_row[k - 1]
                    near_squared[k] = near_squared[k - 1]
                    k -= 1
                near_row[k] = other
                near_squared[k] = squared
            other += step
    # Phase 2: the covariance of these points
    covariance = np.zeros((3, 3))
    mean = np.zeros(3)
    for near in near_row:
        for a in range(3):
            mean[a] += surface[near, a] / len(near_row)
    for near in near_row:
        for a in range(3):
            for b in range(3):
                product = (surface[near, a] - mean[a]) * (surface[near, b] - mean[b])
                covariance[a, b] += _LOOSE / len(near_row) * product
    # The ridge keeps the covariance invertible where all neighbours lie on a line or in a plane.
    ridge = _SURFACE_M**2 + _RIDGE / 3 * (covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
    for a in range(3):
        covariance[a, a] += ridge
    _invert(covariance, information)


@inlined
def _invert(A: Float, inverse: Float) -> None:
    """Write the inverse of a symmetric matrix A (3,3) to ``inverse`` (3,3), by cofactors."""
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for d in range(3):
            e, f = (d + 1) % 3, (d + 2) % 3
            inverse[a, d] = A[b, e] * A[c, f] - A[b, f] * A[c, e]
    determinant = A[0, 0] * inverse[0, 0] + A[0, 1] * inverse[0, 1] + A[0, 2] * inverse[0, 2]
    for a in range(3):
        for d in range(3):
            inverse[a, d] /= determinant
