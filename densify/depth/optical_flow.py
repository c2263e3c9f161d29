# SPDX-License-Identifier: MIT
"""Optical flow from scene flow: where the pixels with a depth go in another image."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from densify.depth.exposure import Exposure
from densify.geometry.types import Cloud, DepthMap, Float32, Reason


def optical_flow(cloud: Cloud, depth: DepthMap, exposure: Exposure, other: Exposure) -> Float32:
    """(H,W,2) pixels to the right and down, from one exposure to another; NaN where unknown.

    cloud: at the key's moment. depth: what `densify.depth.project` made of it at ``exposure``. What
    moves goes on at its velocity. Known are the measured pixels, of which those that only spots
    cover (`densify.depth.spot`) go with the nearest; where the other image ends does not matter.
    """
    chosen = np.flatnonzero(depth.reason == Reason.KEPT)
    points, velocity_m_s = cloud.points[chosen], cloud.velocity_m_s[chosen]
    uv = exposure.see(points, velocity_m_s).uv
    column, row = np.rint(uv).astype(np.int64).T
    there = other.see(points, velocity_m_s).uv
    flow = np.full((*depth.depth_m.shape, 2), np.nan, np.float32)
    flow[row, column] = there - uv
    hit = np.zeros(depth.depth_m.shape, bool)
    hit[row, column] = True
    covered = (depth.depth_m > 0) & ~hit
    if covered.any():
        nearest = ndimage.distance_transform_edt(~hit, return_distances=False, return_indices=True)
        flow[covered] = flow[tuple(nearest)][covered]
    return flow
