# SPDX-License-Identifier: MIT
"""The solvers of the flow objective: known motions, agreement, descent, determinism, bad input."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from densify.config.errors import InputError
from densify.flow import graph
from densify.flow.energy import energy
from densify.flow.objective import SolverSettings, solve

ADAM = SolverSettings(solver="adam", adam_num_steps=30)


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


def reported_equals_recomputed(source, target, settings, solution) -> None:
    weights = graph.knn_graph(source, settings.num_neighbors)
    clouds = (torch.from_numpy(x) for x in (solution.flow, source, target))
    value = energy(*clouds, graph.laplacian(weights), settings.alpha)
    reported = (solution.energy, solution.data, solution.smoothness)
    np.testing.assert_allclose(reported, value, rtol=1e-9)


@pytest.mark.parametrize("settings", [SolverSettings(), ADAM])
def test_identical_clouds_do_not_move_at_all(settings: SolverSettings) -> None:
    points = box(500, 0) + [400.0, -3e3, 7.0]
    solution = solve(points, points[::-1], settings)
    assert not solution.flow.any()
    assert solution.energy == solution.data == solution.smoothness == 0.0


@pytest.mark.parametrize("shift", [(0.4, 0.0, 0.0), (0.9, -0.5, 0.2), (30.0, -10.0, 5.0)])
def test_a_translated_body_is_followed(shift: tuple[float, ...]) -> None:
    source = box(800, 1)
    solution = solve(source, source + shift)
    # A constant flow costs a little smoothness: the symmetric Laplacian's null space is another.
    error_m = np.linalg.norm(solution.flow.mean(axis=0) - shift)
    assert error_m < 0.02 * np.linalg.norm(shift)


def test_pcg_and_adam_reach_the_same_minimum() -> None:
    source, target = street(4, 500)
    common = SolverSettings(adam_num_steps=250)
    pcg = solve(source, target, common)
    adam = solve(source, target, dataclasses.replace(common, solver="adam"))
    assert abs(pcg.energy - adam.energy) < 0.02 * adam.energy
    assert pcg.energy < 0.5 * pcg.energies[0]
    for solution in (pcg, adam):
        assert solution.energy == min(solution.energies)
        assert solution.flow.shape == source.shape and solution.flow.dtype == np.float64
        reported_equals_recomputed(source, target, common, solution)


def test_pcg_never_rises_from_a_given_flow() -> None:
    source, target = street(5, 500)
    energies = np.array(solve(source, target, initial=np.zeros_like(source)).energies)
    assert len(energies) > 5
    assert (np.diff(energies) <= 1e-12 * energies[:-1]).all()


def test_continuation_finds_a_lower_minimum_than_starting_at_the_final_alpha() -> None:
    source, target = box(800, 6), box(800, 7) + [2.0, 0.5, 0.0]
    stiff_first = solve(source, target)
    assert stiff_first.energy < 0.95 * solve(source, target, initial=0 * source).energy


@pytest.mark.parametrize("settings", [SolverSettings(), ADAM])
def test_an_initial_flow_is_where_it_starts(settings: SolverSettings) -> None:
    source, target = street(7, 200)
    cold = solve(source, target, settings)
    warm = solve(source, target, settings, initial=cold.flow)
    np.testing.assert_allclose(warm.energies[0], cold.energy, rtol=1e-12)
    assert warm.energy <= cold.energy
    if settings.solver == "pcg":
        assert len(warm.energies) < len(cold.energies) / 2


@pytest.mark.parametrize("settings", [SolverSettings(), ADAM])
def test_same_input_gives_the_same_bytes(settings: SolverSettings) -> None:
    source, target = street(8, 200)
    first, second = (solve(source, target, settings) for _ in range(2))
    assert first.flow.tobytes() == second.flow.tobytes()
    assert first.energies == second.energies


def test_map_coordinates_lose_nothing() -> None:
    source, target = street(10, 400)
    origin = np.array([2.0**19, 2.0**22, 64.0])
    source, target = ((x * 2.0**20).round() / 2.0**20 for x in (source, target))
    near = solve(source, target)
    far = solve(source + origin, target + origin)
    np.testing.assert_allclose(far.energy, near.energy, rtol=1e-6)


@pytest.mark.parametrize("solver", ["pcg", "adam"])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 40), (40, 1)])
def test_any_sizes(n: int, m: int, solver: str) -> None:
    settings = SolverSettings(solver=solver, adam_num_steps=20)
    solution = solve(box(n, 0), box(m, 1) + [1.0, 0, 0], settings)
    assert np.isfinite(solution.flow).all()
    assert solution.energy <= solution.energies[0]


def test_one_point_moves_to_the_mean_of_what_pulls_it() -> None:
    # One forward match and two backward ones: E = |x - a|² + |x - a|² + |x - b|².
    solution = solve([[0.0, 0, 0]], [[3.0, 0, 0], [6.0, 0, 0]], SolverSettings())
    np.testing.assert_allclose(solution.flow, [[4.0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(solution.energy, 1 + 1 + 4)


def test_alpha_zero_leaves_the_points_free() -> None:
    source, target = street(11, 300)
    free = solve(source, target, SolverSettings(alpha=0.0))
    assert free.data < solve(source, target, SolverSettings(alpha=1.0)).data


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("source: got no points", ([], [[0.0, 0, 0]])),
        ("target: got no points", (np.zeros((5, 3)), np.zeros((0, 3)))),
        ("target: 1 of 2 rows are NaN", (np.zeros((5, 3)), [[0, 0, 0], [0, np.nan, 0]])),
        ("source: 1 of 1 rows are NaN or infinite", ([[np.inf, 0, 0]], [[0.0, 0, 0]])),
        ("source: got shape (5, 4)", (np.zeros((5, 4)), [[0.0, 0, 0]])),
        ("source: expected (n,3) numbers", ([["a", "b", "c"]], [[0.0, 0, 0]])),
        ("initial: got shape (4, 3)", (np.zeros((5, 3)), np.zeros((5, 3)), None, np.zeros((4, 3)))),
    ],
)
def test_bad_clouds_are_refused(message: str, arguments: tuple) -> None:
    with pytest.raises(InputError) as raised:
        solve(*arguments)
    assert message in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("solver", "newton"),
        ("alpha", -1.0),
        ("alpha", np.nan),
        ("num_neighbors", 0),
        ("adam_num_steps", 0),
    ],
)
def test_bad_settings_are_refused(name: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"^{name}: got .*expected"):
        SolverSettings(**{name: value})
