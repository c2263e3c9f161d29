# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import densify
from densify.depth import confidence as scale
from densify.depth.measured_pixels import MapRecord
from densify.geometry.types import DepthMap, Rejected
from densify.scores.metrics import is_outlier_depth
from tests.depth_scenes import record_of
from tests.scenes import CAMERA

SHAPE = (120, 160)
COLUMN = np.arange(SHAPE[1]) * np.ones(SHAPE)


def made(confidence, filled_m) -> DepthMap:
    measured_m = np.where(np.arange(confidence.shape[1]) % 2 == 0, filled_m, 0).astype(np.float32)
    return DepthMap("front", measured_m, filled_m, confidence, np.zeros(filled_m.shape, np.int32))


def test_a_fifth_more_is_ten_times_less_wrong():
    values = np.array([0, 0.2, 0.4, 1.0])
    assert densify.outlier_probability(values) == pytest.approx([1, 0.1, 0.01, 1e-5])


def wall(**more) -> MapRecord:
    """A wall at 10 m, with rays 4 px apart."""
    return record_of(np.full(SHAPE, 10.0), spacing_px=(4, 4), **more)


def risk(record: MapRecord, age_s: float = 0.1) -> np.ndarray:
    ages_ns = np.full(record.point.max() + 1, round(1e9 * age_s))
    evidence = scale.features(record, ages_ns, CAMERA)
    probability = np.full(record.filled_m.shape, np.nan)
    some = (record.filled_m > 0) | (record.rejected_m > 0)
    probability[some] = scale.outlier_probability(scale.confidence_of(evidence))
    return probability


def test_what_speaks_against_a_pixel_raises_its_probability_of_an_outlier():
    rng, plain = np.random.default_rng(3), wall()
    usual = np.nanmean(risk(plain))
    assert 1e-5 < usual < 0.01
    votes = replace(plain, votes=(1 - COLUMN / 200).astype(np.float32))
    assert (np.diff(risk(votes)[:, 1:], axis=1) > 0).all()
    edges = replace(plain, edge=(3 * COLUMN / SHAPE[1]).astype(np.float32))
    assert (np.diff(risk(edges), axis=1) <= 0).all()
    assert np.nanmean(risk(plain, age_s=1.0)) > 1.2 * usual
    hedge = (rng.random(SHAPE) < 0.4) & (COLUMN > 110)
    boundary = np.where(hedge, 10.0, 0)
    rejected = record_of(10.0 * ~hedge, spacing_px=(4, 4), boundary_m=boundary)
    assert np.nanmean(risk(rejected)[:, 120:]) > 5 * np.nanmean(risk(rejected)[:, :80])
    holes = record_of(10.0 * ((COLUMN < 40) | (COLUMN > 100)), spacing_px=(4, 4))
    assert np.nanmean(risk(holes)[:, 36:40]) > np.nanmean(risk(holes)[:, :15])
    step = wall()
    step.filled_m[:, 80:] = 11.0
    near = risk(step)
    step.filled_m *= 20  # the rule allows more than 10 % of depth there
    far = risk(step)
    assert near[:, 78:82].mean() > 1.2 * near[:, :40].mean()
    assert far[:, 78:82].mean() < near[:, 78:82].mean()


def test_no_weight_rewards_what_speaks_against_a_pixel():
    of_either_sign = ("every pixel", "filled pixel", "rejected pixel")
    assert all(scale.WEIGHTS[name] >= 0 for name in scale.WEIGHTS if name not in of_either_sign)


def test_reliability_counts_what_is_wrong():
    rng = np.random.default_rng(5)
    confidence = rng.uniform(0.2, 0.55, (400, 500)).astype(np.float32)
    truth_m = rng.uniform(3, 12, confidence.shape).astype(np.float32)
    bad = rng.uniform(size=confidence.shape) < scale.outlier_probability(confidence)
    maps = made(confidence, np.where(bad, 3 * truth_m, 1.01 * truth_m).astype(np.float32))
    steps = scale.reliability(maps, truth_m, CAMERA)
    assert [step["confidence"] for step in steps] == pytest.approx(0.2 + 0.05 * np.arange(7))
    assert sum(step["num_compared"] for step in steps) == confidence.size
    for step in steps:
        noise = 4 * np.sqrt(step["expected"] / step["num_compared"])
        assert abs(step["outliers"] - step["expected"]) < noise
    shares = scale.expected_outliers(maps)
    assert shares["filled"] == pytest.approx(bad.mean(), rel=0.03)
    every_second = scale.outlier_probability(confidence[:, ::2])
    assert shares["measured"] == pytest.approx(every_second.mean())


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


def test_a_single_sweep_expects_what_no_other_sweep_contradicts():
    """The factor is between those of six recordings; rejected pixels are less certain too."""
    maps = with_rejected(np.random.default_rng(9))
    alone = scale.without_confirmation(maps)
    for before, after in ((maps, alone), (maps.rejected, alone.rejected)):
        before, after = before.confidence, after.confidence
        more = scale.outlier_probability(after) / scale.outlier_probability(before)
        assert ((before > 0) == (after > 0)).all()
        assert more[before > 0.2].min() > 0.9 and more.max() < 6.0
        assert more[before > 0.2].mean() > 2.0


def with_rejected(rng) -> DepthMap:
    """A map of 70 % of the pixels, half of them measured, and rejected pixels elsewhere."""
    shown = rng.random(SHAPE) < 0.7
    confidence = rng.uniform(0.2, 0.9, SHAPE).astype(np.float32)
    maps = made(np.where(shown, confidence, np.float32(0)), np.where(shown, 10, 0))
    maps = replace(maps, frame=np.where(maps.depth_m > 0, 3, -1).astype(np.int32))
    lower, measured = np.float32(0.5) * confidence * ~shown, rng.random(SHAPE) < 0.5
    frame = np.where(~shown & measured, 4, -1).astype(np.int32)
    return replace(maps, rejected=Rejected(np.where(shown, 0, 20), lower, frame))


def test_the_dial_leaves_out_or_gives_back_until_the_share_is_expected():
    maps = with_rejected(np.random.default_rng(8))
    rules = scale.with_max_outliers(maps, None)
    assert rules.rejected is None
    for name in ("depth_m", "filled_m", "confidence", "frame"):
        np.testing.assert_array_equal(getattr(rules, name), getattr(maps, name))
    own = scale.expected_outliers(maps)["filled"]
    before = np.zeros(SHAPE, bool)
    for share in (own / 10, own / 2, 1.5 * own, 2 * own, 1.0):
        dialled = scale.with_max_outliers(maps, share)
        shown, measured = dialled.filled_m > 0, dialled.depth_m > 0
        expected = scale.expected_outliers(dialled)["filled"]
        assert expected <= share and (share == 1.0 or expected > 0.95 * share)
        assert (shown | before == shown).all() and shown.sum() > before.sum()
        assert ((dialled.confidence > 0) == shown).all()
        assert ((dialled.frame >= 0) == measured).all()
        least = dialled.confidence[shown & ~before].min()
        assert maps.confidence[(maps.filled_m > 0) & ~shown].max(initial=0) <= least
        before = shown
    assert before.all()
    assert scale.expected_outliers(scale.with_max_outliers(maps, own))["filled"] <= own
