# SPDX-License-Identifier: MIT
"""Compute metrics of scene flow, each with its definition, unit and source.

Flow is (N,3) metres from one time to another, ego-motion removed. A mean over no points is NaN.
Sources: Liu, Qi, Guibas, "FlowNet3D", CVPR 2019 (errors); Pontes et al., 3DV 2020 (angles).
"""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Bool, Float

STRICT, RELAXED = 0.05, 0.1
"""Limits of `accuracy`, both in metres and as a share of the true flow's length."""


def end_point_errors(estimated: Float, true: Float) -> Float:
    """Return the (N,) end-point errors in metres, |estimated - true| of (N,3) flows."""
    return np.linalg.norm(np.asarray(estimated, np.float64) - np.asarray(true, np.float64), axis=1)


def end_point_error(estimated: Float, true: Float, mask: Bool | None = None) -> float:
    """Return the mean end-point error in metres, over ``mask`` (N,) if given."""
    error_m = end_point_errors(estimated, true)
    return mean_of(error_m if mask is None else error_m[mask])


def accuracy(estimated: Float, true: Float, limit: float) -> float:
    """Return the share (0 to 1) of the points with a small end-point error.

    The error is below ``limit`` metres *or* below ``limit`` times the length of the true flow.
    """
    error_m = end_point_errors(estimated, true)
    return mean_of((error_m < limit) | (error_m < limit * np.linalg.norm(true, axis=1)))


def angle_error_rad(estimated: Float, true: Float) -> float:
    """Return the mean angle in radians between the estimated and the true flow.

    Points whose true flow is 0 do not count. An estimate of 0 counts as a right angle.
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
