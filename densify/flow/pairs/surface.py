# SPDX-License-Identifier: MIT
"""Compare points with the surfaces that another cloud measured.

The rings of a scanner hit other parts of an object after it has moved. Therefore a point may lie
anywhere along a surface, but not off it. The neighbours of a position are thinned until they span
several rings, and a normal distribution is fitted to them (Biber, Straßer, "The Normal
Distributions Transform", IROS 2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.flow.tracking.candidates import Strips
from densify.geometry.nearest import thinned, tree_of
from densify.geometry.types import Bool, Float, Int

SURFACE_M = 1.0
"""Greatest distance of a neighbour that spans the surface at a position."""
MISSING = 3.0
"""Cost of a point without surface, and greatest cost."""
_NUM_NEIGHBORS, _MIN_NEIGHBORS = 12, 3
_NOISE_M = 0.1  # of a point and of a motion
_EVEN_M = 0.15  # voxel in which one point is kept, because points are denser along rings


@dataclass(frozen=True)
class PairCloud:
    """The N points of a cloud above the ground."""

    points: Float  # (N,3) metres
    # (N,) share of the motion at the firing time: 0 at the source's reference time, 1 at the
    # target's
    share: Float

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)

    @cached_property
    def _even(self) -> Bool:
        even = np.zeros(len(self.points), bool)
        even[thinned(self.points, np.arange(len(even)), _EVEN_M, 1)] = True
        return even

    def evenly(self, rows: Int) -> Int:
        """Return the rows that are the only ones kept in their voxel of 0.15 m."""
        return rows[self._even[rows]]

    def rows_around(self, points: Float) -> Int:
        """Return the even rows in the box around points (K,3), or within `SURFACE_M` of it."""
        if not len(points):
            return np.zeros(0, np.int64)
        low, high = points.min(axis=0) - SURFACE_M, points.max(axis=0) + SURFACE_M
        return self.evenly(self.strips.rows_inside(low, high))


class Surface:
    """The surfaces around the given points (M,3)."""

    def __init__(self, points: Float) -> None:
        self._points, self._tree = points, tree_of(points)

    def cost(self, points: Float) -> Float:
        """Return (N,) costs of points (N,3), 0 to 3: half their squared Mahalanobis distances."""
        cost, num = np.full(len(points), MISSING), min(_NUM_NEIGHBORS, self._tree.n)
        if num < _MIN_NEIGHBORS:
            return cost
        ranks = np.arange(1, num + 1)
        away_m, row = self._tree.query(points, ranks, distance_upper_bound=SURFACE_M)
        exists = np.isfinite(away_m)
        enough = np.flatnonzero(exists.sum(axis=1) >= _MIN_NEIGHBORS)
        exists, row = exists[enough], np.asarray(row)[enough]
        weight = exists / exists.sum(axis=1, keepdims=True)
        arms = self._points[np.where(exists, row, 0)]
        mean = np.einsum("nk,nki->ni", weight, arms)
        arms -= mean[:, None]
        covariance = arms.transpose(0, 2, 1) @ (weight[..., None] * arms) + _NOISE_M**2 * np.eye(3)
        off = points[enough] - mean
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
        cost[enough] = np.minimum(squared / 2, MISSING)
        return cost
