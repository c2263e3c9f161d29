# SPDX-License-Identifier: MIT
"""Count as measured all pixels that a laser's spot covers, as with a long focal length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.depth.image_points import FOOTPRINT, PointsInImage
from densify.depth.layers import Layers
from densify.depth.measured_pixels import AGREE_FRACTION, AGREE_M
from densify.geometry.compiled import Kernel

_MOST_PX = 4  # greatest half width of a spot


def measure_spots(layers: Layers, points: PointsInImage) -> Layers:
    """Count filled pixels as measured if the laser spot of a measured return covers them.

    The fill must lie on the surface of the return. A covered pixel takes the ``point`` of the
    nearest return, and keeps its filled depth and confidence. Pixels without fill stay empty.
    """
    shape = layers.depth_m.shape
    measured = np.flatnonzero(layers.depth_m > 0)
    if not len(measured):
        return layers
    point = points.at(layers.point.flat[measured])
    radius_px = np.minimum(FOOTPRINT * points.spacing_px[point, 0], _MOST_PX)
    filled_m = np.where(layers.depth_m == 0, layers.filled_m, np.float32(0))
    source_pixel = np.full(shape, -1)
    nearest, uv = np.full(shape, np.inf), points.uv[point]
    _cover(measured, uv, radius_px, layers.depth_m, layers.tilt, filled_m, source_pixel, nearest)
    covered = np.flatnonzero(source_pixel >= 0)
    depth_m, of_point = layers.depth_m.copy(), layers.point.copy()
    depth_m.flat[covered] = layers.filled_m.flat[covered]
    of_point.flat[covered] = layers.point.flat[source_pixel.flat[covered]]
    return replace(layers, depth_m=depth_m, point=of_point)


@Kernel
def _cover(pixel, uv, radius_px, depth_m, tilt, filled_m, source_pixel, nearest):  # type: ignore[no-untyped-def]
    """Find for each filled pixel the measured pixel, nearest in the image, whose spot covers it."""
    # filled_m: 0 where no pixel may be covered; source_pixel (H,W): index of the measured pixel, -1
    # at first; nearest (H,W): squared distance to its spot, inf at first
    height, width = filled_m.shape
    for i in range(len(pixel)):
        v, u = pixel[i] // width, pixel[i] % width
        return_m = depth_m[v, u]
        reach = int(radius_px[i] + 0.5)  # the centre of a spot is in its pixel
        for row in range(max(v - reach, 0), min(v + reach + 1, height)):
            for column in range(max(u - reach, 0), min(u + reach + 1, width)):
                z = filled_m[row, column]
                if z == 0:
                    continue
                away = (column - uv[i, 0]) ** 2 + (row - uv[i, 1]) ** 2
                if away > radius_px[i] * radius_px[i] or away >= nearest[row, column]:
                    continue
                inverse = 1 / return_m + (column - u) * tilt[v, u, 0] + (row - v) * tilt[v, u, 1]
                if abs(z * inverse - 1) <= (AGREE_M + AGREE_FRACTION * return_m) * abs(inverse):
                    nearest[row, column] = away
                    source_pixel[row, column] = pixel[i]
