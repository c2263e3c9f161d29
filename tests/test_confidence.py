# SPDX-License-Identifier: MIT
"""Confidence as a probability: the scale, the order, and whether a map keeps what it promises."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.depth.layers import Layers
from densify.files.texts import read_json
from densify.types import DepthMap, Ranked
from tests.scenes import CAMERA

GROUPS = (
    "window, rough from 0, contradicted from 0",
    "window, rough from 0.1, contradicted from 0.03",
    "filled, rough from 0.1, contradicted from 0",
)


def made(confidence, filled_m) -> DepthMap:
    shape = confidence.shape
    measured_m = np.where(np.arange(shape[1]) % 2 == 0, filled_m, 0).astype(np.float32)
    frame = np.zeros(shape, np.int32)
    return DepthMap("front", measured_m, filled_m, confidence, frame)


def test_a_fifth_more_is_ten_times_less_wrong():
    assert scale.wrong(np.array([0, 0.2, 0.4, 1.0])) == pytest.approx([1, 0.1, 0.01, 1e-5])


SMOOTH, FENCE, FILLED = (scale.GROUPS.index(name) for name in GROUPS)
"""Of these groups; the tables of a test say what each is worth."""


def tables(**worth) -> np.ndarray:
    """(G,R) log10 P, which falls by a decade over the ranks; worth: at rank 0, by group."""
    log = np.full((len(scale.GROUPS), scale.NUM_RANKS), -1.0)
    for name, value in worth.items():
        log[scale.GROUPS.index(name)] = value
    return log - np.linspace(0, 1, scale.NUM_RANKS)


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
    """Rough places cost a map as much confidence as there are of them, and empty pixels nothing."""
    rng = np.random.default_rng(4)
    worth = tables(**{GROUPS[0]: -3.0, GROUPS[1]: -1.0, GROUPS[2]: -2.0})
    rank = rng.uniform(size=(200, 300)).astype(np.float32)
    for share in (0.0, 0.2, 0.9):
        rough, filled = rng.uniform(size=(2, *rank.shape)) < [[[share]], [[0.5]]]
        group = np.where(filled, FILLED, np.where(rough, FENCE, SMOOTH)).astype(np.uint8)
        shown = rng.uniform(size=rank.shape) < 0.6
        confidence = scale.calibrated(Ranked(rank, group), shown, worth)
        assert (confidence[~shown] == 0).all()
        step = np.minimum((rank * scale.NUM_RANKS).astype(int), scale.NUM_RANKS - 1)
        for part in (shown & filled, shown & ~filled):
            expected = 10.0 ** worth[group[part], step[part]].astype(float)
            assert scale.wrong(confidence[part]).mean() == pytest.approx(expected.mean(), rel=0.03)


def test_groups_are_how_a_pixel_came_and_how_ragged_and_contradicted_it_is_around():
    shape = (60, 120)
    none, everywhere = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    left = np.arange(shape[1]) < 60
    rim_m = np.where(left & (np.arange(shape[1]) % 2 == 0), everywhere, none)
    depth_m = everywhere.copy()
    depth_m[30:] = 0
    layers = Layers(
        depth_m=depth_m,
        rim_m=rim_m,
        veiled=none > 0,
        refused=none > 0,
        filled_m=everywhere,
        confidence=everywhere / 2,
        point=np.zeros(shape, np.int32),
        tilt=np.zeros((*shape, 2), np.float32),
        spacing_px=np.ones((*shape, 2), np.float32),
    )
    far = np.zeros(shape, bool)
    far[:10] = True
    contradicted = np.where(np.arange(shape[1]) < 100, none, np.float32(0.05))
    rank, group = scale.ranked(layers, far, contradicted)
    assert (rank == 0.5).all()
    names = np.array(scale.GROUPS)[group]
    for row, how in ((5, "beyond"), (20, "window"), (45, "filled")):
        ragged = 0.5 if how == "filled" else 0.1
        assert names[row, 11] == f"{how}, rough from {ragged}, contradicted from 0"
        assert names[row, 90] == f"{how}, rough from 0, contradicted from 0"
        assert names[row, 110] == f"{how}, rough from 0, contradicted from 0.03"


def test_only_what_is_shown_tells_how_contradicted_it_is_around():
    shape = (20, 20)
    none = np.zeros(shape, np.float32)
    shown = np.arange(shape[1]) % 2 == 0
    filled_m = np.where(shown, np.ones(shape, np.float32), none)
    layers = Layers(
        *(none, none, none > 0, none > 0, filled_m, none + 1, np.full(shape, -1, np.int32)),
        tilt=np.zeros((*shape, 2), np.float32),
        spacing_px=np.ones((*shape, 2), np.float32),
    )
    contradicted = np.where(shown, np.full(shape, 0.015, np.float32), np.float32(1))
    group = scale.ranked(layers, none > 0, contradicted).group
    assert scale.GROUPS[group[10, 10]] == "filled, rough from 0, contradicted from 0.01"


def test_the_packages_own_tables_fall_with_the_rank():
    own = scale.tables_of(read_json(scale.TABLES))
    assert own.shape == (len(scale.GROUPS), scale.NUM_RANKS)
    assert (np.diff(own) <= 1e-9).all() and own.max() <= 0 and own.min() >= -scale.DECADES
    smooth, ragged = (own[k::12].mean() for k in (0, 11))
    assert ragged > smooth + 0.5


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
