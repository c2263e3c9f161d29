# SPDX-License-Identifier: MIT
"""Pixels covered by the spots of lasers, compiled: see `densify.depth.spot`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.kernels import Kernel
from densify.types import Float32


class Spots(NamedTuple):
    """What measured pixels know, (H,W) everywhere. middle_px: (H,W,2) float32 from the pixel's to
    the return's, across and down. radius_px: float32, 0 where nothing is measured. depth_m: float32
    and tilt: (H,W,2) float32 slope of its inverse, 1/m per px."""

    middle_px: Float32
    radius_px: Float32
    depth_m: Float32
    tilt: Float32


@Kernel
def nearest_over(first, last, pixel, filled_m, spots, reach, agree, found):  # type: ignore[no-untyped-def]
    """The measured pixel whose spot covers a filled one, nearest in the image, on its surface.

    pixel: (P,) row by row. filled_m: (H,W) float32. spots: `Spots`. reach: pixels, the largest
    radius. agree: (2,) metres, and a share of the depth, by which they may differ. found: (P,)
    int64, stays where there is none.
    """
    height, width = filled_m.shape
    for p in range(first, last):
        row, column = pixel[p] // width, pixel[p] % width
        z = filled_m[row, column]
        best = np.inf
        for v in range(max(row - reach, 0), min(row + reach + 1, height)):
            for u in range(max(column - reach, 0), min(column + reach + 1, width)):
                radius_px = spots.radius_px[v, u]
                if radius_px <= 0:
                    continue
                du, dv = column - u, row - v
                away_u = du - spots.middle_px[v, u, 0]
                away_v = dv - spots.middle_px[v, u, 1]
                away = away_u * away_u + away_v * away_v
                if away > radius_px * radius_px or away >= best:
                    continue
                here = spots.depth_m[v, u]
                inverse = 1 / here + du * spots.tilt[v, u, 0] + dv * spots.tilt[v, u, 1]
                if abs(z * inverse - 1) <= (agree[0] + agree[1] * here) * abs(inverse):
                    best = away
                    found[p] = v * width + u
