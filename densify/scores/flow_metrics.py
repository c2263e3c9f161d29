# SPDX-License-Identifier: MIT
"""Metrics of scene flow, each with its definition, unit and source.

Flow is (N,3) metres from one time to another, ego-motion removed; masks are (N,) bool. A mean over
nothing is NaN. Functions raise InputError where shapes do not fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, Int

STRICT, RELAXED = 0.05, 0.1
"""Metres, and parts of the true flow: the two limits of `accuracy`."""


class ThreeWayError(NamedTuple):
    """Metres. mean_m: of the three, NaN where one is."""

    foreground_dynamic_m: float
    foreground_static_m: float
    background_static_m: float
    mean_m: float


class BucketedError(NamedTuple):
    """static_m: metres. dynamic: error as a part of the speed; zero flow has 1."""

    static_m: float
    dynamic: float


def end_point_errors(estimated: ArrayLike, true: ArrayLike) -> Float:
    """Return (N,) metres, the length of the error at each point."""
    flow, truth = _flows(estimated, true)
    return np.linalg.norm(flow - truth, axis=1)


def end_point_error(estimated: ArrayLike, true: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return EPE, metres: the mean of `end_point_errors`, over ``mask`` if given (Liu, Qi, Guibas,
    "FlowNet3D", CVPR 2019)."""
    error_m = end_point_errors(estimated, true)
    return _mean(error_m if mask is None else error_m[_mask(mask, len(error_m), "mask")])


def accuracy(estimated: ArrayLike, true: ArrayLike, limit: float) -> float:
    """Return the share (0 to 1) of the points with an error below ``limit`` metres *or* below
    ``limit`` times the length of the true flow.

    limit: `STRICT` (0.05 m or 5 %) or `RELAXED` (0.1 m or 10 %), as FlowNet3D (CVPR 2019) and
    Pontes et al. (3DV 2020) count.
    """
    flow, truth = _flows(estimated, true)
    error_m = np.linalg.norm(flow - truth, axis=1)
    return _mean((error_m < limit) | (error_m < limit * np.linalg.norm(truth, axis=1)))


def angle_error_rad(estimated: ArrayLike, true: ArrayLike) -> float:
    """Return the mean angle between the estimated and the true flow, radians (Pontes et al., 3DV
    2020), over the points whose true flow is not 0; an estimate of 0 counts as a right angle."""
    flow, truth = _flows(estimated, true)
    moves = np.linalg.norm(truth, axis=1) > 0
    return _mean(_angles_rad(flow[moves], truth[moves]))


def three_way_error(
    estimated: ArrayLike, true: ArrayLike, moving: ArrayLike, foreground: ArrayLike
) -> ThreeWayError:
    """Return the mean end-point error of moving objects, static objects and static background
    (Chodosh, Ramanan, Lucey, "Re-Evaluating LiDAR Scene Flow", WACV 2024).

    moving: (N,). foreground: (N,) belongs to an object that could move. A moving background point
    counts nowhere.
    """
    error_m = end_point_errors(estimated, true)
    moves = _mask(moving, len(error_m), "moving")
    objects = _mask(foreground, len(error_m), "foreground")
    parts = [_mean(error_m[m]) for m in (objects & moves, objects & ~moves, ~objects & ~moves)]
    return ThreeWayError(parts[0], parts[1], parts[2], sum(parts) / 3)


def share_found(estimated_moving: ArrayLike, moving: ArrayLike) -> float:
    """Return the recall (0 to 1): the share of the moving points that are called moving."""
    true = np.asarray(moving)
    found = _mask(estimated_moving, true.size, "estimated_moving")
    return _mean(found[_mask(true, true.size, "moving")])


def errors_by_hops(estimated: ArrayLike, true: ArrayLike, hops: ArrayLike) -> dict[int, float]:
    """Return the mean end-point error, metres, by the number of sweeps between a point and the
    target. hops: (N,) whole numbers."""
    error_m = end_point_errors(estimated, true)
    steps: Int = np.asarray(hops)
    if steps.shape != error_m.shape or steps.dtype.kind not in "iu":
        raise InputError(
            f"hops: got {steps.dtype} of shape {steps.shape}, expected whole numbers of shape "
            f"{error_m.shape}, one for each point"
        )
    return {int(n): _mean(error_m[steps == n]) for n in np.unique(steps)}


def coverage(points: ArrayLike, true_points: ArrayLike, reach_m: float = 0.1) -> float:
    """Return the share (0 to 1) of the true accumulated points (K,3) that have an estimated one of
    (M,3) within ``reach_m``, metres, one frame."""
    cloud, truth = _points(points, "points"), _points(true_points, "true_points")
    if not len(truth) or not len(cloud):
        return 0.0 if len(truth) else float("nan")
    distance_m, _ = cKDTree(cloud).query(truth, distance_upper_bound=reach_m)
    return _mean(np.isfinite(distance_m))


def _angles_rad(a: Float, b: Float) -> Float:
    """Return (N,) angles between rows (N,3); a right angle where one of them is 0."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    dot = np.einsum("nd,nd->n", a, b)
    cosine = np.divide(dot, lengths, out=np.zeros(len(a)), where=lengths > 0)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _flows(estimated: ArrayLike, true: ArrayLike) -> tuple[Float, Float]:
    flow, truth = _points(estimated, "estimated flow"), _points(true, "true flow")
    if flow.shape != truth.shape:
        raise InputError(
            f"flow metrics: got {len(flow)} estimated and {len(truth)} true flow vectors, expected "
            f"as many; give both for the same points"
        )
    return flow, truth


def _points(values: ArrayLike, name: str) -> Float:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"flow metrics: {name}: got shape {array.shape}, expected (N,3) metres")
    return array


def _mask(values: ArrayLike, num_points: int, name: str) -> Bool:
    array = np.asarray(values)
    if array.shape != (num_points,) or array.dtype != bool:
        raise InputError(
            f"flow metrics: {name}: got {array.dtype} of shape {array.shape}, expected bool of "
            f"shape ({num_points},), one for each point"
        )
    return array


def _mean(values: ArrayLike) -> float:
    array = np.asarray(values)
    return float(array.mean()) if array.size else float("nan")
