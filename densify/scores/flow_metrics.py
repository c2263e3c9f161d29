# SPDX-License-Identifier: MIT
"""Compute metrics of scene flow, each with its definition, unit and source.

Flow is (N,3) metres from one time to another, ego-motion removed. A mean over no points is NaN.
Sources: Liu, Qi, Guibas, "FlowNet3D", CVPR 2019 (errors); Pontes et al., 3DV 2020 (angles).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float

STRICT, RELAXED = 0.05, 0.1
"""Limits of `accuracy`, both in metres and as a share of the true flow's length."""
CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OBJECT")
"""The challenge's classes; a point's class is the index. OBJECT is an object of unknown kind."""
IGNORED = 255
"""Class number of points that the challenge leaves out, such as signs."""
_WITHIN_M = 35.0  # the challenge's range, on each side of the vehicle
_MOVES_M = 0.05  # flow of a moving point, per sweep
_EDGES_M = np.linspace(0, 2.0, 51)  # lower edges of the buckets; the first holds static points


def end_point_errors(estimated: Float, true: Float) -> Float:
    """Return the (N,) end-point errors in metres, |estimated - true| of (N,3) flows."""
    return np.linalg.norm(np.asarray(estimated, np.float64) - np.asarray(true, np.float64), axis=1)


def end_point_error(estimated: Float, true: Float, mask: Bool | None = None) -> float:
    """Return the mean end-point error in metres of (N,3) flows, over ``mask`` (N,) if given."""
    error_m = end_point_errors(estimated, true)
    return mean_of(error_m if mask is None else error_m[mask])


def accuracy(estimated: Float, true: Float, limit: float) -> float:
    """Return the share of points with an end-point error below a limit.

    The limit is ``limit`` metres or, if larger, ``limit`` times the length of the true flow.
    """
    error_m = end_point_errors(estimated, true)
    return mean_of((error_m < limit) | (error_m < limit * np.linalg.norm(true, axis=1)))


def angle_error_rad(estimated: Float, true: Float) -> float:
    """Return the mean angle from true to estimated flow, where true flow is not 0.

    An estimate of 0 counts as a right angle.
    """
    length_m = np.linalg.norm(true, axis=1)
    flow, truth, length_m = (values[length_m > 0] for values in (estimated, true, length_m))
    lengths = np.linalg.norm(flow, axis=1) * length_m
    dot = np.einsum("nd,nd->n", flow, truth)
    cosine = np.divide(dot, lengths, out=np.zeros(len(flow)), where=lengths > 0)
    return mean_of(np.arccos(np.clip(cosine, -1.0, 1.0)))


def mean_of(values: Float | Bool) -> float:
    """Return the mean of the values, NaN if there are none."""
    return float(values.mean()) if len(values) else float("nan")


def challenge_scores(
    points: Float, estimated: Float, true: Float, classes: NDArray[Any]
) -> dict[str, Any]:
    """Score flow as the Argoverse 2 scene flow challenges do, within 35 m of the vehicle.

    Args:
        points: (N,3) metres, vehicle frame, without ground.
        estimated: (N,3) estimated flow in metres.
        true: (N,3) true flow.
        classes: (N,) indices in `CLASSES`, or `IGNORED`.

    Returns:
        ``three_way``: mean errors in metres of moving objects (0.05 m a sweep or more), of other
            objects, of the static background, and the mean of the three (Chodosh, Ramanan, Lucey,
            WACV 2024; the package av2). ``bucketed``: for each class with points and MEAN,
            ``static_m``, the mean error in the first bucket of true flow, and ``dynamic``, the mean
            over the others of error divided by true length (Khatri et al., "I Can't Believe It's
            Not Scene Flow!", ECCV 2024; the package bucketed-scene-flow-eval). ``num_points``:
            number of scored points.
    """
    scored = np.abs(points[:, :2]).max(axis=1, initial=0) < _WITHIN_M
    scored &= classes < len(CLASSES)
    error_m = end_point_errors(estimated, true)[scored]
    length_m = np.linalg.norm(np.asarray(true, np.float64), axis=1)[scored]
    class_number = classes[scored].astype(np.intp)
    moves, is_object = length_m >= _MOVES_M, class_number > 0
    three_way = {
        "foreground_dynamic_m": mean_of(error_m[is_object & moves]),
        "foreground_static_m": mean_of(error_m[is_object & ~moves]),
        "background_static_m": mean_of(error_m[~is_object & ~moves]),
    }
    three_way["mean_m"] = sum(three_way.values()) / len(three_way)
    bucket = np.digitize(length_m, _EDGES_M) - 1
    bucketed = {
        CLASSES[number]: _bucketed(
            *(column[class_number == number] for column in (error_m, length_m, bucket))
        )
        for number in np.unique(class_number)
    }
    means = {}
    for name in ("static_m", "dynamic"):
        column = np.array([row[name] for row in bucketed.values()], np.float64)
        means[name] = mean_of(column[np.isfinite(column)])
    return {
        "three_way": three_way,
        "bucketed": {**bucketed, "MEAN": means},
        "num_points": int(scored.sum()),
    }


def _bucketed(error_m: Float, length_m: Float, bucket: NDArray[np.intp]) -> dict[str, float]:
    """Return the two scores of one class with points."""
    # Sums over the points of each bucket but the first
    errors, lengths = (
        np.bincount(bucket, values, len(_EDGES_M))[1:] for values in (error_m, length_m)
    )
    filled = lengths > 0
    quotients = errors[filled] / lengths[filled]
    return {"static_m": mean_of(error_m[bucket == 0]), "dynamic": mean_of(quotients)}
