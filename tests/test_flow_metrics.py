# SPDX-License-Identifier: MIT
"""Flow metrics against numbers worked out by hand, slow twins, and the challenge's own package."""

from __future__ import annotations

import math

import numpy as np
import pytest

from densify.readers.flow_files import CATEGORIES
from densify.scores import metrics
from densify.scores.metrics import CLASSES, IGNORED, challenge_scores

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

CLASS_OF = np.array([0, *(IGNORED if c is None else CLASSES.index(c) for c in CATEGORIES.values())])


def frames() -> list[np.ndarray]:
    """Points, estimated and true flow, and classes of three pairs. The legacy generator gives the
    same numbers in every version of numpy. float32, as the files'."""
    rng = np.random.RandomState(7)
    pairs = []
    for num in (900, 1300, 700):
        points = rng.uniform(-60, 60, (num, 3))
        kind = np.where(rng.uniform(size=num) < 0.4, 0, rng.randint(0, len(NAMES), num))
        true = rng.normal(size=(num, 3)) * rng.uniform(0, 1.2, (num, 1)) ** 2
        true[(kind == 0) | (rng.uniform(size=num) < 0.3)] = 0.0
        small = rng.uniform(size=num) < 0.1
        true[small & (kind > 0)] *= 0.02
        estimated = true + rng.normal(size=(num, 3)) * 0.1 * rng.uniform(size=(num, 1))
        estimated[rng.uniform(size=num) < 0.2] = 0.0
        pairs.append(
            (points, estimated.astype(np.float32), true.astype(np.float32), CLASS_OF[kind])
        )
    return [np.concatenate(column) for column in zip(*pairs, strict=True)]


def test_the_numbers_of_the_challenges_own_package():
    """`BucketedEPEEvaluator` and `ThreeWayEPEEvaluator` of bucketed-scene-flow-eval 2.0.25, with
    its `BUCKETED_METACATAGORIES` and `THREEWAY_EPE_METACATAGORIES`, on the same arrays."""
    scores = challenge_scores(*frames())
    expected = {**BUCKETED, "MEAN": tuple(np.nanmean(list(BUCKETED.values()), axis=0))}
    assert set(scores["bucketed"]) == set(expected)
    for name, numbers in expected.items():
        errors = tuple(scores["bucketed"][name].values())
        assert errors == pytest.approx(numbers, rel=1e-6, nan_ok=True), name
    three_way = tuple(scores["three_way"].values())
    assert three_way == pytest.approx((*THREE_WAY, sum(THREE_WAY) / 3), rel=1e-6)


def test_end_point_error_by_hand():
    flow, true = np.array([[3.0, 4, 0], [1, 1, 1], [0, 0, 2]]), np.array([[0.0, 0, 0]] * 3)
    assert metrics.end_point_errors(flow, true).tolist() == pytest.approx([5, math.sqrt(3), 2])
    mask = np.array([True, False, True])
    assert metrics.end_point_error(flow, true, mask) == pytest.approx(3.5)
    assert metrics.end_point_error(flow, true) == pytest.approx((7 + math.sqrt(3)) / 3)


def test_accuracy_as_a_loop():
    rng = np.random.default_rng(5)
    true = rng.normal(0, 1.0, (500, 3)) * rng.uniform(0, 1.5, (500, 1))
    true[::3] = 0.0  # a third stands still
    flow = true + rng.normal(0, 0.1, true.shape) * rng.integers(0, 2, (500, 1))
    for limit in (metrics.STRICT, metrics.RELAXED):
        good = 0
        for f, t in zip(flow, true, strict=True):
            off = math.dist(f, t)
            good += off < limit or (math.hypot(*t) > 0 and off / math.hypot(*t) < limit)
        assert metrics.accuracy(flow, true, limit) == pytest.approx(good / len(flow))


def test_angles_by_hand():
    flow = np.array([[1.0, 1, 0], [0, 0, 0], [-2, 0, 0], [5, 5, 5]])
    true = np.array([[1.0, 0, 0], [0, 3, 0], [1, 0, 0], [0, 0, 0]])
    # 45 degrees, nothing where something was, the wrong way, and no direction to compare with
    expected = (math.pi / 4 + math.pi / 2 + math.pi) / 3
    assert metrics.angle_error_rad(flow, true) == pytest.approx(expected)


def test_nothing_gives_nan():
    none, one, nothing = np.zeros((1, 3)), np.ones((1, 3)), np.zeros((0, 3))
    beyond = challenge_scores(np.array([[35.0, 0, 0]]), none, one, np.array([1]))
    assert beyond["num_points"] == 0 and list(beyond["bucketed"]) == ["MEAN"]
    values = [
        metrics.end_point_error(nothing, nothing),
        metrics.end_point_error(one, one, np.array([False])),
        metrics.accuracy(nothing, nothing, metrics.STRICT),
        metrics.angle_error_rad(one, none),
        *beyond["three_way"].values(),
        *beyond["bucketed"]["MEAN"].values(),
    ]
    assert all(map(math.isnan, values)), values
