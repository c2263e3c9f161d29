# SPDX-License-Identifier: MIT
"""All that was seen of a moving object, put together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from densify.flow.tracking.sightings import Track
from densify.kernels.nearest import BoxTree
from densify.types import Bool, Float

_OUTLINE_M = 0.05


@dataclass(frozen=True)
class Shape:
    """The points of one object, in a frame in which it rests upright.

    points: (M,3). tree: of the points. rim: (K,3) some of the points, that reach as far as all in
    any horizontal direction, up and down. edges: (E,3) of the convex outline, normal and offset;
    none where there is no outline.
    """

    points: Float
    tree: BoxTree
    rim: Float
    edges: Float

    @staticmethod
    def of(points: Float) -> Shape:
        """(M,3), M at least 1."""
        try:
            hull = ConvexHull(points[:, :2])
        except (QhullError, ValueError):  # too few points, or all on a line
            return Shape(points, BoxTree(points), points, np.zeros((0, 3)))
        z = points[:, 2]
        rim = points[[*hull.vertices, z.argmin(), z.argmax()]]
        return Shape(points, BoxTree(points), rim, hull.equations)

    def within_outline(self, points: Float) -> Bool:
        """(N,3) in the shape's frame -> (N,) True inside the outline as seen from above."""
        if not len(self.edges):
            return np.zeros(len(points), bool)
        inside: Bool = (points[:, :2] @ self.edges[:, :2].T + self.edges[:, 2] < _OUTLINE_M).all(1)
        return inside


class Body(NamedTuple):
    """An object proven to move, and all that was seen of it."""

    track: Track
    shape: Shape
