# SPDX-License-Identifier: MIT
"""Compute the confidence of pixels: the probability that a pixel is an outlier by KITTI's rule.

The stages of a map rank its pixels. The rank rises with the number of sweeps and points that agree,
the distance to a depth discontinuity and the votes of the image. It falls with roughness and with
the distance over which a pixel is filled.

The share of outliers of a rank falls with the rank. It was measured against exact ground truth for
each group of pixels, by the origin of the depth and the roughness around.
``examples/fit_confidence.py`` writes these tables to ``confidence.json`` beside this file.

Within the measured and within the filled pixels of a map, confidence keeps the order of the ranks.
Each rank gets the mean probability of the map's own pixels at that rank, made to fall with the
rank.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import isotonic_regression

from densify.config.file_content import read_json
from densify.depth.layers import Layers
from densify.geometry.types import Bool, Camera, DepthMap, Float, Float32, Ranked
from densify.scores.depth_metrics import (
    KITTI_BASELINE_M,
    OUTLIER_FRACTION,
    OUTLIER_PX,
    is_outlier_depth,
)

DECADES = 5.0
"""Confidence 1 means one outlier in 10^5 pixels; each 0.2 less means ten times as many."""
_RAGGED = np.array([0.1, 0.5])
GROUPS = tuple(
    f"{how}, rough from {ragged:g}"
    for how in ("window", "beyond", "filled")
    for ragged in (0, *_RAGGED)
)
"""Origin of a pixel's depth, and share of boundary pixels among the measured pixels around."""
NUM_RANKS = 200
NUM_MEASURED = sum(not group.startswith("filled") for group in GROUPS)
"""Number of groups of measured pixels; the other groups are of filled pixels."""

_FILE = Path(__file__).with_name("confidence.json")
_AROUND = 4.0  # half size of the surroundings, in spacings of neighbouring rays
_TILT = 0.01  # decades from rank 0 to 1, so that different ranks have different confidences
_NUM_STEPS = 20


def rank_pixels(layers: Layers, far: Bool) -> Ranked:
    """Return the rank and the group of each pixel of a map.

    Roughness is a mean within four spacings of rays to all sides.

    far: (H,W) True at pixels measured by sweeps beyond the window.
    """
    rim, shown = layers.rim_m > 0, layers.filled_m > 0
    size = 2 * max(2, round(_AROUND * float(np.median(layers.gap_px)))) + 1
    num_rim, num = (
        ndimage.uniform_filter(part.astype(np.float32), size, mode="constant")
        for part in (rim, rim | (layers.depth_m > 0))
    )
    ragged = np.searchsorted(_RAGGED, num_rim / np.maximum(num, 1 / size**2), side="right")
    how = np.where(layers.depth_m > 0, far.astype(np.uint8), np.uint8(2))
    group = np.where(shown, how * (len(_RAGGED) + 1) + ragged, 0).astype(np.uint8)
    rank = np.where(shown, np.clip(layers.confidence, 0, 1), np.float32(0))
    return Ranked(rank, group)


def calibrated(found: Ranked, shown: Bool, tables: Float | None = None) -> Float32:
    """Return the (H,W) confidence ``-log10(P) / 5`` with the probability P of an outlier.

    Args:
        found: Rank and group of each pixel, from `rank_pixels`.
        shown: (H,W) True at pixels with a depth; the confidence is 0 elsewhere.
        tables: (G,R) share of outliers by group (`GROUPS`) and step of the rank; None for the
            package's own.
    """
    rank, group = found.rank[shown], found.group[shown]
    log_wrong = curves(num_pixels(found, shown), _own_tables() if tables is None else tables)
    place = rank.astype(np.float64) * NUM_RANKS - 0.5
    steps = np.arange(NUM_RANKS)
    measured, filled = (np.interp(place, steps, curve) for curve in log_wrong)
    confidence = np.zeros(shown.shape, np.float32)
    log = np.where(group < NUM_MEASURED, measured, filled) + _TILT * (0.5 - rank)
    confidence[shown] = np.clip(-log / DECADES, 0, 1)
    return confidence


def num_pixels(found: Ranked, of: Bool) -> Float:
    """Return the (G,R) number of pixels by group and step of the rank, of R = `NUM_RANKS`.

    of: (H,W) True at pixels that count.
    """
    step = np.minimum((found.rank[of] * NUM_RANKS).astype(np.int64), NUM_RANKS - 1)
    place = found.group[of].astype(np.int64) * NUM_RANKS + step
    num = np.bincount(place, minlength=len(GROUPS) * NUM_RANKS)
    return num.reshape(len(GROUPS), NUM_RANKS).astype(np.float64)


def curves(num: Float, tables: Float) -> Float:
    """Return (2,R) log10 of the probability of an outlier by step of the rank.

    The rows are for measured and for filled pixels.

    Args:
        num: (G,R) numbers of `num_pixels`.
        tables: (G,R) shares of outliers.
    """
    shares = [
        falling(num[part].sum(axis=0), (num * tables)[part].sum(axis=0))
        for part in (slice(NUM_MEASURED), slice(NUM_MEASURED, None))
    ]
    return np.log10(np.clip(shares, 10.0 ** (_TILT - DECADES), 1))


def falling(num: Float, wrong_num: Float) -> Float:
    """Return the (R,) ratio ``wrong_num / num``, made to fall with the rank by isotonic regression.

    Steps without pixels are interpolated. num and wrong_num: (R,) pixels, outliers among them.
    """
    some = num > 0
    if not some.any():
        return np.zeros(len(num))
    share = isotonic_regression(wrong_num[some] / num[some], weights=num[some], increasing=False).x
    steps = np.arange(len(num))
    between: Float = np.interp(steps, steps[some], share)
    return between


@cache
def _own_tables() -> Float:
    return tables_of(own_file())


def own_file() -> dict[str, Any]:
    """Return the content of the package's tables, written by examples/fit_confidence.py."""
    return read_json(_FILE)


def tables_of(written: dict[str, Any]) -> Float:
    """Return the (G,R) share of outliers from the content of a file as `own_file` returns."""
    middle = (np.arange(NUM_RANKS) + 0.5) / NUM_RANKS
    return np.array([np.interp(middle, *np.array(written["tables"][g]).T) for g in GROUPS])


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
