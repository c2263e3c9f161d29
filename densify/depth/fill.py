# SPDX-License-Identifier: MIT
"""Interpolation between the measured pixels of a depth map.

A plane in space is linear in *inverse* depth over the image, so planes are fitted there.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from densify.config import ProjectSettings
from densify.depth import filling
from densify.depth.layers import Layers
from densify.depth.votes import elected, voters
from densify.geometry.types import Float32

_GROWTH = (1 / 3, 2 / 3, 1.0)  # spacings
_LEAST_SHARE = 0.9  # of the votes for a pixel that is kept
_AROUND, _LEAST_KNOWN = 0.35, 0.3  # gaps between rays to all sides; share of what lies there


def fill(layers: Layers, settings: ProjectSettings) -> Layers:
    """Interpolate as `fill_between`, and keep what is `voted` for."""
    filled_m, confidence = fill_between(
        layers.depth_m,
        np.where(layers.depth_m > 0, layers.confidence, np.float32(0)),
        layers.spacing_px,
        settings.fill_reach,
        settings.edge_m,
        settings.edge_fraction,
        settings.fill_confidence,
    )
    filled = replace(layers, filled_m=filled_m, confidence=confidence)
    return voted(filled, layers.depth_m, _LEAST_SHARE)


def voted(layers: Layers, before_m: Float32, least_share: float) -> Layers:
    """The layers without what was filled since ``before_m`` (H,W) against the votes of the measured
    pixels around.

    ``least_share`` of the votes (`densify.depth.votes`) must be in favour; what is filled has none,
    it would vote for itself. Rims that were not accepted may only turn the vote down, those that
    are not veiled: the pillar of a car of which little was measured is not filled over.
    """
    filled = (layers.filled_m > 0) & (before_m == 0)
    pixel = np.flatnonzero(filled)
    with_rims_m = np.where(layers.veiled, layers.depth_m, np.maximum(layers.depth_m, layers.rim_m))
    for known_m in (with_rims_m, layers.depth_m):
        seeds, depth_m = voters(layers, known_m), layers.filled_m.flat[pixel]
        pixel = pixel[elected(layers, seeds, pixel, depth_m, least_share)]
    filled.flat[pixel] = False
    filled_m, confidence = layers.filled_m.copy(), layers.confidence.copy()
    filled_m[filled] = 0
    confidence[filled] = 0
    return replace(layers, filled_m=filled_m, confidence=confidence)


def without_shreds(layers: Layers) -> Layers:
    """The layers without what was filled where little else was.

    Of what lies around such a pixel, a third of the gap between rays to all sides, at least three
    tenths must be known. Else votes have left streaks between rays far apart, of which up to a
    twelfth was wrong.
    """
    known = layers.filled_m > 0
    row, column = np.nonzero(known & (layers.depth_m == 0))
    gap_px = layers.spacing_px[row, column].max(axis=1)
    half_px = np.maximum(np.rint(_AROUND * gap_px).astype(np.int64), 1)
    height, width = known.shape
    top, left = np.maximum(row - half_px, 0), np.maximum(column - half_px, 0)
    low, right = np.minimum(row + half_px + 1, height), np.minimum(column + half_px + 1, width)
    num = cv2.integral(known.astype(np.uint8))
    num_known = num[low, right] - num[top, right] - num[low, left] + num[top, left]
    dropped = np.zeros_like(known)
    dropped[row, column] = num_known < _LEAST_KNOWN * (low - top) * (right - left)
    return layers.without(dropped)


def fill_between(
    depth_m: Float32,
    confidence: Float32,
    spacing_px: Float32,
    reach: float,
    edge_m: float,
    edge_fraction: float,
    factor: float,
) -> tuple[Float32, Float32]:
    """Interpolate empty pixels that have measured pixels on both sides.

    Concretely, an empty pixel is filled when, within a window around it, measured pixels lie in a
    column to the left and one to the right and in a row above and one below, and no depth edge runs
    through them: they deviate from a plane by no more than max(``edge_m``, ``edge_fraction`` * the
    nearest), between the farthest and the nearest deviation; of fewer than six their depths
    themselves. It gets the plane's depth (weighted least squares in inverse depth, the weight
    falling to zero just outside the window), held between the least and the greatest depth measured
    in the window: nothing is extrapolated, in the image or in depth. The window grows to the half
    size ``reach`` in thirds of the spacing of rays there, and the smallest that serves is taken.

    depth_m, confidence: (H,W), 0 none. spacing_px: (H,W,2) between rays, horizontally and
    vertically. Returns both with the filled pixels added; a filled pixel's confidence is the least
    of the measured ones in its window, times ``factor`` in the largest window, less lowered in
    smaller ones.
    """
    filled_m, filled_confidence = depth_m.copy(), confidence.copy()
    share = np.zeros(depth_m.shape, np.float32)
    edge = np.array([edge_m, edge_fraction])
    reaches = np.array([*(min(reach, 1.0) * step for step in _GROWTH), *([reach] * (reach > 1))])
    measured = depth_m > 0
    height, width = depth_m.shape
    before = np.zeros((height, width + 1), np.int32)
    np.cumsum(measured, axis=1, dtype=np.int32, out=before[:, 1:])
    num = np.zeros((height + 1, width + 1), np.int32)
    np.cumsum(before, axis=0, out=num[1:])
    before += num[:-1, -1:]
    known = filling.Known(
        before=before,
        num=num,
        column=np.nonzero(measured)[1].astype(np.int32),
        inverse=1 / depth_m[measured].astype(np.float64),
        confidence=confidence[measured],
    )
    filling.between.over_rows(
        depth_m.size, known, spacing_px, reaches, edge, filled_m, filled_confidence, share
    )
    filled_confidence *= 1 - share * np.float32(1 - factor)
    return filled_m, filled_confidence
