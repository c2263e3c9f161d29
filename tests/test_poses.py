# SPDX-License-Identifier: MIT
"""Rigid motions: the group's laws, and the exponential against its series."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from densify.geometry import poses
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
