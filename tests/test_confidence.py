# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.depth.layers import Layers
from densify.geometry.types import DepthMap
from densify.scores.depth_metrics import is_outlier_depth
from tests.scenes import CAMERA


def made(confidence, filled_m) -> DepthMap:
    shape = confidence.shape
    measured_m = np.where(np.arange(shape[1]) % 2 == 0, filled_m, 0).astype(np.float32)
    frame = np.zeros(shape, np.int32)
    return DepthMap("front", measured_m, filled_m, confidence, frame)


def test_a_fifth_more_is_ten_times_less_wrong():
    assert scale.wrong(np.array([0, 0.2, 0.4, 1.0])) == pytest.approx([1, 0.1, 0.01, 1e-5])


def layers(rank: np.ndarray, filled: np.ndarray, rejected: np.ndarray) -> Layers:
    """A wall at 10 m, with rays 4 px apart."""
    shape = rank.shape
    wall_m = np.full(shape, 10.0, np.float32)
    return Layers(
        depth_m=np.where(filled | rejected, 0, wall_m),
        rim_m=np.where(rejected, wall_m, 0),
        filled_m=np.where(rejected, 0, wall_m),
        confidence=rank.astype(np.float32),
        point=np.zeros(shape, np.int32),
        tilt=np.zeros((*shape, 2), np.float32),
        spacing_px=np.full((*shape, 2), 4, np.float32),
    )


def outlier_probability(made: Layers) -> np.ndarray:
    wrong = np.full(made.filled_m.shape, np.nan)
    wrong[made.filled_m > 0] = scale.wrong(scale.confidence_of(scale.features(made)))
    return wrong


def test_doubt_foliage_and_steps_raise_the_probability_of_an_outlier():
    rng, shape = np.random.default_rng(3), (120, 160)
    rank = np.linspace(0, 1, shape[1]) * np.ones(shape)
    none = np.zeros(shape, bool)
    for filled in (none, ~none):
        wrong = outlier_probability(layers(rank, filled, none))
        assert (np.diff(wrong, axis=1) < 0).all() and 0 < wrong.min() < wrong.max() < 0.2
    half = np.ones(shape) / 2
    hedge = (rng.random(shape) < 0.4) & (np.arange(shape[1]) > 110)
    wrong = outlier_probability(layers(half, none, hedge))
    assert np.nanmean(wrong[:, 120:]) > 5 * np.nanmean(wrong[:, :40])
    step = layers(half, none, none)
    step.filled_m[:, 80:] = 20.0
    wrong = outlier_probability(step)
    assert wrong[:, 78:82].mean() > 1.5 * wrong[:, :40].mean()


def test_no_weight_rewards_what_speaks_against_a_pixel():
    names = [name for name in scale.WEIGHTS if name not in ("every pixel", "filled pixel")]
    assert all(scale.WEIGHTS[name] >= 0 for name in names)


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


def test_without_times_a_depth_may_be_moved_by_any_amount_up_to_the_smear():
    rng, smear_m = np.random.default_rng(6), 0.5
    for depth_m in (3.0, 6.0, 9.0, 30.0):
        filled_m = np.full((300, 400), depth_m, np.float32)
        maps = made(np.full(filled_m.shape, 0.6, np.float32), filled_m)
        truth_m = filled_m + rng.uniform(-smear_m, smear_m, filled_m.shape).astype(np.float32)
        bad = is_outlier_depth(filled_m, truth_m, CAMERA.focal_px).mean()
        for share in (1.0, 0.4):
            found = scale.without_times(maps, smear_m, CAMERA, share)
            expected = scale.expected_outliers(found)["filled"]
            assert expected == pytest.approx(share * bad + 10**-3, abs=0.03)
