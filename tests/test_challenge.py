# SPDX-License-Identifier: MIT
"""The challenge's scores: against the numbers of its own packages, and slow twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from densify.readers.flow_files import CATEGORIES
from densify.scores.challenge import CLASSES, IGNORED, ChallengeScorer

NAMES = ("NONE", *CATEGORIES)
BUCKETED = {
    "BACKGROUND": (0.06863006888603677, math.nan),
    "CAR": (0.07095842394563887, 0.22422062776973084),
    "OTHER_VEHICLES": (0.05423443861208953, 0.42148736759483413),
    "PEDESTRIAN": (0.05028076342454082, 0.27415212933020605),
    "WHEELED_VRU": (0.054204363692551855, 0.31231146158957823),
}
THREE_WAY = (0.23507497759129833, 0.053893685746032975, 0.06863006888603677)
"""What bucketed-scene-flow-eval 2.0.25 says of `frames`: static and dynamic by class; dynamic and
static foreground, static background."""

CLASS_OF = [0, *(IGNORED if c is None else CLASSES.index(c) for c in CATEGORIES.values())]


def frames() -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Three pairs: points, estimated and true flow, and the place of each category in `NAMES`. The
    legacy generator gives the same numbers in every version of numpy. float32, as the files'."""
    rng = np.random.RandomState(7)
    found = []
    for num in (900, 1300, 700):
        points = rng.uniform(-60, 60, (num, 3))
        kind = np.where(rng.uniform(size=num) < 0.4, 0, rng.randint(0, len(NAMES), num))
        true = rng.normal(size=(num, 3)) * rng.uniform(0, 1.2, (num, 1)) ** 2
        true[(kind == 0) | (rng.uniform(size=num) < 0.3)] = 0.0
        small = rng.uniform(size=num) < 0.1
        true[small & (kind > 0)] *= 0.02
        estimated = true + rng.normal(size=(num, 3)) * 0.1 * rng.uniform(size=(num, 1))
        estimated[rng.uniform(size=num) < 0.2] = 0.0
        found.append(
            (points, estimated.astype(np.float32), true.astype(np.float32), kind.astype(int))
        )
    return found


def scored(within_m: float = 35.0) -> ChallengeScorer:
    scorer = ChallengeScorer(within_m)
    for points, estimated, true, kind in frames():
        scorer.add(points, estimated, true, np.array(CLASS_OF)[kind])
    return scorer


def test_the_numbers_of_the_challenges_own_package():
    """`BucketedEPEEvaluator` and `ThreeWayEPEEvaluator` of bucketed-scene-flow-eval 2.0.25, with
    its `BUCKETED_METACATAGORIES` and `THREEWAY_EPE_METACATAGORIES`, on the same arrays."""
    scores = scored().scores()
    assert set(scores.by_class) == set(BUCKETED)
    for name, numbers in BUCKETED.items():
        assert scores.by_class[name] == pytest.approx(numbers, rel=1e-6, nan_ok=True), name
    assert scores.mean == pytest.approx(np.nanmean(list(BUCKETED.values()), axis=0), rel=1e-6)
    assert scores.three_way[:3] == pytest.approx(THREE_WAY, rel=1e-6)
    assert scores.three_way.mean_m == pytest.approx(sum(THREE_WAY) / 3, rel=1e-6)


def test_nothing_scored_is_nan():
    scores = ChallengeScorer().scores()
    assert scores.num_points == 0 and not scores.by_class
    assert all(math.isnan(value) for value in (*scores.three_way, *scores.mean))
    only_far = ChallengeScorer()
    only_far.add(np.array([[35.0, 0, 0]]), np.zeros((1, 3)), np.ones((1, 3)), np.array([1]))
    assert only_far.scores().num_points == 0
