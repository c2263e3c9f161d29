# SPDX-License-Identifier: MIT
"""All that was seen of a moving object, put together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from densify.flow.tracking.sightings import Track
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Bool, Float

_OUTLINE_M = 0.05
_LONG_M = 3.0
_QUARTERS_RAD = np.arange(4) * np.pi / 2
_SOME_POINTS, _ANGLE_DEG, _BIN_M = 1000, 0.5, 0.05


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

    @cached_property
    def side_rad(self) -> float:
        """The direction of one of its sides as seen from above, in [0, pi / 2); the other ones lie
        along or across: where points seen along both fall together the most (the sum of squares of
        the two histograms)."""
        points = self.points[:: len(self.points) // _SOME_POINTS + 1, :2]
        points = points - points.mean(axis=0)
        reach_m = float(np.linalg.norm(points, axis=1).max())
        num = int(2 * reach_m / _BIN_M) + 2
        angles = np.arange(0.0, 90.0, _ANGLE_DEG) * np.pi / 180
        together = np.zeros(len(angles))
        for axis in (0.0, np.pi / 2):
            across = np.outer(np.cos(angles + axis), points[:, 0])
            across += np.outer(np.sin(angles + axis), points[:, 1])
            place = ((across + reach_m) / _BIN_M).astype(np.int64)
            place += num * np.arange(len(angles))[:, None]
            counts = np.bincount(place.ravel(), minlength=num * len(angles))
            together += (counts.reshape(-1, num) ** 2).sum(axis=1)
        return float(angles[np.argmax(together)])


class Body(NamedTuple):
    """An object proven to move, and all that was seen of it."""

    track: Track
    shape: Shape

    def pointing(self, at_s: float) -> Float:
        """(2,) which way it points at a time: along the side of it that leads most nearly where it
        goes, or where it goes, if it is not seen to be long. A trailer that turns does not go where
        it points."""
        ahead = self.track.path.rate(at_s)[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
        rim = self.track.place(self.shape.rim, at_s)[:, :2]
        if np.linalg.norm(np.ptp(rim, axis=0)) < _LONG_M:
            return ahead
        sides_rad = self.shape.side_rad + float(self.track.path(at_s)[3]) + _QUARTERS_RAD
        sides = np.stack([np.cos(sides_rad), np.sin(sides_rad)], axis=1)
        side: Float = sides[np.argmax(sides @ ahead)]
        return side if np.ptp(rim @ side) >= _LONG_M else ahead
