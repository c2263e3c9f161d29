# SPDX-License-Identifier: MIT
"""The flow objective against slow twins: neighbours, graph, Laplacian, energy, gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.config.errors import InputError
from densify.flow import graph
from densify.flow.energy import energy


def cloud(num_points: int, seed: int = 0, spread_m: float = 2.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=spread_m, size=(num_points, 3))


def slow_weights(points: np.ndarray, k: int) -> np.ndarray:
    n = len(points)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    weights = np.eye(n)
    for i in range(n):
        others = sorted((j for j in range(n) if j != i), key=lambda j: distance[i, j])
        for j in others[:k]:
            weights[i, j] = weights[j, i] = np.exp(-(distance[i, j] ** 2))
    return weights


def slow_laplacian(weights: np.ndarray) -> np.ndarray:
    degree = np.diag(weights.sum(axis=1))
    half = np.diag(np.diag(degree) ** -0.5)
    return half @ (degree - weights) @ half


def slow_energy(
    flow: np.ndarray, source: np.ndarray, target: np.ndarray, matrix: np.ndarray, alpha: float
) -> tuple[float, float, float]:
    data = sum(min(float(((p - q) ** 2).sum()) for q in target) for p in source + flow)
    data += sum(min(float(((p - q) ** 2).sum()) for p in source + flow) for q in target)
    smoothness = float(np.trace(flow.T @ matrix @ flow))
    return data + alpha * smoothness, data, smoothness


def problem(n: int, m: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> tuple[Any, ...]:
    source, target = cloud(n, seed), cloud(m, seed + 1)
    flow = cloud(n, seed + 2, 0.3)
    matrix = graph.laplacian(graph.knn_graph(source, 5))
    return (
        *(torch.from_numpy(x).to(dtype) for x in (flow, source, target)),
        matrix,
    )


@pytest.mark.parametrize(("n", "m"), [(40, 60), (60, 25), (1, 7), (7, 1)])
def test_energy_equals_its_slow_twin(n: int, m: int) -> None:
    flow, source, target, matrix = problem(n, m)
    dense = slow_laplacian(slow_weights(source.numpy(), min(5, n - 1)))
    expected = slow_energy(flow.numpy(), source.numpy(), target.numpy(), dense, 10.0)
    np.testing.assert_allclose(energy(flow, source, target, matrix, 10.0), expected, rtol=1e-12)


def test_float32_agrees_with_float64() -> None:
    single = energy(*problem(80, 90, torch.float32), alpha=10.0)
    double = energy(*problem(80, 90, torch.float64), alpha=10.0)
    assert single.total.dtype == torch.float32
    np.testing.assert_allclose(single, double, rtol=1e-5)


def test_gradient_equals_finite_differences() -> None:
    flow, source, target, matrix = problem(30, 45)
    flow.requires_grad_()
    for term in range(3):
        assert torch.autograd.gradcheck(
            lambda f, term=term: energy(f, source, target, matrix, 3.0)[term], flow, eps=1e-6
        )


def test_as_a_training_loss_it_reaches_the_parameters_of_a_network() -> None:
    _, source, _, matrix = problem(50, 50, torch.float32)
    shift = torch.tensor([0.05, -0.02, 0.03])
    parameter = torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.SGD([parameter], lr=2e-3)
    for _ in range(100):  # without smoothness, which costs a constant flow a little
        optimizer.zero_grad()
        energy(parameter.expand(50, 3), source, source + shift, matrix, 0.0).total.backward()
        optimizer.step()
    np.testing.assert_allclose(parameter.detach(), shift, atol=1e-4)


@given(n=st.integers(1, 40), k=st.integers(1, 60), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_knn_graph_equals_its_slow_twin(n: int, k: int, seed: int) -> None:
    points = cloud(n, seed)
    np.testing.assert_allclose(graph.knn_graph(points, k).toarray(), slow_weights(points, k))


def test_graph_of_duplicates_keeps_every_self_weight() -> None:
    points = np.concatenate([np.zeros((30, 3)), cloud(10), np.full((5, 3), 60.0)])
    weights = graph.knn_graph(points, 4)
    dense = weights.toarray()
    np.testing.assert_array_equal(np.diag(dense), 1.0)
    np.testing.assert_array_equal(dense, dense.T)
    assert ((dense[:30, :30] > 0).sum(axis=1) >= 5).all()
    np.testing.assert_allclose(
        graph.laplacian(weights).toarray(), slow_laplacian(dense), atol=1e-15
    )


@given(n=st.integers(1, 50), k=st.integers(1, 12), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_laplacian_is_symmetric_positive_and_leaves_its_null_space_alone(
    n: int, k: int, seed: int
) -> None:
    weights = graph.knn_graph(cloud(n, seed), k)
    matrix = graph.laplacian(weights).toarray()
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    np.testing.assert_allclose(matrix, slow_laplacian(weights.toarray()), atol=1e-14)
    values = np.linalg.eigvalsh(matrix)
    assert values.min() > -1e-13 and values.max() < 2.0
    np.testing.assert_allclose(matrix @ np.sqrt(weights.sum(axis=1)), 0.0, atol=1e-13)


def test_bad_input_is_one_clear_line() -> None:
    flow, source, target, matrix = problem(10, 12)
    broken = target.clone()
    broken[3, 1] = torch.nan
    cases = {
        "flow: got shape (9, 3)": (flow[:9], source, target, matrix),
        "laplacian: got shape": (flow[:9], source[:9], target, matrix),
        "target: got no points": (flow, source, target[:0], matrix),
        "source: got no points": (flow[:0], source[:0], target, matrix[:0, :0]),
        "target: 1 of 12 rows are NaN or infinite, the first is row 3": (
            flow,
            source,
            broken,
            matrix,
        ),
        "target: got shape (12, 2)": (flow, source, target[:, :2], matrix),
    }
    for message, arguments in cases.items():
        with pytest.raises(InputError) as raised:
            energy(*arguments, alpha=1.0)
        assert message in str(raised.value) and "\n" not in str(raised.value)


def test_bad_graphs_are_refused() -> None:
    points = cloud(5)
    with pytest.raises(InputError, match="num_neighbors: got 0"):
        graph.knn_graph(points, 0)
