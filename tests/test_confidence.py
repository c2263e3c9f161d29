# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.depth import project as stage
from densify.geometry.types import DepthMap, Ranked
from densify.scores.depth_metrics import is_outlier_depth
from tests.depth_layers import layers_of
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


def tables(anywhere: float, contradicted: float) -> np.ndarray:
    """(G,2,R) shares at rank 0, which fall by a decade over the ranks."""
    falling = 10.0 ** -np.linspace(0, 1, scale.NUM_RANKS)
    return np.array([[anywhere * falling, contradicted * falling]] * len(scale.GROUPS))


@pytest.mark.parametrize("groups", [(SMOOTH,), (SMOOTH, FENCE), (FILLED,)])
def test_calibration_keeps_the_order(groups):
    """Of pixels measured, and of pixels filled, wherever they are."""
    rng = np.random.default_rng(3)
    rank = np.linspace(0, 1, 4000, dtype=np.float32).reshape(40, 100)
    contradicted = rng.uniform(0, 0.3, rank.shape).astype(np.float32)
    ranked = Ranked(rank, rng.choice(groups, rank.shape).astype(np.uint8), contradicted)
    confidence = scale.calibrated(ranked, np.ones(rank.shape, bool))
    assert confidence.dtype == np.float32
    assert (np.diff(confidence.ravel()) > 0).all()
    assert confidence.min() >= 0 and confidence.max() <= 1


def test_a_map_expects_what_its_own_pixels_are_worth():
    """Hedges cost a map as much confidence as there are of them, and empty pixels nothing."""
    rng = np.random.default_rng(4)
    worth = tables(0.001, 0.5)
    rank = rng.uniform(size=(200, 300)).astype(np.float32)
    for share in (0.0, 0.2, 0.9):
        hedge, filled = rng.uniform(size=(2, *rank.shape)) < [[[share]], [[0.5]]]
        group = np.where(filled, FILLED, SMOOTH).astype(np.uint8)
        contradicted = np.where(hedge, np.float32(0.2), np.float32(0))
        shown = rng.uniform(size=rank.shape) < 0.6
        confidence = scale.calibrated(Ranked(rank, group, contradicted), shown, worth)
        assert (confidence[~shown] == 0).all()
        step = np.minimum((rank * scale.NUM_RANKS).astype(int), scale.NUM_RANKS - 1)
        for part in (shown & filled, shown & ~filled):
            anywhere, more = worth[group[part], :, step[part]].T
            expected = anywhere + contradicted[part] * more
            assert scale.wrong(confidence[part]).mean() == pytest.approx(expected.mean(), rel=0.03)


def test_the_packages_own_tables_fall_with_the_rank():
    own = scale.tables_of(scale.own_file())
    assert own.shape == (len(scale.GROUPS), len(scale.CAUSES), scale.NUM_RANKS)
    assert (np.diff(own) <= 1e-9).all() and own.min() >= 0
    smooth, ragged = (own[k::3].mean(axis=(0, 2)) for k in (0, 2))
    assert ragged[0] > 3 * smooth[0] and 0.05 < own[:, 1].mean() < 3


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


FOCAL_PX, GAP_PX, WALL_M = 700.0, 3.0, 12.0
SHAPE = (40, 60)
SPOT = (20, 30)


def wall():
    return np.full(SHAPE, WALL_M, np.float32)


def gapped(filled_m, measured_m=None, **more):
    """measured_m: (H,W), all that is filled if None."""
    layers = layers_of(filled_m, spacing_px=(GAP_PX, GAP_PX), confidence=1.0, **more)
    return layers if measured_m is None else replace(layers, depth_m=measured_m)


@pytest.mark.parametrize(("there_m", "wrong"), [(WALL_M / 2, True), (0.96 * WALL_M, False)])
def test_a_pixel_is_contradicted_by_surfaces_that_would_make_it_wrong(there_m, wrong):
    depth_m = wall()
    depth_m[SPOT] = there_m
    share = scale.contradicted(gapped(depth_m), FOCAL_PX)
    assert share[SPOT] == (pytest.approx(48 / 50) if wrong else 0)
    assert share[SPOT[0], SPOT[1] + 3] == (pytest.approx(1 / 50) if wrong else 0)
    assert share[SPOT[0], SPOT[1] + 4] == 0


def test_surfaces_go_on_with_their_slope():
    """A road that recedes contradicts nothing."""
    slope = 0.004
    inverse = 1 / WALL_M + slope * (np.arange(SHAPE[0]) - SPOT[0])[:, None]
    depth_m = np.broadcast_to(1 / np.clip(inverse, 0.02, None), SHAPE).astype(np.float32).copy()
    flat = gapped(depth_m)
    tilt = np.zeros((*SHAPE, 2), np.float32)
    tilt[..., 1] = slope
    sloped = replace(flat, tilt=tilt)
    inside = (slice(SPOT[0] - 5, SPOT[0] + 5), slice(10, 50))
    assert scale.contradicted(flat, FOCAL_PX)[inside].min() > 0.2
    assert not scale.contradicted(sloped, FOCAL_PX)[inside].any()


def test_what_most_around_contradicts_is_left_out():
    depth_m = wall()
    depth_m[SPOT] = WALL_M / 2  # one pixel alone
    depth_m[:, 10:14] = WALL_M / 2  # a post
    before = gapped(depth_m)
    made = before.without(scale.contradicted(before, FOCAL_PX) > stage._MOST_CONTRADICTED)
    lost = made.filled_m == 0
    assert np.array_equal(np.argwhere(lost), [SPOT])
    assert made.depth_m[SPOT] == made.confidence[SPOT] == 0
    assert made.rim_m[SPOT] == depth_m[SPOT]


def test_what_is_behind_a_closed_window_does_not_contradict_it():
    depth_m = wall()
    filled_m, window = depth_m.copy(), np.zeros(SHAPE, bool)
    window[SPOT[0] - 4 : SPOT[0] + 5, 20:40] = True
    filled_m[window] = WALL_M / 2
    open_ = gapped(filled_m, depth_m)
    share = scale.contradicted(open_, FOCAL_PX)
    assert share[window].min() > 0.7
    closed = replace(open_, solid=window)
    of_closed = scale.contradicted(closed, FOCAL_PX)
    assert not of_closed[window].any()
    assert np.array_equal(of_closed[~window], share[~window])
    assert not open_.without(share > stage._MOST_CONTRADICTED).filled_m[window].any()
    kept = closed.without(of_closed > stage._MOST_CONTRADICTED)
    assert np.array_equal(kept.filled_m[window], filled_m[window])
