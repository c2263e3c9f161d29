# SPDX-License-Identifier: MIT
"""Intersect lines with convex hulls."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from densify.geometry.arrays import Bool, Float


def half_spaces(corners: Float) -> Float:
    """Return (F,4) normal n and offset d of the sides of a hull; n · x + d ≤ 0 inside."""
    return np.unique(ConvexHull(corners).equations, axis=0)


def crossing(spaces: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """Return (K,) the t at which lines start + t · way enter a convex body, and leave it.

    A line that misses the body leaves before it enters.

    Args:
        spaces: (F,4) of `half_spaces`.
        start: (K,3) or (3,).
        way: (K,3).
    """
    enter, leave = np.full(len(way), -np.inf), np.full(len(way), np.inf)
    for side in spaces:
        slope, outside = way @ side[:3], start @ side[:3] + side[3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -outside / slope
        np.maximum(enter, t, out=enter, where=slope < 0)
        np.minimum(leave, t, out=leave, where=slope > 0)
        leave[(slope == 0) & (outside > 0)] = -np.inf
    return enter, leave


def passes_near(corners: Float, start: Float, way: Float) -> Bool:
    """Return (K,) True for lines that pass within the sphere around the corners (V,3)."""
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - middle, axis=1).max()
    off = np.linalg.norm(np.cross(start - middle, way), axis=1)
    near: Bool = off <= radius_m * np.linalg.norm(way, axis=1)
    return near
