# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.types import DepthMap
from tests.scenes import CAMERA


def made(confidence, filled_m) -> DepthMap:
    shape = confidence.shape
    measured_m = np.where(np.arange(shape[1]) % 2 == 0, filled_m, 0).astype(np.float32)
    frame = np.zeros(shape, np.int32)
    return DepthMap("front", measured_m, filled_m, confidence, frame)


def test_a_fifth_more_is_ten_times_less_wrong():
    assert scale.wrong(np.array([0, 0.2, 0.4, 1.0])) == pytest.approx([1, 0.1, 0.01, 1e-5])


@pytest.mark.parametrize("measured", [True, False])
def test_calibration_keeps_the_order(measured):
    rank = np.linspace(0, 1, 400, dtype=np.float32)
    confidence = scale.calibrated(rank, np.full(400, measured))
    assert confidence.dtype == np.float32
    assert (np.diff(confidence) > 0).all() and confidence[0] >= 0 and confidence[-1] <= 1


def test_reliability_counts_what_is_wrong():
    rng = np.random.default_rng(5)
    confidence = rng.uniform(0.2, 0.55, (400, 500)).astype(np.float32)
    truth_m = rng.uniform(3, 12, confidence.shape).astype(np.float32)
    bad = rng.uniform(size=confidence.shape) < scale.wrong(confidence)
    maps = made(confidence, np.where(bad, 3 * truth_m, 1.01 * truth_m).astype(np.float32))
    steps = scale.reliability(maps, truth_m, CAMERA)
    assert [step["confidence"] for step in steps] == pytest.approx(0.2 + 0.05 * np.arange(7))
    assert sum(step["num_compared"] for step in steps) == confidence.size
    for step in steps:
        noise = 4 * np.sqrt(step["expected"] / step["num_compared"])
        assert abs(step["outliers"] - step["expected"]) < noise
    shares = scale.expected_outliers(maps)
    assert shares["filled"] == pytest.approx(bad.mean(), rel=0.03)
    assert shares["measured"] == pytest.approx(scale.wrong(confidence[:, ::2]).mean())


def test_nothing_is_expected_of_an_empty_map():
    empty = np.zeros((4, 6), np.float32)
    maps = made(empty, empty)
    assert scale.expected_outliers(maps) == {"measured": None, "filled": None}
    assert scale.reliability(maps, empty, CAMERA) == []
