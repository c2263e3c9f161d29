# SPDX-License-Identifier: MIT
"""Nearest neighbours by a tree of boxes, against all distances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.geometry.nearest import BoxTree


def cloud(num_points: int, seed: int, far_m: float = 0.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=3.0, size=(num_points, 3)) + far_m


def slow_distances(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.sqrt(((queries[:, None] - points[None]) ** 2).sum(axis=2))


@given(
    n=st.integers(1, 300),
    q=st.integers(0, 60),
    k=st.integers(1, 60),
    far_m=st.sampled_from([0, 4e6]),
)
@settings(max_examples=60, deadline=None)
def test_the_tree_finds_what_all_distances_find(n: int, q: int, k: int, far_m: float) -> None:
    points, queries = cloud(n, n, far_m), cloud(q, q + 1, far_m)
    distance = slow_distances(queries, points)
    nearest_m, row = BoxTree(points).nearest(queries)
    np.testing.assert_array_equal(nearest_m, distance.min(axis=1))
    np.testing.assert_array_equal(distance[np.arange(q), row], nearest_m)
    k = min(k, n)
    nearest_m, rows = BoxTree(points).nearest_k(queries, k)
    np.testing.assert_array_equal(nearest_m, np.sort(distance, axis=1)[:, :k])
    np.testing.assert_array_equal(np.take_along_axis(distance, rows, axis=1), nearest_m)
    assert all(len(set(row)) == k for row in rows)


@pytest.mark.parametrize("scale_m", [0.05, 50.0])
def test_a_moved_tree_is_as_exact(scale_m: float) -> None:
    points, queries = cloud(3000, 0), cloud(500, 1)
    tree = BoxTree(points)
    moved = points + np.random.default_rng(2).normal(scale=scale_m, size=points.shape)
    tree.move(moved)
    distance = slow_distances(queries, moved)
    np.testing.assert_array_equal(tree.nearest(queries)[1], distance.argmin(axis=1))
    order = np.argsort(distance, axis=1)[:, :7]
    np.testing.assert_array_equal(tree.nearest_k(queries, 7)[1], order)


def test_duplicates_and_flat_clouds_are_found() -> None:
    points = np.concatenate([np.zeros((400, 3)), np.ones((3, 3))])
    nearest_m, rows = BoxTree(points).nearest_k(points, 20)
    assert (nearest_m[:400] == 0).all() and (rows >= 0).all()
    assert all(len(set(row)) == 20 for row in rows)
    line = np.zeros((500, 3))
    line[:, 1] = np.arange(500)
    np.testing.assert_array_equal(BoxTree(line).nearest(line)[1], np.arange(500))


@pytest.mark.parametrize("within_m", [0.0, 0.3, 1.0, 50.0])
def test_nothing_is_found_beyond_the_limit(within_m: float) -> None:
    points, queries = cloud(700, 5), cloud(300, 6)
    distance = slow_distances(queries, points)
    near = distance.min(axis=1) < within_m
    nearest_m, row = BoxTree(points).nearest(queries, within_m)
    np.testing.assert_array_equal(nearest_m, np.where(near, distance.min(axis=1), np.inf))
    np.testing.assert_array_equal(row, np.where(near, distance.argmin(axis=1), -1))
