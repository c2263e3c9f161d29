# SPDX-License-Identifier: MIT
"""Intersect lines with convex hulls."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from densify.geometry.arrays import Bool, Float


def half_spaces(corners: Float) -> Float:
    """Return the (F,4) unit normal n and offset d of the sides of a convex hull.

    A point x is inside if n · x + d ≤ 0 for all sides. corners: (V,3).
    """
    return np.unique(ConvexHull(corners).equations, axis=0)


def crossing(spaces: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """Return the (K,) t at which lines start + t · way enter a convex body, and leave it.

    A line that misses the body leaves before it enters.

    Args:
        spaces: (F,4) sides of the body, from `half_spaces`.
        start: (K,3) start of each line, or (3,) of all.
        way: (K,3) direction of each line.
    """
    enter, leave = np.full(len(way), -np.inf), np.full(len(way), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for side in spaces:
            slope = way @ side[:3] + 0.0  # no -0: a line along a side that is outside never enters
            t = (start @ -side[:3] - side[3]) / slope
            inward = slope < 0
            np.maximum(enter, np.where(inward, t, -np.inf), out=enter)
            np.fmin(leave, np.where(inward, np.inf, t), out=leave)
    return enter, leave


def passes_near(corners: Float, start: Float, way: Float) -> Bool:
    """Return (K,) True for lines that pass through a sphere around the corners of a body.

    Args:
        corners: (V,3) corners of the body.
        start: (K,3) start of each line.
        way: (K,3) direction of each line.
    """
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - middle, axis=1).max()
    off = np.linalg.norm(np.cross(start - middle, way), axis=1)
    near: Bool = off <= radius_m * np.linalg.norm(way, axis=1)
    return near
