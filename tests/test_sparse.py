# SPDX-License-Identifier: MIT
"""Sparse matrices: made, multiplied and solved, against dense and torch twins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from densify.flow.objective import graph, sparse
from densify.flow.objective.solvers import _conjugate_gradients


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
    x = np.random.default_rng(4).normal(scale=3.0, size=(6000, 3)).astype(dtype)
    out = sparse.product(matrix, x)
    assert out.dtype == dtype
    np.testing.assert_allclose(out, as_tensor(matrix) @ torch.from_numpy(x), atol=1e-4)
