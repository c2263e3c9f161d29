# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.geometry.types import DepthMap, Ranked
from densify.scores.depth_metrics import is_outlier_depth
from tests.scenes import CAMERA

SMOOTH, FENCE, FILLED = 0, 1, 7
"""Of `scale.GROUPS`: of the window, smooth and rough from .1; filled, rough from .1."""


def made(confidence, filled_m) -> DepthMap:
    shape = confidence.shape
    measured_m = np.where(np.arange(shape[1]) % 2 == 0, filled_m, 0).astype(np.float32)
    frame = np.zeros(shape, np.int32)
    return DepthMap("front", measured_m, filled_m, confidence, frame)


def test_a_fifth_more_is_ten_times_less_wrong():
    assert scale.wrong(np.array([0, 0.2, 0.4, 1.0])) == pytest.approx([1, 0.1, 0.01, 1e-5])


def tables() -> np.ndarray:
    """(G,R) shares, which fall by a decade over the ranks, and are higher at rough places."""
    at_zero = np.array([0.001, 0.03, 0.1] * (len(scale.GROUPS) // 3))
    return at_zero[:, None] * 10.0 ** -np.linspace(0, 1, scale.NUM_RANKS)


@pytest.mark.parametrize("groups", [(SMOOTH,), (SMOOTH, FENCE), (FILLED,)])
def test_calibration_keeps_the_order(groups):
    """Of pixels measured, and of pixels filled, wherever they are."""
    rng = np.random.default_rng(3)
    rank = np.linspace(0, 1, 4000, dtype=np.float32).reshape(40, 100)
    ranked = Ranked(rank, rng.choice(groups, rank.shape).astype(np.uint8))
    confidence = scale.calibrated(ranked, np.ones(rank.shape, bool))
    assert confidence.dtype == np.float32
    assert (np.diff(confidence.ravel()) > 0).all()
    assert confidence.min() >= 0 and confidence.max() <= 1


def test_a_map_expects_what_its_own_pixels_are_worth():
    """Hedges cost a map as much confidence as there are of them, and empty pixels nothing."""
    rng = np.random.default_rng(4)
    worth = tables()
    rank = rng.uniform(size=(200, 300)).astype(np.float32)
    for share in (0.0, 0.2, 0.9):
        hedge, filled = rng.uniform(size=(2, *rank.shape)) < [[[share]], [[0.5]]]
        group = (np.where(filled, FILLED, SMOOTH) + hedge).astype(np.uint8)
        shown = rng.uniform(size=rank.shape) < 0.6
        confidence = scale.calibrated(Ranked(rank, group), shown, worth)
        assert (confidence[~shown] == 0).all()
        step = np.minimum((rank * scale.NUM_RANKS).astype(int), scale.NUM_RANKS - 1)
        for part in (shown & filled, shown & ~filled):
            expected = worth[group[part], step[part]].mean()
            assert scale.wrong(confidence[part]).mean() == pytest.approx(expected, rel=0.03)


def test_the_packages_own_tables_fall_with_the_rank():
    own = scale.tables_of(scale.own_file())
    assert own.shape == (len(scale.GROUPS), scale.NUM_RANKS)
    assert (np.diff(own) <= 1e-9).all() and own.min() >= 0
    assert own[2::3].mean() > 3 * own[::3].mean()


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
