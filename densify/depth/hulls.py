# SPDX-License-Identifier: MIT
"""Intersect lines with convex hulls."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from densify.geometry.arrays import Bool, Float


def half_spaces(corners: Float) -> Float:
    """Return the (F,4) sides of the corners' (V,3) convex hull: unit normal n and offset d.

    A point x is inside if n · x + d ≤ 0 for all sides.
    """
    return np.unique(ConvexHull(corners).equations, axis=0)


def crossing(spaces: Float, start: Float, direction: Float) -> tuple[Float, Float]:
    """Return the (K,) t at which lines start + t · direction enter a convex body, and leave it.

    A line that misses the body leaves before it enters. ``spaces`` is from `half_spaces`,
    ``direction`` (K,3), ``start`` (K,3) or (3,) for all lines.
    """
    enter, leave = np.full(len(direction), -np.inf), np.full(len(direction), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for side in spaces:
            # No -0: a line along a side that is outside never enters.
            slope = direction @ side[:3] + 0.0
            t = (start @ -side[:3] - side[3]) / slope
            inward = slope < 0
            np.maximum(enter, np.where(inward, t, -np.inf), out=enter)
            np.fmin(leave, np.where(inward, np.inf, t), out=leave)
    return enter, leave


def passes_near(corners: Float, start: Float, direction: Float) -> Bool:
    """Return (K,) True for lines, as in `crossing`, that meet a sphere around the corners (V,3)."""
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - middle, axis=1).max()
    off = np.linalg.norm(np.cross(start - middle, direction), axis=1)
    passes: Bool = off <= radius_m * np.linalg.norm(direction, axis=1)
    return passes
