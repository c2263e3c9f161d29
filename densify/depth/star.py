# SPDX-License-Identifier: MIT
"""What the fill by windows leaves: holes between pixels that are known all round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth import stars
from densify.depth.fill import voted
from densify.depth.layers import Layers
from densify.depth.marching import DIRECTIONS, first_known

_RULES = stars.Rules(reach=0.0, met=8, gap=7, fraction=0.1, strip_px=6)
_LEAST_SHARE = 0.8  # of the votes for a pixel that is kept
_ONE_SURFACE = 0.05  # share of the inverse depth


def fill_stars(layers: Layers, settings: ProjectSettings) -> Layers:
    """Fill empty pixels from the first known one, measured or filled, in each of 16 directions.

    The inverse depth of each of these is extended to the pixel along its surface (as measured, else
    the plane through the known pixels around it that are as deep), and weighted by one over its
    steps. A pixel is filled if it meets known ones within ``settings.star_reach`` spacings of the
    rays in at least 8 directions with no more than 7 neighbouring ones without, so that it lies
    between them, if all give the same depth to 10 %, and if eight of ten votes of the measured
    pixels around are in favour (`densify.depth.fill.voted`): no depth edge, then, runs through. In
    an empty strip of up to six rows along the lower border of the image two directions fewer are
    enough. The confidence is the least of theirs, times ``settings.fill_confidence``.
    """
    known, measured = layers.filled_m > 0, layers.depth_m > 0
    inverse = np.divide(1, layers.filled_m, out=np.zeros_like(layers.filled_m), where=known)
    around = ndimage.binary_dilation(~known, np.ones((3, 3), bool))
    slope = np.where(measured[..., None], layers.tilt, np.float32(0)).reshape(-1, 2)
    rim = np.flatnonzero(known & ~measured & around)
    stars.slopes.over_rows(len(rim), rim, inverse, layers.spacing_px, _ONE_SURFACE, slope)
    pixel = np.flatnonzero(~known)
    found = np.zeros((2, len(pixel)), np.float32)
    stars.between.over_rows(
        len(pixel),
        pixel,
        first_known(known),
        DIRECTIONS,
        inverse,
        slope,
        layers.confidence,
        layers.spacing_px,
        _RULES._replace(reach=float(settings.star_reach)),
        found,
    )
    filled_m, confidence = layers.filled_m.copy(), layers.confidence.copy()
    pixel, found = pixel[found[0] > 0], found[:, found[0] > 0]
    filled_m.flat[pixel] = found[0]
    confidence.flat[pixel] = found[1] * np.float32(settings.fill_confidence)
    filled = replace(layers, filled_m=filled_m, confidence=confidence)
    return voted(filled, layers.filled_m, _LEAST_SHARE)
