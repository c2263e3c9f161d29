# SPDX-License-Identifier: MIT
"""Rigid motions by the group's laws and by their series; times of sweeps; groups of close points by
their definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.linalg import expm
from scipy.spatial.distance import cdist

from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import close_to_seeds, link
from densify.geometry.twists import move_with_twists

small = st.floats(-1e-6, 1e-6)
any_size = st.floats(-1.7, 1.7)  # a rotation vector of at most 1.7 · sqrt(3) < pi
metres = st.floats(-200, 200)
twists = st.tuples(
    st.one_of(st.tuples(small, small, small), st.tuples(any_size, any_size, any_size)),
    st.tuples(metres, metres, metres),
).map(lambda parts: np.array([*parts[0], *parts[1]]))


@given(twists)
def test_inverse(twist):
    T = poses.exp(twist)
    np.testing.assert_allclose(T @ poses.inverse(T), np.eye(4), atol=1e-10)


@given(twists)
def test_log_undoes_exp(twist):
    # at a millionth of a radian as well: no division by the vanishing angle
    np.testing.assert_allclose(poses.log(poses.exp(twist)), twist, rtol=1e-9, atol=1e-12)


@given(twists)
def test_rotation_is_the_matrix_exponential(twist):
    x, y, z = twist[:3]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(poses.exp(twist)[:3, :3], expm(skew), atol=1e-12)


@given(twists, twists, st.lists(st.floats(-1, 1), min_size=1, max_size=8), st.integers(0, 1000))
def test_move_with_twists_is_exp_of_every_point(before, after, seconds, seed):
    points = np.random.default_rng(seed).normal(size=(len(seconds), 3)) * 50
    one_by_one = [
        poses.transform(poses.exp(s * (before if s < 0 else after)), p[None])[0]
        for s, p in zip(seconds, points, strict=True)
    ]
    moved = move_with_twists(points, np.array(seconds), before, after)
    np.testing.assert_allclose(moved, one_by_one, atol=1e-9)


@given(twists, twists)
def test_interpolate_meets_both_ends_and_goes_evenly(a, b):
    A, B = poses.exp(a), poses.exp(a) @ poses.exp(b)
    np.testing.assert_allclose(poses.interpolate(A, B, 0.0), A, atol=1e-9)
    np.testing.assert_allclose(poses.interpolate(A, B, 1.0), B, atol=1e-9)
    third = poses.inverse(A) @ poses.interpolate(A, B, 1 / 3)
    np.testing.assert_allclose(poses.log(third), b / 3, atol=1e-8)


@pytest.mark.parametrize("n", [0, 1, 8192, 20_001])
def test_many_points_are_carried_as_each_by_itself(n):
    T, points = poses.exp(np.array([0.3, -0.2, 1.0, 5, -3, 2])), np.arange(3.0 * n).reshape(n, 3)
    one_by_one = np.array([T[:3, :3] @ p for p in points]).reshape(n, 3)
    np.testing.assert_allclose(poses.rotate(T, points), one_by_one, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(
        poses.transform(T, points), one_by_one + T[:3, 3], rtol=1e-12, atol=1e-9
    )


def test_holes_and_jitter():
    """At 0, 100, 201, 298, then none for three periods, 598, 700 ms."""
    clock = Clock(np.array([0, 100, 201, 298, 598, 700]) * 1_000_000)
    assert clock.period_ns == 101_000_000
    assert clock.near(2, 3, 0.1) and not clock.near(3, 4, 0.2) and clock.near(3, 4, 0.3)
    assert [clock.at(3, s) for s in (-0.2, -0.1, 0.1, 0.2, 0.4)] == [1, 2, 4, 4, 5]
    assert clock.at(5, 0.1) is None and clock.at(0, -0.1) is None
    assert clock.nearest(3, [0, 4, 5]) == 0 and clock.nearest(4, [2, 3, 5]) == 5
    assert clock.from_end_s(3) == pytest.approx(0.298) and clock.from_end_s(4) == 0.102
    assert clock.time_s[4] == pytest.approx(0.598)


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
