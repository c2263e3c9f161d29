# SPDX-License-Identifier: MIT
"""Compute the confidence of pixels: the probability that a pixel is an outlier by KITTI's rule.

The probability P is that of a logistic regression (Cox, "The regression analysis of binary
sequences", 1958) on physical features of the pixel:

    P = 1 / (1 + exp(-(w0 + w1 x1 + ... + w7 x7)))

The weights `WEIGHTS` were fitted to exact truth of simulated streets and to the truth of real
recordings, each recording with equal weight, by ``examples/fit_confidence.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.depth.boundary_pixels import MOST_CONFIDENCE
from densify.depth.layers import Layers
from densify.geometry.types import Camera, DepthMap, Float, Float32
from densify.scores.depth_metrics import (
    KITTI_BASELINE_M,
    OUTLIER_FRACTION,
    OUTLIER_PX,
    is_outlier_depth,
)

DECADES = 5.0
"""Confidence 1 means one outlier in 10^5 pixels; each 0.2 less means ten times as many."""

WEIGHTS: Mapping[str, float] = {
    "every pixel": -8.51,
    "boundary pixel that the image confirms": 2.40,
    "filled pixel": -0.46,
    "doubt of a measured pixel": 1.95,
    "doubt of a filled pixel": 2.24,
    "rejected boundary pixels within 2 spacings": 1.11,
    "rejected boundary pixels within 8 spacings": 0.62,
    "step of depth within a spacing": 1.68,
}
"""Weight of each feature, see `features`."""
_LEAST_DOUBT, _LEAST_SHARE = 0.03, 0.005  # smaller values are not told apart
_NUM_STEPS = 20


def features(layers: Layers) -> Float32:
    """Return the (P,8) features of the P pixels with a depth, row by row, as named in `WEIGHTS`.

    Doubt is 1 minus the rank that the stages give a pixel: by the number of sweeps and points that
    agree, the distance to a depth discontinuity, the residual, and the distance over which it is
    filled. Doubts and shares enter by their logarithm to base 10, because probabilities of errors
    are proportional to powers of them. The step is the logarithm of the ratio of the greatest to
    the least depth around. Spacings are those of neighbouring rays.
    """
    shown, measured = layers.filled_m > 0, layers.depth_m > 0
    boundary = measured & (layers.rim_m > 0)
    rank = np.where(boundary, MOST_CONFIDENCE, np.clip(layers.confidence, 0, 1))
    doubt = np.log10((1 - rank) / _LEAST_DOUBT + 1)
    gap_px = float(np.median(layers.gap_px))
    inverse = np.divide(1, layers.filled_m, out=np.zeros_like(layers.filled_m), where=shown)
    size = _size(1, gap_px)
    nearest = ndimage.maximum_filter(inverse, size)
    farthest = ndimage.minimum_filter(np.where(shown, inverse, np.float32(np.inf)), size)
    columns = [
        np.ones(shown.shape, np.float32),
        boundary,
        ~measured,
        doubt * (measured & ~boundary),
        doubt * ~measured,
        *(_rejected(layers, _size(reach, gap_px)) for reach in (2, 8)),
        np.log1p(np.log(nearest / farthest, out=np.zeros_like(nearest), where=shown)),
    ]
    return np.stack([column[shown] for column in columns], axis=1).astype(np.float32)


def _size(spacings: float, gap_px: float) -> int:
    """Return the width in pixels of a window that reaches so many spacings to all sides."""
    return 2 * max(2, round(spacings * gap_px)) + 1


def _rejected(layers: Layers, size_px: int) -> Float32:
    """Return the (H,W) logarithm of the share of boundary pixels around that are not accepted."""
    rejected, measured = (layers.rim_m > 0) & (layers.depth_m == 0), layers.depth_m > 0
    share, some = (
        ndimage.uniform_filter(part.astype(np.float32), size_px, mode="constant")
        for part in (rejected, rejected | measured)
    )
    logarithm: Float32 = np.log10(share / np.maximum(some, 1e-4) / _LEAST_SHARE + 1)
    return logarithm


def confidence_of(evidence: NDArray[np.floating], weights: Float | None = None) -> Float32:
    """Return the (P,) confidence ``-log10(P) / 5`` of pixels with `features` (P,8)."""
    used = np.array([*WEIGHTS.values()]) if weights is None else weights
    log_p = -np.logaddexp(0, -(evidence @ used)) / np.log(10)
    return np.clip(-log_p / DECADES, 0, 1).astype(np.float32)


def wrong(confidence: Float | Float32) -> Float:
    """Return the probability of an outlier at each confidence, in the shape of the argument."""
    probability: Float = 10.0 ** (-DECADES * np.asarray(confidence, np.float64))
    return probability


def without_times(maps: DepthMap, smear_m: float, camera: Camera, share: float = 1.0) -> DepthMap:
    """Return the map with lower confidence at near pixels, for sweeps without times of points.

    The vehicle's motion within such a sweep moves depths by an unknown amount up to ``smear_m`` in
    either direction. Near pixels tolerate less of it than far pixels.

    Args:
        smear_m: Half the travel in metres along the camera's axis from sweep to sweep.
        share: Share of the sweeps without times.
    """
    depth_m, shown = maps.filled_m.astype(np.float64), maps.filled_m > 0
    px_m = depth_m**2 / (camera.focal_px * KITTI_BASELINE_M)
    tolerated_m = np.maximum(OUTLIER_PX * px_m, OUTLIER_FRACTION * depth_m)
    smeared = share * np.clip(1 - tolerated_m / max(smear_m, 1e-9), 0, 1)
    either = 1 - (1 - wrong(maps.confidence)) * (1 - smeared)
    confidence = np.clip(-np.log10(np.maximum(either, 10.0**-DECADES)) / DECADES, 0, 1)
    return replace(maps, confidence=np.where(shown, confidence, 0).astype(np.float32))


def expected_outliers(maps: DepthMap) -> dict[str, float | None]:
    """Return the expected share of outliers of the ``measured`` and the ``filled`` map."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
        some = depth_m > 0
        shares[name] = float(wrong(maps.confidence[some]).mean()) if some.any() else None
    return shares


def reliability(maps: DepthMap, truth_m: Float32, camera: Camera) -> list[dict[str, Any]]:
    """Return expected and true outliers by confidence, over the filled pixels with ground truth.

    Each interval of 0.05 with pixels has ``confidence`` (its start), ``num_compared`` pixels, and
    the ``expected`` and the true share of ``outliers``.

    Args:
        truth_m: (H,W) true depth in metres, 0 none.
    """
    compared = (truth_m > 0) & (maps.filled_m > 0)
    confidence = maps.confidence[compared]
    bad = is_outlier_depth(maps.filled_m[compared], truth_m[compared], camera.focal_px)
    step = np.minimum((confidence * _NUM_STEPS).astype(np.int64), _NUM_STEPS - 1)
    num = np.bincount(step, minlength=_NUM_STEPS)
    expected = np.bincount(step, wrong(confidence), _NUM_STEPS)
    found = np.bincount(step, bad, _NUM_STEPS)
    return [
        {
            "confidence": i / _NUM_STEPS,
            "num_compared": int(num[i]),
            "expected": float(expected[i] / num[i]),
            "outliers": float(found[i] / num[i]),
        }
        for i in np.flatnonzero(num).tolist()
    ]
