# SPDX-License-Identifier: MIT
"""Optical flow from scene flow: where the pixels with a depth go in another image."""

from __future__ import annotations

import numpy as np

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.types import Camera, Cloud, DepthMap, Float, Float32, Reason


def optical_flow(
    exposed: Cloud,
    depth: DepthMap,
    camera: Camera,
    T_cam_key: Float,
    T_other_key: Float,
    seconds: float,
) -> Float32:
    """(H,W,2) pixels to the right and down, from one exposure to another; NaN where unknown.

    exposed: the cloud at the first exposure. depth: what `project` made of it there. T_cam_key,
    T_other_key: (4,4) the camera at the first and at the other exposure. seconds: from the first to
    the other; what moves goes on at its velocity. Known are the measured pixels; where the other
    image ends does not matter.
    """
    chosen = np.flatnonzero(depth.reason == Reason.KEPT)
    uv, _ = image_points(camera, poses.transform(T_cam_key, exposed.points))
    column, row = np.rint(uv[chosen]).astype(np.int64).T
    later = exposed.points[chosen] + seconds * exposed.velocity_m_s[chosen]
    there, _ = image_points(camera, poses.transform(T_other_key, later))
    flow = np.full((*depth.depth_m.shape, 2), np.nan, np.float32)
    flow[row, column] = there - uv[chosen]
    return flow
