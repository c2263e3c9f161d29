# SPDX-License-Identifier: MIT
"""Compare depth with ground truth, as lists of pixels or whole maps.

The definitions are from KITTI's depth development kit (``evaluate_depth.cpp``; Uhrig et al.,
"Sparsity Invariant CNNs", 3DV 2017). The kit fills holes before it scores; here a missing pixel
lowers the coverage and is no error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import ndimage

from densify.geometry.types import Bool, Camera, DepthMap, Float, Float32

KITTI_BASELINE_M = 0.54
OUTLIER_PX = 3.0
OUTLIER_FRACTION = 0.05
DECADES = 5.0
"""Confidence 1 means one outlier in 10^5 pixels; each 0.2 less means ten times as many."""
LEAST_PIXELS = 200
"""A share of fewer compared pixels is no result, and is not shown."""
_DELTA = 1.25
_RANGES_M = (0, 10, 20, 30, 50, 80)
_EDGE_PX = 3
_LEAST_CONFIDENCES = tuple(round(0.05 * step, 2) for step in range(20))


@dataclass(frozen=True)
class DepthErrors:
    """Errors of depth z against the true depth t. An error over no pixels is None."""

    num_pixels: int  # pixels with a true depth
    num_compared: int  # pixels with both depths, over which the errors are taken
    coverage: float | None  # num_compared / num_pixels
    mae_m: float | None  # mean of |z - t|
    rmse_m: float | None  # root mean square of z - t
    imae_per_km: float | None  # mean of |1/z - 1/t|
    irmse_per_km: float | None  # root mean square of 1/z - 1/t
    abs_rel: float | None  # mean of |z - t| / t
    sq_rel: float | None  # mean of (z - t)² / t²
    # Shares of pixels with max(z/t, t/z) < 1.25, 1.25² and 1.25³ (Eigen et al., NIPS 2014)
    delta_1: float | None
    delta_2: float | None
    delta_3: float | None
    # Share of outliers by the rule of KITTI's 2015 stereo benchmark (Menze and Geiger, "Object
    # Scene Flow for Autonomous Vehicles", CVPR 2015)
    outliers: float | None
    outliers_1_px: float | None  # share of pixels whose disparity is off by more than 1 px
    # Standard deviation of ln(z/t), the scale-invariant error (Eigen et al., NIPS 2014)
    silog: float | None


def depth_errors(
    predicted_m: Float | Float32,
    truth_m: Float | Float32,
    mask: Bool | None = None,
    *,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> DepthErrors:
    """Return the errors of depths over the pixels with ground truth, or those of a mask.

    Both are (H,W) maps or (N,) lists of depths, camera z in metres, 0 for none. A depth z is an
    outlier if its disparity ``focal_px * baseline_m / z`` differs by more than 3 px *and* by more
    than 5 % from the true disparity.
    """
    has_truth = truth_m > 0 if mask is None else (truth_m > 0) & mask
    is_compared = has_truth & (predicted_m > 0)
    num_pixels = int(has_truth.sum())
    num_compared = int(is_compared.sum())
    z = predicted_m[is_compared].astype(float)
    t = truth_m[is_compared].astype(float)
    error_m = np.abs(z - t)
    error_per_km = np.abs(1000 / z - 1000 / t)
    ratio = np.maximum(z / t, t / z)
    return DepthErrors(
        num_pixels=num_pixels,
        num_compared=num_compared,
        coverage=num_compared / num_pixels if num_pixels else None,
        mae_m=mean_or_none(error_m),
        rmse_m=_root_mean_square(error_m),
        imae_per_km=mean_or_none(error_per_km),
        irmse_per_km=_root_mean_square(error_per_km),
        abs_rel=mean_or_none(error_m / t),
        sq_rel=mean_or_none((error_m / t) ** 2),
        delta_1=mean_or_none(ratio < _DELTA),
        delta_2=mean_or_none(ratio < _DELTA**2),
        delta_3=mean_or_none(ratio < _DELTA**3),
        outliers=mean_or_none(is_outlier_depth(z, t, focal_px, baseline_m)),
        outliers_1_px=mean_or_none(focal_px * baseline_m * np.abs(1 / z - 1 / t) > 1),
        silog=float(np.std(np.log(z / t))) if num_compared else None,
    )


def precision_density(
    maps: DepthMap, truth_m: Float32, camera: Camera
) -> list[dict[str, float | None]]:
    """Return density and share of outliers for each least confidence 0, 0.05, … 0.95.

    Each dictionary has ``min_confidence``, and for ``measured`` and ``filled`` depth:
    ``density_*``, share of the pixels that keep a depth; ``outliers_*``, share of outliers among
    those with a true depth ``truth_m``; ``expected_*``, share of outliers that the confidence of
    the kept pixels promises. The latter two are None without such pixels.
    """
    curve = []
    for min_confidence in _LEAST_CONFIDENCES:
        is_kept = maps.confidence >= min_confidence
        point: dict[str, float | None] = {"min_confidence": min_confidence}
        for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
            predicted_m = np.where(is_kept, depth_m, np.float32(0))
            errors = depth_errors(predicted_m, truth_m, focal_px=camera.focal_px)
            point[f"density_{name}"] = image_density(predicted_m)
            point[f"outliers_{name}"] = errors.outliers
            kept_confidence = maps.confidence[predicted_m > 0]
            point[f"expected_{name}"] = mean_or_none(outlier_probability(kept_confidence))
        curve.append(point)
    return curve


def errors_by_part(
    predicted_m: Float32,
    truth_m: Float32,
    moving: Bool | None = None,
    *,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> dict[str, DepthErrors]:
    """Return `depth_errors` of parts of the pixels (H,W), by name of the part.

    The parts are ``all`` pixels, ranges of true depth (``0-10 m`` … ``over 80 m``), `depth_edges`
    (``edge``), other pixels (``not edge``) and, given the mask ``moving``, ``moving`` and
    ``static`` pixels. Depths are metres, 0 for none.
    """
    known = truth_m > 0
    z, t = predicted_m[known], truth_m[known]
    masks: dict[str, Bool | None] = {"all": None}
    for near_m, far_m in pairwise(_RANGES_M):
        masks[f"{near_m}-{far_m} m"] = (t >= near_m) & (t < far_m)
    masks[f"over {_RANGES_M[-1]} m"] = t >= _RANGES_M[-1]
    edge = depth_edges(truth_m, focal_px=focal_px, baseline_m=baseline_m)[known]
    masks |= {"edge": edge, "not edge": ~edge}
    if moving is not None:
        masks |= {"moving": moving[known], "static": ~moving[known]}
    return {
        name: depth_errors(z, t, mask, focal_px=focal_px, baseline_m=baseline_m)
        for name, mask in masks.items()
    }


def depth_edges(truth_m: Float32, *, focal_px: float, baseline_m: float = KITTI_BASELINE_M) -> Bool:
    """Return (H,W) True at pixels with a true depth in metres close to a depth discontinuity.

    Within 3 px of such a pixel, another true depth would be an outlier at this pixel. Level ground
    is no discontinuity: for a camera 1.65 m above it, disparity grows by 0.54/1.65 px per row.
    """
    known = truth_m > 0
    disparity_px = np.zeros(truth_m.shape)
    np.divide(focal_px * baseline_m, truth_m, out=disparity_px, where=known)
    size = 2 * _EDGE_PX + 1
    largest = ndimage.maximum_filter(disparity_px, size, mode="constant", cval=0.0)
    holes_out = np.where(known, disparity_px, math.inf)
    smallest = ndimage.minimum_filter(holes_out, size, mode="constant", cval=math.inf)
    edge = np.zeros(truth_m.shape, bool)
    known_px = disparity_px[known]
    edge[known] = _is_outlier(largest[known], known_px) | _is_outlier(smallest[known], known_px)
    return edge


def mean_errors(images: Sequence[DepthErrors]) -> DepthErrors:
    """Return the mean of each error over images where it is defined, and the sum of the counts."""
    means: dict[str, Any] = {}
    for field in fields(DepthErrors):
        values = [value for image in images if (value := getattr(image, field.name)) is not None]
        counted = field.name.startswith("num_")
        means[field.name] = sum(values) if counted else mean_or_none(np.array(values))
    return DepthErrors(**means)


def image_density(depth_m: Float32) -> float:
    """Return the share (0 to 1) of the image's pixels that have a depth."""
    return float(np.mean(depth_m > 0)) if depth_m.size else 0.0


def depth_scores(
    depth: DepthMap, truth_depth_m: Float32, moving_mask: Bool, camera: Camera
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return `depth_errors` as ``scores["measured"|"filled"]["all"|"moving"|"static"]``.

    ``truth_depth_m`` (H,W) is in metres, 0 for none; ``moving_mask`` (H,W) is True if moving.
    """
    return {
        product: scores_by_motion(image, truth_depth_m, moving_mask, camera)
        for product, image in (("measured", depth.depth_m), ("filled", depth.filled_m))
    }


def scores_by_motion(
    depth_m: Float32, truth_depth_m: Float32, moving_mask: Bool, camera: Camera
) -> dict[str, dict[str, Any]]:
    """Return `depth_errors` of depths (H,W), metres, as ``scores["all"|"moving"|"static"]``."""
    masks = {"all": None, "moving": moving_mask, "static": ~moving_mask}
    return {
        group: asdict(depth_errors(depth_m, truth_depth_m, mask, focal_px=camera.focal_px))
        for group, mask in masks.items()
    }


def shares_by_motion(mask: Bool, moving: Bool) -> dict[str, float | None]:
    """Return the share of a mask (N,) among ``all``, ``moving`` and ``static`` rows, else None."""
    parts = {"all": mask, "moving": mask[moving], "static": mask[~moving]}
    return {name: mean_or_none(part) for name, part in parts.items()}


def outlier_probability(confidence: Float | Float32) -> Float:
    """Return the probability, in the shape of ``confidence``, of an outlier by KITTI's rule.

    It is ``10 ** (-5 * confidence)``. A pixel value v above 0 of a confidence PNG means the
    confidence ``(v - 1) / 254``.
    """
    return 10.0 ** (-DECADES * np.asarray(confidence, np.float64))


def is_outlier_depth(
    predicted_m: Float | Float32,
    truth_m: Float | Float32,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> Bool:
    """Return (N,) True where a depth (N,) above 0 is an outlier by KITTI's rule."""
    disparity_m_px = focal_px * baseline_m
    predicted_px = disparity_m_px / predicted_m.astype(np.float64)
    return _is_outlier(predicted_px, disparity_m_px / truth_m.astype(np.float64))


def _is_outlier(disparity_px: Float, true_px: Float) -> Bool:
    """Return (N,) True where a disparity is an outlier by KITTI's rule."""
    error_px = np.abs(disparity_px - true_px)
    return (error_px > OUTLIER_PX) & (error_px > OUTLIER_FRACTION * true_px)


def mean_or_none(values: np.ndarray) -> float | None:
    """Return the mean, None for no values."""
    return float(np.mean(values)) if len(values) else None


def _root_mean_square(values: Float) -> float | None:
    """Return the root mean square, None for no values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
