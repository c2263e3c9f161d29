# SPDX-License-Identifier: MIT
"""Compiled kernels against slow twins, and the same bytes with any number of threads."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from densify.flow import graph
from densify.flow.solvers import _conjugate_gradients
from densify.kernels import sparse, threads
from densify.kernels.nearest import BoxTree


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


@given(n=st.integers(1, 40), k=st.integers(1, 12), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_symmetric_union_equals_its_slow_twin(n: int, k: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    k = min(k, n)
    listed = np.array(
        [[i, *rng.permutation(np.delete(np.arange(n), i))[: k - 1]] for i in range(n)]
    )
    listed[rng.random(listed.shape) < 0.2] = -1
    weight = rng.uniform(size=(n, n))
    weight += weight.T
    expected = np.zeros((n, n))
    for i in range(n):
        for j in listed[i][listed[i] >= 0]:
            expected[i, j] = expected[j, i] = weight[i, j]
    made = sparse.symmetric_union(listed, weight[np.arange(n)[:, None], listed])
    dense = np.zeros((n, n))
    for i in range(n):
        columns = made.columns[made.starts[i] : made.starts[i + 1]]
        assert (np.diff(columns) > 0).all()
        dense[i, columns] = made.values[made.starts[i] : made.starts[i + 1]]
    np.testing.assert_array_equal(dense, expected)


def chain(num_points: int) -> sparse.Rows:
    """The Laplacian of points on a string."""
    starts, columns, values = [0], [], []
    for i in range(num_points):
        linked = [j for j in (i - 1, i, i + 1) if 0 <= j < num_points]
        columns += linked
        values += [len(linked) - 1.0 if j == i else -1.0 for j in linked]
        starts.append(len(columns))
    return sparse.Rows(np.array(starts, np.int32), np.array(columns, np.int32), np.array(values))


def as_tensor(matrix: sparse.Rows) -> torch.Tensor:
    n = len(matrix.starts) - 1
    columns = (matrix.values, matrix.columns, matrix.starts)
    whole = csr_array(columns, shape=(n, n))
    return graph.sparse_tensor(whole, torch.from_numpy(matrix.values).dtype, "cpu")


@pytest.mark.parametrize("alpha", [0.0, 10.0, 1000.0])
def test_conjugate_gradients_solve_the_system_and_agree_with_their_twin(alpha: float) -> None:
    matrix, n = chain(5000), 5000
    rng = np.random.default_rng(3)
    data, rhs = rng.integers(1, 4, n).astype(float), rng.normal(size=(n, 3))
    rhs[:, 2] = 0.0
    degree = np.diff(matrix.starts) - 1.0
    preconditioner = 1.0 / (data + alpha * degree)
    exact = sparse.conjugate_gradients(matrix, alpha, data, preconditioner, rhs, 1e-12, 3000)
    image = data[:, None] * exact + alpha * sparse.product(matrix, exact)
    np.testing.assert_allclose(image, rhs, atol=1e-8)
    assert not exact[:, 2].any()
    rough = sparse.conjugate_gradients(matrix, alpha, data, preconditioner, rhs, 0.2, 20)
    twin = _conjugate_gradients(
        as_tensor(matrix),
        alpha,
        *(torch.from_numpy(x) for x in (data[:, None], preconditioner[:, None], rhs)),
    )
    np.testing.assert_allclose(rough, twin, atol=1e-10)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_product_equals_torch(dtype: type) -> None:
    matrix = chain(6000)
    matrix = matrix._replace(values=matrix.values.astype(dtype))
    x = cloud(6000, 4).astype(dtype)
    out = sparse.product(matrix, x)
    assert out.dtype == dtype
    np.testing.assert_allclose(out, as_tensor(matrix) @ torch.from_numpy(x), atol=1e-4)


def test_parts_cover_every_item_once_and_errors_come_through(monkeypatch) -> None:
    for cores in (1, 2, 7):
        monkeypatch.setattr(threads, "num_threads", lambda cores=cores: cores)
        for n in (0, 1, 5000, 20001):
            seen = np.zeros(n, int)

            def visit(begin: int, end: int, seen: np.ndarray = seen) -> None:
                seen[begin:end] += 1

            threads.in_parallel(visit, n)
            assert (seen == 1).all()

    def fail(begin: int, end: int) -> None:
        if begin:
            raise ValueError("here")

    with pytest.raises(ValueError, match="here"):
        threads.in_parallel(fail, 20001)


SOLVE = """
import hashlib, sys
import numpy as np, torch
from densify.kernels import threads
cores = int(sys.argv[1])
threads.num_threads = lambda: cores
torch.set_num_threads(cores)
from densify.flow.solvers import ObjectiveSettings, solve
rng = np.random.default_rng(0)
source = rng.uniform(0, 20, (12000, 3)) * [1, 1, 0.1]
target = rng.uniform(0, 20, (12500, 3)) * [1, 1, 0.1] + [0.3, 0, 0]
for solver in ("pcg", "adam"):
    settings = ObjectiveSettings(solver=solver, num_neighbors=4, adam_num_steps=2)
    found = solve(source, target, settings)
    print(hashlib.sha256(found.flow.tobytes() + repr(found.energies).encode()).hexdigest())
"""


def test_the_number_of_threads_leaves_no_trace() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    digests = {
        subprocess.run(
            [sys.executable, "-c", SOLVE, str(cores)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        ).stdout
        for cores in (1, 3)
    }
    assert len(digests) == 1
