# SPDX-License-Identifier: MIT
"""Colour of the points that a camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.types import Camera, DepthMap, Float

_BEHIND_M = 0.15
_BEHIND_FRACTION = 0.02


def colour(
    rgb: NDArray[np.uint8],
    points: Float,
    camera: Camera,
    T_cam_key: Float,
    depth: DepthMap,
    image: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """``rgb`` (M,3) with the colours of ``image`` (H,W,3) for the points the camera sees.

    points: (M,3) key frame, at the moment of the exposure. depth: what `project` made of them.
    A point is seen where it is not clearly behind its pixel's depth; pixels without depth, of which
    nothing is known, colour nothing.
    """
    points_cam = poses.transform(T_cam_key, points)
    uv, inside = image_points(camera, points_cam)
    rows = np.flatnonzero(inside)
    u, v = np.rint(uv[rows]).astype(np.int64).T
    surface_m = depth.filled_m[v, u]
    reach_m = surface_m + _BEHIND_M + _BEHIND_FRACTION * surface_m
    seen = (surface_m > 0) & (points_cam[rows, 2] <= reach_m)
    painted = rgb.copy()
    painted[rows[seen]] = image[v[seen], u[seen]]
    return painted
