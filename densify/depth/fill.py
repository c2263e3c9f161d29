# SPDX-License-Identifier: MIT
"""Interpolation between the measured pixels of a depth map.

A plane in space is linear in *inverse* depth over the image, so planes are fitted there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import ProjectSettings
from densify.depth.layers import Layers
from densify.kernels import filling
from densify.types import Float32


def fill(layers: Layers, settings: ProjectSettings) -> Layers:
    """Interpolate as `fill_between`, as far as rays lie apart in the middle of the image."""
    filled_m, confidence = fill_between(
        layers.depth_m,
        np.where(layers.depth_m > 0, layers.confidence, np.float32(0)),
        _reach_px(layers, settings),
        settings.edge_m,
        settings.edge_fraction,
        settings.fill_confidence,
    )
    return replace(layers, filled_m=filled_m, confidence=confidence)


def _reach_px(layers: Layers, settings: ProjectSettings) -> tuple[int, int]:
    known = layers.depth_m > 0
    if not known.any():
        return 1, 1
    reach = np.ceil(settings.fill_reach * np.median(layers.spacing_px[known], axis=0))
    return max(1, int(reach[0])), max(1, int(reach[1]))


def fill_between(
    depth_m: Float32,
    confidence: Float32,
    reach_px: tuple[int, int],
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
    in the window: nothing is extrapolated, in the image or in depth. The window grows in thirds to
    the half size ``reach_px`` (horizontal, vertical) and the smallest that serves is taken.

    depth_m, confidence: (H,W), 0 none. Returns both with the filled pixels added; a filled pixel's
    confidence is the least of the measured ones in its window, times ``factor`` in the largest
    window, less lowered in smaller ones.
    """
    filled_m, filled_confidence = depth_m.copy(), confidence.copy()
    inverse = np.divide(1.0, depth_m, out=np.zeros(depth_m.shape), where=depth_m > 0)
    reaches = np.array([[max(1, round(r * k / 3)) for r in reach_px] for k in (1, 2, 3)])
    share = np.zeros(depth_m.shape, np.float32)
    edge = np.array([edge_m, edge_fraction])
    filling.between.over_rows(
        depth_m.size, inverse, confidence, reaches, edge, filled_m, filled_confidence, share
    )
    filled_confidence *= 1 - share * np.float32(1 - factor)
    return filled_m, filled_confidence
