# SPDX-License-Identifier: MIT
"""Motion segmentation's scores: by hand, against a twin of plain loops, and bad input."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.scores.segmentation import SegmentationScorer


def scored(estimated, true, least_points: int = 1) -> dict:
    scorer = SegmentationScorer(least_points)
    scorer.add(np.asarray(estimated), np.asarray(true))
    return scorer.scores()


def test_what_is_right_is_1_whatever_its_numbers() -> None:
    found = scored([7, 7, -1, 3, 3, -1], [0, 0, -1, 90_000_000, 90_000_000, -1])
    assert found["moving_iou"] == found["panoptic_quality"] == found["recognition"] == 1
    assert (found["num_found"], found["num_missed"], found["num_false"]) == (2, 0, 0)


def test_sweeps_add_up_and_nothing_is_none() -> None:
    scorer = SegmentationScorer(1)
    assert scorer.scores()["moving_iou"] is None
    scorer.add(np.full(5, -1), np.full(5, -1))
    assert scorer.scores()["panoptic_quality"] is None
    scorer.add(np.zeros(0, int), np.zeros(0, int))
    scorer.add(np.array([0, 0]), np.array([0, 0]))
    scorer.add(np.array([-1, -1]), np.array([0, 0]))
    assert scorer.scores()["moving_iou"] == pytest.approx(1 / 2)
    assert scorer.scores()["panoptic_quality"] == pytest.approx(1 / (1 + 1 / 2))


@pytest.mark.parametrize("seed", range(20))
def test_a_twin_of_plain_loops_agrees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = np.repeat(rng.integers(-1, 8, 40), 5)
    estimated = np.where(rng.random(200) < 0.25, rng.integers(-1, 9, 200), (true + 3) % 9 - 1)
    sets = [
        [set(np.flatnonzero(labels == k)) for k in set(labels.tolist()) - {-1}]
        for labels in (estimated, true)
    ]
    pairs = [(a, b) for a in sets[0] for b in sets[1] if len(a & b) / len(a | b) > 0.5]
    ious = [len(a & b) / len(a | b) for a, b in pairs if len(b) >= 6]
    false = sum(len(a) >= 6 and all(a is not p for p, _ in pairs) for a in sets[0])
    missed = sum(len(b) >= 6 and all(b is not q for _, q in pairs) for b in sets[1])
    found = scored(estimated, true, least_points=6)
    assert (found["num_found"], found["num_missed"], found["num_false"]) == (
        len(ious),
        missed,
        false,
    )
    quality = sum(ious) / (len(ious) + (missed + false) / 2)
    assert found["panoptic_quality"] == pytest.approx(quality)


@pytest.mark.parametrize(
    "estimated, true, told",
    [
        ([0, 1], [0], "got 2 estimated and 1 true labels"),
        ([0.5], [0], r"estimated: got float64 of shape \(1,\)"),
        ([0], [[0]], r"true: got int64 of shape \(1, 1\)"),
        ([True], [0], "estimated: got bool"),
    ],
    ids=str,
)
def test_other_labels_are_refused(estimated, true, told: str) -> None:
    with pytest.raises(InputError, match=told):
        scored(estimated, true)
