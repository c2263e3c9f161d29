# SPDX-License-Identifier: MIT
"""Pixels covered by the spots of lasers, compiled: see `densify.depth.spot`."""

from __future__ import annotations

from typing import NamedTuple

from densify.geometry.compiled import Kernel
from densify.geometry.types import Float32


class Spots(NamedTuple):
    """What measured pixels know, (H,W) everywhere. middle_px: (H,W,2) float32 from the pixel's to
    the return's, across and down. radius_px: float32, 0 where nothing is measured. depth_m: float32
    and tilt: (H,W,2) float32 slope of its inverse, 1/m per px."""

    middle_px: Float32
    radius_px: Float32
    depth_m: Float32
    tilt: Float32


@Kernel
def cover(pixel, filled_m, spots, agree, found, nearest):  # type: ignore[no-untyped-def]
    """The measured pixel whose spot covers a filled one, nearest in the image, on its surface.

    pixel: (P,) the measured ones, row by row. filled_m: (H,W) float32, of the pixels that may be
    covered, 0 elsewhere. spots: `Spots`. agree: (2,) metres, and a share of the depth, by which
    they may differ. found: (H,W) int64, of each covered pixel the measured one. nearest: (H,W)
    float64 inf, squared distance to its spot.
    """
    height, width = filled_m.shape
    for p in pixel:
        v, u = p // width, p % width
        radius_px, here = spots.radius_px[v, u], spots.depth_m[v, u]
        middle_u, middle_v = spots.middle_px[v, u, 0], spots.middle_px[v, u, 1]
        reach = int(radius_px + 0.5)  # a spot's middle lies in its pixel
        for row in range(max(v - reach, 0), min(v + reach + 1, height)):
            for column in range(max(u - reach, 0), min(u + reach + 1, width)):
                z = filled_m[row, column]
                if z == 0:
                    continue
                du, dv = column - u, row - v
                away = (du - middle_u) ** 2 + (dv - middle_v) ** 2
                if away > radius_px * radius_px or away >= nearest[row, column]:
                    continue
                inverse = 1 / here + du * spots.tilt[v, u, 0] + dv * spots.tilt[v, u, 1]
                if abs(z * inverse - 1) <= (agree[0] + agree[1] * here) * abs(inverse):
                    nearest[row, column] = away
                    found[row, column] = p
