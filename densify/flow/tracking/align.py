# SPDX-License-Identifier: MIT
"""Aligning points with an object's accumulated shape, by translation and yaw.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009, with the vertical as the only axis to turn
about and no motion along it: what moves on the ground hardly tilts within a second, and rises and
falls as the ground does. Free to climb, what few beams hit climbs with the beams.
"""

from __future__ import annotations

import numpy as np

from densify.flow.surface_matching import GATES_M, MAX_WEIGHT, NUM_NEAR, RIDGE, SURFACE_M
from densify.geometry.clouds import surface_information
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Bool, Float

MIN_FIT = 5  # points
_MAX_MODEL_POINTS = 1500
_LOOSE = 10.0  # along the surface: sliding along it must not be held up by its own points


class Model:
    """An object's accumulated points with the inverse covariance of the surface around each.

    height_weight: how much heights count of what distances in the plane do.
    """

    def __init__(self, points: Float, height_weight: float = 1.0) -> None:
        self.points = np.zeros((0, 3))
        self._scale = np.array([1.0, 1.0, height_weight])
        self.add(points)

    def add(self, points: Float) -> None:
        points = np.concatenate([self.points, points])
        if len(points) > _MAX_MODEL_POINTS:
            points = points[:: len(points) // _MAX_MODEL_POINTS + 1]
        self.points = np.ascontiguousarray(points)
        flat = np.ascontiguousarray(self.points * self._scale)
        self._tree = BoxTree(flat)
        _, near = self._tree.nearest_k(flat, min(NUM_NEAR, len(flat)))
        self.information = surface_information(flat, near, _LOOSE, SURFACE_M, RIDGE)

    def covers(self, points: Float, within_m: float) -> Bool:
        """(N,3) -> (N,) which points have some of the model so near."""
        distance_m, _ = self._tree.nearest(points * self._scale, within_m)
        return np.isfinite(distance_m)

    def align(
        self, points: Float, centre: Float, predicted: Float, prediction_std: Float
    ) -> Float | None:
        """The state (4,) in which the model covers the points: x y z displacement (m), yaw (rad).

        points: (N,3), all at one time. centre: (3,) about which the object turns. predicted: (4,)
        where to start, trusted within ``prediction_std`` (3,) in x y and yaw, and altogether in z.
        None where too few points have a partner.

        Tukey's weights, all together at most ``MAX_WEIGHT``: neighbours on a surface do not err
        independently.
        """
        scale = np.append(self._scale, 1.0)
        state = self._tree.align(
            points * self._scale,
            self.information,
            centre * self._scale,
            predicted * scale,
            1 / prediction_std**2,
            np.repeat(GATES_M, 2),
            MAX_WEIGHT,
            MIN_FIT,
        )
        return None if state is None else state / scale
