# SPDX-License-Identifier: MIT
"""How far the depths around agree with a pixel's: on a wall, a road or a car they lie on one
surface; among leaves they lie at many depths, and which of them a pixel shows is often wrong."""

from __future__ import annotations

import numpy as np

from densify.depth import agreeing
from densify.depth.layers import Layers
from densify.geometry.types import Float32
from densify.scores.depth_metrics import KITTI_BASELINE_M, OUTLIER_FRACTION, OUTLIER_PX

_GIVEN = 2.0  # pixels around that are taken to agree: few do not tell
_MOST = 0.7  # of them; of what more contradicted, half to nine tenths was wrong


def contradicted(layers: Layers, focal_px: float) -> Float32:
    """(H,W) share of what is measured around each pixel of the filled map, at depth edges too, that
    would make it wrong by KITTI's rule, within a gap between rays to all sides. Nothing contradicts
    closed windows (`densify.depth.glass`): what is behind them may be measured too."""
    measured_m = np.maximum(layers.depth_m, layers.rim_m)
    inverse, known = (
        np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        for depth_m in (layers.filled_m, measured_m)
    )
    pixel = np.flatnonzero(layers.filled_m)
    share = np.zeros(len(pixel), np.float32)
    half_px = max(2, round(float(np.median(layers.gap_px))))
    apart = OUTLIER_PX / (focal_px * KITTI_BASELINE_M)
    rule = agreeing.Rule(_GIVEN, float(apart), OUTLIER_FRACTION)
    agreeing.contradicted.over_rows(
        len(pixel), pixel, inverse, known, layers.tilt, half_px, rule, share
    )
    found = np.zeros_like(layers.filled_m)
    found.flat[pixel] = share
    if layers.window is not None:
        found[layers.window] = 0
    return found


def without_contradicted(layers: Layers, share: Float32) -> Layers:
    """Take out the pixels that most of what is measured around contradicts. share: (H,W) of it, see
    `contradicted`."""
    return layers.without(share > _MOST)
