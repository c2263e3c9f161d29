# SPDX-License-Identifier: MIT
"""Groups of points linked by distance, against single linkage as its definition says it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from densify.geometry.nearest import close_to_seeds, link

DISTANCE_M = 0.6


def numbered(label: np.ndarray) -> np.ndarray:
    """The same groups, numbered by their first points."""
    _, first, group = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[group.ravel()]


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    thin = rng.uniform(-6, 6, (400, 3)) * [1, 1, 0.1]
    clumps = rng.normal(0, 0.1, (60, 20, 3)) + rng.uniform(-4, 4, (60, 1, 3))
    line = np.outer(np.arange(50) * 0.59, [0.6, 0.0, 0.8])
    return [thin, clumps.reshape(-1, 3), line, line * 1.05]


@pytest.mark.parametrize("points", clouds(), ids=["thin", "clumps", "linked line", "loose line"])
def test_single_linkage(points: np.ndarray) -> None:
    num, label = link(points, DISTANCE_M)
    expected = fcluster(linkage(points, "single"), DISTANCE_M, "distance")
    np.testing.assert_array_equal(label, numbered(expected))
    assert num == label.max() + 1 and label.dtype == np.int64


@pytest.mark.parametrize("seed", range(2))
def test_close_to_seeds_as_counted_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (1500, 3)) * [3, 1, 0.3]
    seeds = (points[:, 0] > 0) & (rng.random(1500) < 0.6) | (rng.random(1500) < 0.02)
    distance_m = cdist(points, points)
    within = distance_m <= 0.4
    counts = seeds & (within[:, seeds].sum(axis=1) >= 0.3 * within.sum(axis=1))
    expected = (distance_m[:, counts] < 0.4).any(axis=1)
    assert 0 < counts.sum() < seeds.sum() and 0 < expected.sum() < len(points)
    np.testing.assert_array_equal(close_to_seeds(points, seeds, 0.4, 0.3), expected)


def test_no_points_and_no_seeds() -> None:
    num, label = link(np.empty((0, 3)), DISTANCE_M)
    assert num == 0 and label.shape == (0,)
    points = np.zeros((5, 3))
    assert not close_to_seeds(points, np.zeros(5, bool), 0.4, 0.3).any()
    assert not close_to_seeds(points[:0], np.zeros(0, bool), 0.4, 0.3).any()
