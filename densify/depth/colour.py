# SPDX-License-Identifier: MIT
"""Colour of the points that a camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import InView
from densify.geometry.types import Cloud, DepthMap

_BEHIND_M = 0.15
_BEHIND_FRACTION = 0.02


def colour(
    cloud: Cloud, view: InView, depth: DepthMap, image: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """The cloud's ``rgb`` with the colours of ``image`` (H,W,3) for the points the camera sees.

    cloud: at the key's moment. view: of it. depth: what `densify.depth.project` made of it.
    A point is seen where it is not clearly behind its pixel's depth; pixels without depth, of which
    nothing is known, colour nothing.
    """
    u, v = np.rint(view.uv).astype(np.int64).T
    surface_m = depth.filled_m[v, u]
    reach_m = surface_m + _BEHIND_M + _BEHIND_FRACTION * surface_m
    seen = (surface_m > 0) & (view.exposure.depth_m(view.points_cam) <= reach_m)
    painted = cloud.rgb.copy()
    painted[view.rows[seen]] = image[v[seen], u[seen]]
    return painted
