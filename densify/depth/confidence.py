# SPDX-License-Identifier: MIT
"""Compute the confidence of pixels: the probability that a pixel is an outlier by KITTI's rule.

The probability P is that of a logistic regression (Cox, "The regression analysis of binary
sequences", 1958) on physical features of the pixel:

    P = 1 / (1 + exp(-(w0 + w1 x1 + ... + w9 x9)))

The weights `WEIGHTS` were fitted to exact truth of simulated streets and to the truth of real
recordings, each recording with equal weight, by ``examples/fit_confidence.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.depth.measured_pixels import ALL_ROUND, MapRecord
from densify.geometry.types import Bool, Camera, DepthMap, Float, Float32, Int
from densify.scores.depth_metrics import (
    DECADES,
    KITTI_BASELINE_M,
    OUTLIER_FRACTION,
    OUTLIER_PX,
    is_outlier_depth,
    outlier_probability,
)

WEIGHTS: Mapping[str, float] = {
    "every pixel": -8.50,
    "filled pixel": 0.37,
    "votes of the image against the depth": 0.44,
    "rejected boundary pixels within 2 spacings": 0.76,
    "rejected boundary pixels within 8 spacings": 0.89,
    "step of depth within a spacing": 0.62,
    "age": 0.51,
    "pixels without a depth within 2 spacings": 0.54,
    "nearness of a depth discontinuity": 0.64,
    "rejected pixel": 1.30,
}
"""Weight of each feature, see `features`."""
_LEAST_VOTES, _LEAST_SHARE, _LEAST_STEP = 0.001, 0.005, 0.03  # smaller values are not told apart
_AGE_S, _LEAST_COVER = 0.03, 0.05
_NUM_STEPS = 20
_UNCONFIRMED = 2.7  # found / expected outliers of one sweep alone: 0.9 to 6, on six recordings


def features(record: MapRecord, since_key_ns: Int, camera: Camera) -> Float32:
    """Return the (P,10) features of the P pixels with a filled or rejected depth, row by row.

    Shares, steps and ages enter by their logarithm to base 10, because probabilities of errors are
    proportional to powers of them. The step is the logarithm of the ratio of the greatest to the
    least depth around, as a multiple of the tolerance of KITTI's rule. Age and discontinuity are
    those of the nearest measured pixel. A moving body has no discontinuity. Spacings are those of
    neighbouring rays.

    Args:
        record: The map, before `densify.depth.fill.measure_spots`.
        since_key_ns: (M,) ns from the key sweep of the points of the cloud.
        camera: Camera of the map.
    """
    shown, rejected = record.filled_m > 0, record.rejected_m > 0
    has_depth, depth_m = shown | rejected, np.where(shown, record.filled_m, record.rejected_m)
    measured = record.depth_m > 0
    gap_px = float(np.median(record.gap_px))
    nearest = nearest_pixel(measured)
    age_s = np.abs(since_key_ns[record.point[nearest]]) * 1e-9 if measured.any() else 0 * depth_m
    edge = np.where(measured, record.edge, 0)[nearest]
    edge[record.on_body] = ALL_ROUND
    step = _step(depth_m, record.filled_m, _size(1, gap_px)) / tolerance(depth_m, camera)
    around_px = _size(2, gap_px)
    cover = _mean(shown, around_px) / _mean(np.ones_like(shown), around_px)  # within the image
    columns = [
        np.ones(shown.shape),
        ~measured,
        _logarithm(1 - record.votes, _LEAST_VOTES),
        *(_rejected(record, _size(reach, gap_px)) for reach in (2, 8)),
        _logarithm(step, _LEAST_STEP),
        _logarithm(age_s, _AGE_S),
        -np.log2(np.maximum(cover, _LEAST_COVER)),
        np.clip(ALL_ROUND - edge, 0, ALL_ROUND - 1),
        rejected,
    ]
    return np.stack([column[has_depth] for column in columns], axis=1).astype(np.float32)


def nearest_pixel(known: Bool) -> tuple[Int, Int]:
    """Return the (H,W) rows and the (H,W) columns of the nearest known pixel of each pixel."""
    row, column = ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    return row, column


def tolerance(depth_m: Float32, camera: Camera) -> Float:
    """Return the error from which a depth in metres is an outlier, as a share of the depth."""
    px = depth_m.astype(np.float64) / (camera.focal_px * KITTI_BASELINE_M)
    share: Float = np.maximum(OUTLIER_PX * px, OUTLIER_FRACTION)
    return share


def _logarithm(values: Float | Float32, least: float) -> Float:
    logarithm: Float = np.log10(values / least + 1)
    return logarithm


def _size(spacings: float, gap_px: float) -> int:
    """Return the width in pixels of a window that reaches so many spacings to all sides."""
    return 2 * max(2, round(spacings * gap_px)) + 1


def _mean(mask: Bool, size_px: int) -> Float32:
    mean: Float32 = ndimage.uniform_filter(mask.astype(np.float32), size_px, mode="constant")
    return mean


def _rejected(record: MapRecord, size_px: int) -> Float:
    """Return the (H,W) logarithm of the share of boundary pixels around that are not accepted."""
    rejected, measured = (record.boundary_m > 0) & (record.depth_m == 0), record.depth_m > 0
    share = _mean(rejected, size_px) / np.maximum(_mean(rejected | measured, size_px), 1e-4)
    return _logarithm(share, _LEAST_SHARE)


def _step(depth_m: Float32, around_m: Float32, size_px: int) -> Float32:
    """Return the (H,W) logarithm of the greatest by the least depth of a pixel and those around."""
    far_m, near_m = np.maximum(depth_m, around_m), np.where(around_m > 0, around_m, np.inf)
    near_m = np.minimum(near_m, np.where(depth_m > 0, depth_m, np.inf)).astype(np.float32)
    far_m = np.maximum(ndimage.maximum_filter(around_m, size_px), far_m)
    near_m = np.minimum(ndimage.minimum_filter(near_m, size_px), near_m)
    step = np.zeros_like(depth_m)
    np.log(far_m / near_m, out=step, where=depth_m > 0)
    return step


def confidence_of(evidence: NDArray[np.floating], weights: Float | None = None) -> Float32:
    """Return the (P,) confidence ``-log10(P) / 5`` of pixels with `features` (P,10)."""
    used = np.array([*WEIGHTS.values()]) if weights is None else weights
    log_p = -np.logaddexp(0, -(evidence @ used)) / np.log(10)
    return np.clip(-log_p / DECADES, 0, 1).astype(np.float32)


def confidence_by_age(since_key_ns: Int) -> Float32:
    """Return (M,) relative scores 1 / (1 + t) of 0 to 1, for sweeps t seconds from the key."""
    return (1 / (1 + np.abs(since_key_ns) * 1e-9)).astype(np.float32)


def most_certain(confidence: Float32, max_outliers: float, before: Float32 | None = None) -> Bool:
    """Return (P,) True at the most certain pixels, as many as keep the expected outliers low.

    Args:
        confidence: (P,) confidences of the pixels to choose from.
        max_outliers: Greatest expected share of outliers, of the chosen pixels and those before.
        before: Confidences of pixels that are chosen already; None for none.
    """
    first = outlier_probability(np.zeros(0) if before is None else before)
    best_first = np.argsort(-confidence, kind="stable")
    sums = first.sum() + np.cumsum(outlier_probability(confidence[best_first]))
    enough = sums <= max_outliers * (len(first) + 1 + np.arange(len(sums)))
    chosen = np.zeros(len(confidence), bool)
    chosen[best_first[: int(np.flatnonzero(enough).max(initial=-1)) + 1]] = True
    return chosen


def with_max_outliers(maps: DepthMap, max_outliers: float | None) -> DepthMap:
    """Return the map with as many pixels as keep the expected share of outliers at a value.

    If the map expects fewer outliers, the most certain of its rejected pixels are given back. If it
    expects more, its least certain pixels are left out. A map without calibrated confidence stays.

    Args:
        maps: Map of the rules with its ``rejected`` pixels.
        max_outliers: Greatest expected share of outliers of the filled map; None for the map of the
            rules.
    """
    rejected, shown = maps.rejected, maps.filled_m > 0
    if rejected is None or max_outliers is None:
        return replace(maps, rejected=None)
    kept, back, confidence = shown.copy(), rejected.depth_m > 0, maps.confidence[shown]
    if shown.any() and outlier_probability(confidence).mean() > max_outliers:
        kept[shown] = most_certain(confidence, max_outliers)
        back[:] = False
    else:
        back[back] = most_certain(rejected.confidence[back], max_outliers, confidence)
    measured = back & (rejected.frame >= 0)
    return replace(
        maps,
        depth_m=np.select([measured, kept], [rejected.depth_m, maps.depth_m]),
        filled_m=np.select([back, kept], [rejected.depth_m, maps.filled_m]),
        confidence=np.select([back, kept], [rejected.confidence, maps.confidence]),
        frame=np.select([measured, kept], [rejected.frame, maps.frame], np.int32(-1)),
        evidence=None,
        rejected=None,
    )


def without_times(maps: DepthMap, smear_m: float, camera: Camera, share: float = 1.0) -> DepthMap:
    """Return the map with lower confidence at near pixels, for sweeps without times of points.

    The vehicle's motion within such a sweep moves depths by an unknown amount up to ``smear_m`` in
    either direction. Near pixels tolerate less of it than far pixels.

    Args:
        smear_m: Half the travel in metres along the camera's axis from sweep to sweep.
        share: Share of the sweeps without times.
    """

    def either(probability: Float, depth_m: Float32) -> Float:
        tolerated_m = depth_m * tolerance(depth_m, camera)
        smeared = share * np.clip(1 - tolerated_m / max(smear_m, 1e-9), 0, 1)
        return 1 - (1 - probability) * (1 - smeared)

    return _with_probability(maps, either)


def unconfirmed(maps: DepthMap) -> DepthMap:
    """Return the map of one sweep alone, with the outliers that no other sweep could contradict."""
    return _with_probability(maps, lambda probability, _: _UNCONFIRMED * probability)


def _with_probability(maps: DepthMap, changed: Callable[[Float, Float32], Float]) -> DepthMap:
    """Return the map with each probability P of an outlier changed to ``changed(P, depth_m)``."""

    def lowered(confidence: Float32, depth_m: Float32) -> Float32:
        probability = changed(outlier_probability(confidence), depth_m)
        lower = np.clip(-np.log10(np.maximum(probability, 10.0**-DECADES)) / DECADES, 0, 1)
        return np.where(depth_m > 0, lower, 0).astype(np.float32)

    rejected, confidence = maps.rejected, lowered(maps.confidence, maps.filled_m)
    if rejected is not None:
        rejected = rejected._replace(confidence=lowered(rejected.confidence, rejected.depth_m))
    return replace(maps, confidence=confidence, rejected=rejected)


def expected_outliers(maps: DepthMap) -> dict[str, float | None]:
    """Return the expected share of outliers of the ``measured`` and the ``filled`` map."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
        probability = outlier_probability(maps.confidence[depth_m > 0])
        shares[name] = float(probability.mean()) if len(probability) else None
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
    expected = np.bincount(step, outlier_probability(confidence), _NUM_STEPS)
    num_outliers = np.bincount(step, bad, _NUM_STEPS)
    return [
        {
            "confidence": i / _NUM_STEPS,
            "num_compared": int(num[i]),
            "expected": float(expected[i] / num[i]),
            "outliers": float(num_outliers[i] / num[i]),
        }
        for i in np.flatnonzero(num).tolist()
    ]
