# SPDX-License-Identifier: MIT
"""Compute the confidence of pixels from the probability that a pixel is an outlier (KITTI's rule).

The probability is a logistic regression (Cox, "The regression analysis of binary sequences", 1958)
on physical features, ``P = 1 / (1 + exp(-(w0 + w1 x1 + ... + w9 x9)))``, and the confidence
-log10(P) / 5, limited to 0 to 1. ``examples/fit_confidence.py`` fitted `WEIGHTS` to exact truth of
simulated streets and to the truth of real recordings, each with equal weight.
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
from densify.scores.metrics import (
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
# Scales of the features' logarithms: values below them are all close to 0
_LEAST_VOTES, _LEAST_SHARE, _LEAST_STEP, _LEAST_AGE_S, _LEAST_COVER = 0.001, 0.005, 0.03, 0.03, 0.05
_NUM_INTERVALS = 20  # number of intervals of confidence
# True outliers of one sweep alone / those expected: 0.9 to 6, on six recordings
_UNCONFIRMED = 2.7


def features(record: MapRecord, since_key_ns: Int, camera: Camera) -> Float32:
    """Return the features of the pixels with a filled or rejected depth.

    Shares, steps and ages enter by their logarithm to base 10, because probabilities of errors are
    proportional to powers of them. The step is the logarithm of the ratio of the greatest to the
    least depth around, as a multiple of the tolerance of KITTI's rule. Age and discontinuity are
    those of the nearest pixel with a return. A moving body has no discontinuity. Spacings are those
    of neighbouring rays. ``since_key_ns`` (M,) are the times of the cloud's points since the key.
    Filled pixels under laser spots must not count as measured yet. The result (P,10) has the pixels
    row by row, and the features in the order of `WEIGHTS`.
    """
    has_filled, is_rejected = record.filled_m > 0, record.rejected_m > 0
    has_depth = has_filled | is_rejected
    depth_m = np.where(has_filled, record.filled_m, record.rejected_m)
    is_measured = record.depth_m > 0
    gap_px = float(np.median(record.gap_px))

    # Of the nearest measured pixel
    nearest = nearest_pixel(is_measured)
    age_s: Float | Float32 = np.zeros_like(depth_m)
    if is_measured.any():
        age_s = np.abs(since_key_ns[record.point[nearest]]) * 1e-9
    edge_distance = np.where(is_measured, record.edge, 0)[nearest]
    edge_distance[record.on_body] = ALL_ROUND

    # Of the pixels around, without those outside the image
    step = _log_step(depth_m, record.filled_m, _window_px(1, gap_px)) / tolerance(depth_m, camera)
    window_px, wide_window_px = _window_px(2, gap_px), _window_px(8, gap_px)
    share_in_image = _mean(np.ones_like(has_filled), window_px)
    share_with_depth = np.maximum(_mean(has_filled, window_px) / share_in_image, _LEAST_COVER)
    columns: dict[str, NDArray[Any]] = {
        "every pixel": np.ones(has_filled.shape),
        "filled pixel": ~is_measured,
        "votes of the image against the depth": _logarithm(1 - record.votes, _LEAST_VOTES),
        "rejected boundary pixels within 2 spacings": _log_rejected_share(record, window_px),
        "rejected boundary pixels within 8 spacings": _log_rejected_share(record, wide_window_px),
        "step of depth within a spacing": _logarithm(step, _LEAST_STEP),
        "age": _logarithm(age_s, _LEAST_AGE_S),
        "pixels without a depth within 2 spacings": -np.log2(share_with_depth),
        "nearness of a depth discontinuity": np.clip(ALL_ROUND - edge_distance, 0, ALL_ROUND - 1),
        "rejected pixel": is_rejected,
    }
    return np.stack([columns[name][has_depth] for name in WEIGHTS], axis=1).astype(np.float32)


def nearest_pixel(mask: Bool) -> tuple[Int, Int]:
    """Return the row (H,W) and the column (H,W) of the True pixel nearest to each pixel."""
    row, column = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return row, column


def tolerance(depth_m: Float32, camera: Camera) -> Float:
    """Return the relative errors from which depths in metres are outliers by KITTI's rule."""
    px = depth_m.astype(np.float64) / (camera.focal_px * KITTI_BASELINE_M)
    return np.maximum(OUTLIER_PX * px, OUTLIER_FRACTION)


def _logarithm(values: Float | Float32, least: float) -> Float:
    """Return log10(1 + values / least), which is close to 0 for values below ``least``."""
    return np.log10(values / least + 1)


def _window_px(spacings: float, gap_px: float) -> int:
    """Return the width in pixels of a window that reaches ``spacings`` times ``gap_px`` around."""
    return 2 * max(2, round(spacings * gap_px)) + 1  # the central pixel, and as many on each side


def _mean(mask: Bool, size_px: int) -> Float32:
    """Return the (H,W) share of the mask in the window around each pixel, False outside."""
    return ndimage.uniform_filter(mask.astype(np.float32), size_px, mode="constant")


def _log_rejected_share(record: MapRecord, size_px: int) -> Float:
    """Return the (H,W) logarithm of the share of the pixels with a return that are rejected."""
    measured = record.depth_m > 0
    rejected = (record.boundary_m > 0) & ~measured
    share = _mean(rejected, size_px) / np.maximum(_mean(rejected | measured, size_px), 1e-4)
    return _logarithm(share, _LEAST_SHARE)


def _log_step(depth_m: Float32, filled_m: Float32, size_px: int) -> Float32:
    """Return the (H,W) log ratio of greatest to least depth in the window, 0 without a depth."""
    # These are the depths of filled pixels around, and the pixel's own, which may be rejected.
    own_m = np.where(depth_m > 0, depth_m, np.inf)
    least_m = np.minimum(np.where(filled_m > 0, filled_m, np.inf), own_m).astype(np.float32)
    nearest_m = ndimage.minimum_filter(least_m, size_px)
    farthest_m = np.maximum(ndimage.maximum_filter(filled_m, size_px), depth_m)
    step = np.zeros_like(depth_m)
    np.log(farthest_m / nearest_m, out=step, where=depth_m > 0)
    return step


def confidence_of(evidence: NDArray[np.floating], weights: Float | None = None) -> Float32:
    """Return the confidences (P,) of pixels with features (P,10), by `WEIGHTS` or others (10,)."""
    if weights is None:
        weights = np.array([*WEIGHTS.values()])
    log_p = -np.logaddexp(0, -(evidence @ weights)) / np.log(10)
    return np.clip(-log_p / DECADES, 0, 1).astype(np.float32)


def confidence_by_age(since_key_ns: Int) -> Float32:
    """Return the scores (M,) 1 / (1 + t), 0 to 1, of points measured t seconds from the key."""
    return (1 / (1 + np.abs(since_key_ns) * 1e-9)).astype(np.float32)


def choose_most_certain(
    confidence: Float32, max_outliers: float, before: Float32 | None = None
) -> Bool:
    """Return the mask (P,) of the most certain of pixels with confidences (P,).

    As many are chosen as keep the expected share of outliers at most ``max_outliers``. The share
    includes pixels with the confidences ``before``, which are chosen already.
    """
    before_probability = outlier_probability(np.zeros(0) if before is None else before)
    best_first = np.argsort(-confidence, kind="stable")
    # Expected outliers if the best pixel is chosen, the two best, and so on
    expected = before_probability.sum() + np.cumsum(outlier_probability(confidence[best_first]))
    num_pixels = len(before_probability) + 1 + np.arange(len(expected))
    is_low = expected <= max_outliers * num_pixels
    num_chosen = int(np.flatnonzero(is_low).max(initial=-1)) + 1
    chosen = np.zeros(len(confidence), bool)
    chosen[best_first[:num_chosen]] = True
    return chosen


def with_max_outliers(depth_map: DepthMap, max_outliers: float | None) -> DepthMap:
    """Return the map with as many pixels as possible at an expected share of outliers.

    If the map expects fewer outliers, the most certain of its rejected pixels are given back. If it
    expects more, its least certain pixels are left out. The result has no rejected pixels.
    Without calibrated confidence, or with ``max_outliers`` None, the map keeps its pixels.
    """
    rejected = depth_map.rejected
    if rejected is None or max_outliers is None:
        return replace(depth_map, rejected=None)
    # The (H,W) pixels that stay, and those that are restored from the rejected ones
    shown = depth_map.filled_m > 0
    confidence = depth_map.confidence[shown]
    stays = shown.copy()
    restored = rejected.depth_m > 0
    if shown.any() and outlier_probability(confidence).mean() > max_outliers:
        stays[shown] = choose_most_certain(confidence, max_outliers)
        restored[:] = False
    else:
        restored[restored] = choose_most_certain(
            rejected.confidence[restored], max_outliers, confidence
        )
    is_measured = restored & (rejected.frame >= 0)
    return replace(
        depth_map,
        depth_m=np.select([is_measured, stays], [rejected.depth_m, depth_map.depth_m]),
        filled_m=np.select([restored, stays], [rejected.depth_m, depth_map.filled_m]),
        confidence=np.select([restored, stays], [rejected.confidence, depth_map.confidence]),
        frame=np.select([is_measured, stays], [rejected.frame, depth_map.frame], np.int32(-1)),
        evidence=None,
        rejected=None,
    )


def without_times(
    depth_map: DepthMap, smear_m: float, camera: Camera, share: float = 1.0
) -> DepthMap:
    """Return the map with confidences lowered for sweeps without firing times.

    The vehicle's motion within such a sweep moves depths by an unknown amount. Near pixels tolerate
    less of this motion than far pixels. The greatest change of depth, ``smear_m``, is half the
    travel along the camera's axis from sweep to sweep. A ``share`` of the sweeps has no times.
    """

    def outlier_or_smeared(probability: Float, depth_m: Float32) -> Float:
        """Return the probability of an outlier by other causes or by the motion."""
        # All shifts up to smear_m are equally likely.
        tolerated_m = depth_m * tolerance(depth_m, camera)
        smeared = share * np.clip(1 - tolerated_m / max(smear_m, 1e-9), 0, 1)
        return 1 - (1 - probability) * (1 - smeared)

    return _with_probability(depth_map, outlier_or_smeared)


def without_confirmation(depth_map: DepthMap) -> DepthMap:
    """Return the map of a single sweep with confidences lowered, as no other sweep confirms it."""
    return _with_probability(depth_map, lambda probability, _: _UNCONFIRMED * probability)


def _with_probability(depth_map: DepthMap, change: Callable[[Float, Float32], Float]) -> DepthMap:
    """Return the map with each probability P of an outlier replaced by ``change(P, depth_m)``."""

    def changed_confidence(confidence: Float32, depth_m: Float32) -> Float32:
        """Return the (H,W) confidence of the changed probability, 0 where there is no depth."""
        probability = change(outlier_probability(confidence), depth_m)
        changed = np.clip(-np.log10(np.maximum(probability, 10.0**-DECADES)) / DECADES, 0, 1)
        return np.where(depth_m > 0, changed, 0).astype(np.float32)

    confidence = changed_confidence(depth_map.confidence, depth_map.filled_m)
    rejected = depth_map.rejected
    if rejected is not None:
        rejected_confidence = changed_confidence(rejected.confidence, rejected.depth_m)
        rejected = rejected._replace(confidence=rejected_confidence)
    return replace(depth_map, confidence=confidence, rejected=rejected)


def expected_outliers(depth_map: DepthMap) -> dict[str, float | None]:
    """Return the expected outlier share of ``measured`` and ``filled`` pixels, None without any."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", depth_map.depth_m), ("filled", depth_map.filled_m)):
        probability = outlier_probability(depth_map.confidence[depth_m > 0])
        shares[name] = float(probability.mean()) if len(probability) else None
    return shares


def reliability(depth_map: DepthMap, truth_m: Float32, camera: Camera) -> list[dict[str, Any]]:
    """Return the expected and the true share of outliers for each interval of confidence.

    Filled pixels with a true depth ``truth_m`` (H,W), metres, are compared. Each interval of 0.05
    with pixels has ``confidence`` (its start), ``num_compared`` pixels, and the ``expected`` and
    the true share of ``outliers``.
    """
    compared = (truth_m > 0) & (depth_map.filled_m > 0)
    confidence = depth_map.confidence[compared]
    is_outlier = is_outlier_depth(depth_map.filled_m[compared], truth_m[compared], camera.focal_px)
    # A confidence of 1 belongs to the last interval.
    interval = np.minimum((confidence * _NUM_INTERVALS).astype(np.int64), _NUM_INTERVALS - 1)
    num_pixels = np.bincount(interval, minlength=_NUM_INTERVALS)
    num_expected = np.bincount(interval, outlier_probability(confidence), _NUM_INTERVALS)
    num_outliers = np.bincount(interval, is_outlier, _NUM_INTERVALS)
    return [
        {
            "confidence": i / _NUM_INTERVALS,
            "num_compared": int(num_pixels[i]),
            "expected": float(num_expected[i] / num_pixels[i]),
            "outliers": float(num_outliers[i] / num_pixels[i]),
        }
        for i in np.flatnonzero(num_pixels).tolist()
    ]
