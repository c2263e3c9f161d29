# SPDX-License-Identifier: MIT
"""The pixels that a laser's spot covers, not only the one that its middle falls into.

A camera with a long focal length has several pixels to a beam: a return measures all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import ProjectSettings
from densify.depth import spots
from densify.depth.image_points import PointsInImage
from densify.depth.layers import Layers

_MOST_PX = 4  # of a spot's radius


def measure_spots(layers: Layers, points: PointsInImage, settings: ProjectSettings) -> Layers:
    """Count as measured what is filled within ``project.spot`` spacings of a measured return.

    Of several returns the nearest one's ``point`` is taken. The fill there must agree with the
    return's surface (``project.agree_m``, ``agree_fraction``): what the fill left open, because an
    edge is near or the image says otherwise, stays open, and so do unsure rims. Depth and
    confidence remain the fill's.
    """
    shape = layers.depth_m.shape
    measured = np.flatnonzero(layers.depth_m > 0)
    if not len(measured):
        return layers
    point = points.at(layers.point.flat[measured])
    radius_px = np.minimum(settings.spot * points.spacing_px[point, 0], _MOST_PX)
    known = spots.Spots(
        middle_px=np.zeros((*shape, 2), np.float32),
        radius_px=np.zeros(shape, np.float32),
        depth_m=layers.depth_m,
        tilt=layers.tilt,
    )
    middle = np.stack(np.divmod(measured, shape[1])[::-1], axis=1)
    known.middle_px.reshape(-1, 2)[measured] = points.uv[point] - middle
    known.radius_px.flat[measured] = radius_px
    fills = layers.depth_m == 0
    if layers.unsure is not None:
        fills &= ~layers.unsure
    open_m = np.where(fills, layers.filled_m, np.float32(0))
    found, agree = np.full(shape, -1), np.array([settings.agree_m, settings.agree_fraction])
    nearest = np.full(shape, np.inf)
    spots.cover(measured, open_m, known, agree, found, nearest)
    covered = np.flatnonzero(found >= 0)
    by = found.flat[covered]
    depth_m, of_point = layers.depth_m.copy(), layers.point.copy()
    depth_m.flat[covered] = layers.filled_m.flat[covered]
    of_point.flat[covered] = layers.point.flat[by]
    return replace(layers, depth_m=depth_m, point=of_point)
