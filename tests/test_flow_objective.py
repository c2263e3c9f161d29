# SPDX-License-Identifier: MIT
"""The flow objective against slow twins, and its solvers: known motions, descent, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.config import ObjectiveSettings
from densify.config.errors import InputError
from densify.flow import graph, objective
from densify.flow.energy import energy
from densify.flow.objective import solve


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


@pytest.mark.parametrize(
    ("message", "rows"),
    [
        (r"flow: got shape \(9, 3\)", (9, 10, 12)),
        (r"laplacian: got shape", (9, 9, 12)),
        ("target: got no points", (10, 10, 0)),
    ],
)
def test_bad_input_is_one_clear_line(message: str, rows: tuple[int, int, int]) -> None:
    *clouds, matrix = problem(10, 12)
    with pytest.raises(InputError, match=message) as raised:
        energy(*(x[:num] for x, num in zip(clouds, rows, strict=True)), matrix, alpha=1.0)
    assert "\n" not in str(raised.value)


def test_bad_graphs_are_refused() -> None:
    with pytest.raises(InputError, match="num_neighbors: got 0"):
        graph.knn_graph(cloud(5), 0)


# --- solvers --------------------------------------------------------------------------------------

PCG, ADAM = ObjectiveSettings(), ObjectiveSettings(solver="adam")


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objective, "_ADAM_STEPS", 30)


def box(
    num_points: int, seed: int, size_m: tuple[float, float, float] = (4.0, 2.0, 1.5)
) -> np.ndarray:
    """Points on the faces of a box centred at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, size=(num_points, 3))
    face = rng.integers(0, 3, num_points)
    points[np.arange(num_points), face] = np.sign(points[np.arange(num_points), face]) * 0.5
    return points * size_m


def street(seed: int, num_points: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Two walls that stand and two boxes that move, each sampled anew in the second cloud."""
    rng = np.random.default_rng(seed)

    def sample(moved: float) -> np.ndarray:
        walls = rng.uniform([-10, 0, 0], [10, 0, 3], size=(num_points, 3))
        walls[::2, 1] = 12.0
        first = box(num_points // 2, int(rng.integers(1 << 30))) + [-5 + 0.8 * moved, 3, 1]
        second = box(num_points // 2, int(rng.integers(1 << 30))) + [5, 8 - 0.5 * moved, 1]
        return np.concatenate([walls, first, second])

    return sample(0.0), sample(1.0)


@pytest.mark.parametrize("solver", [PCG, ADAM])
def test_identical_clouds_do_not_move_at_all(solver: ObjectiveSettings) -> None:
    points = box(500, 0) + [400.0, -3e3, 7.0]
    solution = solve(points, points[::-1], solver)
    assert not solution.flow.any()
    assert solution.energy == solution.data == solution.smoothness == 0.0


@pytest.mark.parametrize("shift", [(0.4, 0.0, 0.0), (0.9, -0.5, 0.2), (30.0, -10.0, 5.0)])
def test_a_translated_body_is_followed(shift: tuple[float, ...]) -> None:
    source = box(800, 1)
    solution = solve(source, source + shift)
    # A constant flow costs a little smoothness: the symmetric Laplacian's null space is another.
    error_m = np.linalg.norm(solution.flow.mean(axis=0) - shift)
    assert error_m < 0.02 * np.linalg.norm(shift)


def test_pcg_and_adam_reach_the_same_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objective, "_ADAM_STEPS", 250)
    source, target = street(4, 500)
    pcg, adam = (solve(source, target, settings) for settings in (PCG, ADAM))
    assert abs(pcg.energy - adam.energy) < 0.02 * adam.energy
    assert pcg.energy < 0.5 * pcg.energies[0]
    for solution in (pcg, adam):
        assert solution.energy == min(solution.energies)
        assert solution.flow.shape == source.shape and solution.flow.dtype == np.float64
        weights = graph.knn_graph(source, PCG.num_neighbors)
        clouds = (torch.from_numpy(x) for x in (solution.flow, source, target))
        value = energy(*clouds, graph.laplacian(weights), PCG.alpha)
        reported = (solution.energy, solution.data, solution.smoothness)
        np.testing.assert_allclose(reported, value, rtol=1e-9)


def test_pcg_never_rises_from_a_given_flow() -> None:
    source, target = street(5, 500)
    energies = np.array(solve(source, target, initial=np.zeros_like(source)).energies)
    assert len(energies) > 5
    assert (np.diff(energies) <= 1e-12 * energies[:-1]).all()


def test_continuation_finds_a_lower_minimum_than_starting_at_the_final_alpha() -> None:
    source, target = box(800, 6), box(800, 7) + [2.0, 0.5, 0.0]
    stiff_first = solve(source, target)
    assert stiff_first.energy < 0.95 * solve(source, target, initial=0 * source).energy


@pytest.mark.parametrize("solver", [PCG, ADAM])
def test_an_initial_flow_is_where_it_starts(solver: ObjectiveSettings) -> None:
    source, target = street(7, 200)
    cold = solve(source, target, solver)
    warm = solve(source, target, solver, initial=cold.flow)
    np.testing.assert_allclose(warm.energies[0], cold.energy, rtol=1e-12)
    assert warm.energy <= cold.energy
    if solver.solver == "pcg":
        assert len(warm.energies) < len(cold.energies) / 2


@pytest.mark.parametrize("solver", [PCG, ADAM])
def test_same_input_gives_the_same_bytes(solver: ObjectiveSettings) -> None:
    source, target = street(8, 200)
    first, second = (solve(source, target, solver) for _ in range(2))
    assert first.flow.tobytes() == second.flow.tobytes()
    assert first.energies == second.energies


def test_map_coordinates_lose_nothing() -> None:
    source, target = street(10, 400)
    origin = np.array([2.0**19, 2.0**22, 64.0])
    source, target = ((x * 2.0**20).round() / 2.0**20 for x in (source, target))
    near = solve(source, target)
    far = solve(source + origin, target + origin)
    np.testing.assert_allclose(far.energy, near.energy, rtol=1e-6)


@pytest.mark.parametrize("solver", [PCG, ADAM])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 40), (40, 1)])
def test_any_sizes(n: int, m: int, solver: ObjectiveSettings) -> None:
    solution = solve(box(n, 0), box(m, 1) + [1.0, 0, 0], solver)
    assert np.isfinite(solution.flow).all()
    assert solution.energy <= solution.energies[0]


def test_one_point_moves_to_the_mean_of_what_pulls_it() -> None:
    # One forward match and two backward ones: E = |x - a|² + |x - a|² + |x - b|².
    solution = solve([[0.0, 0, 0]], [[3.0, 0, 0], [6.0, 0, 0]])
    np.testing.assert_allclose(solution.flow, [[4.0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(solution.energy, 1 + 1 + 4)


def test_alpha_zero_leaves_the_points_free() -> None:
    source, target = street(11, 300)
    free = solve(source, target, ObjectiveSettings(alpha=0.0))
    assert free.data < solve(source, target, ObjectiveSettings(alpha=1.0)).data
