# SPDX-License-Identifier: MIT
"""What a confidence means: the probability that a pixel's depth is right.

A map's stages rank its pixels. The rank is turned into the probability of a wrong depth by tables
measured where the truth is exact, on both cameras of eight streets: ``street`` seed 51,
``street:crossing`` 52, ``street:highway`` 53, ``street`` 54 with hdl32, ``street:crossing`` 55 with
vlp16, ``street`` 56 with os128, ``street:highway`` 57 with hdl32 and ``street:static`` 58; key 60,
but 80 of the crossings and of 57, and 70 of 53. They are the shares of wrong pixels by rank, every
map counted alike, made to fall with the rank (pool adjacent violators) and a little from knot to
knot: the order of pixels measured, and of those filled, stays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from densify.scores.depth_metrics import is_outlier_depth
from densify.types import Bool, Camera, DepthMap, Float, Float32

DECADES = 5.0
"""Confidence 1 is one wrong pixel in 10^5, each fifth less ten times as many."""

_NUM_STEPS = 20
# Rank -> share of wrong pixels, of those measured and those filled.
_MEASURED = (
    (0.000, 0.0615),
    (0.123, 0.041),
    (0.163, 0.013),
    (0.188, 0.0064),
    (0.378, 0.0058),
    (0.430, 0.0042),
    (0.472, 0.0023),
    (0.576, 0.0021),
    (0.626, 0.00207),
    (0.678, 0.002),
    (0.722, 0.00197),
    (0.771, 0.0015),
    (0.828, 0.00059),
    (0.877, 0.00016),
    (0.954, 1.8e-05),
    (1.000, 1.08e-05),
)
_FILLED = (
    (0.000, 0.096),
    (0.040, 0.064),
    (0.062, 0.063),
    (0.089, 0.059),
    (0.113, 0.031),
    (0.137, 0.014),
    (0.162, 0.01),
    (0.183, 0.0072),
    (0.227, 0.0065),
    (0.278, 0.0036),
    (0.325, 0.0033),
    (0.377, 0.003),
    (0.420, 0.00053),
    (0.475, 0.00048),
    (0.526, 0.00039),
    (0.567, 0.00021),
    (0.619, 9.1e-05),
    (0.728, 8.2e-05),
    (0.788, 8.08e-05),
    (0.854, 7.96e-05),
    (1.000, 4.77e-05),
)


def calibrated(rank: Float32, measured: Bool) -> Float32:
    """(H,W) ranks, 0 to 1, and whether pixels are measured or filled -> (H,W) confidence, 0 to 1:
    ``-log10(P) / 5`` with the probability P that a depth is wrong by KITTI's rule, see
    `densify.scores.depth_metrics.DepthErrors`."""
    log_wrong = np.where(measured, _log_wrong(rank, _MEASURED), _log_wrong(rank, _FILLED))
    confidence: Float32 = np.clip(-log_wrong / DECADES, 0.0, 1.0).astype(np.float32)
    return confidence


def _log_wrong(rank: Float32, table: tuple[tuple[float, float], ...]) -> Float:
    ranks, shares = zip(*table, strict=True)
    log_wrong: Float = np.interp(rank, ranks, np.log10(shares))
    return log_wrong


def wrong(confidence: Float | Float32) -> Float:
    """Confidence -> the probability that a depth is wrong, as `calibrated` has it."""
    probability: Float = 10.0 ** (-DECADES * np.asarray(confidence, np.float64))
    return probability


def expected_outliers(maps: DepthMap) -> dict[str, float | None]:
    """The expected share of wrong pixels of the ``measured`` and the ``filled`` map; None of a map
    without any."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
        some = depth_m > 0
        shares[name] = float(wrong(maps.confidence[some]).mean()) if some.any() else None
    return shares


def reliability(maps: DepthMap, truth_m: Float32, camera: Camera) -> list[dict[str, Any]]:
    """How far confidence keeps what it promises, over the pixels of ``filled_m`` with a truth.

    truth_m: (H,W) metres, 0 none. By confidence, in steps of 0.05: ``confidence`` where the step
    begins, ``num_compared`` pixels, the share of them ``expected`` to be wrong, and the share that
    is (``outliers``). Steps without a pixel are left out.
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
