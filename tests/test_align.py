# SPDX-License-Identifier: MIT
"""Alignment with an object's shape: against known motion, and against a slow twin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from densify.flow.surface_matching import GATES_M, MIN_FIT, Model, apply, undo

CENTRE = np.array([12.0, -3.0, 0.8])
STD = np.array([0.3, 0.3, 0.06])


def corner(num_points: int, seed: int) -> np.ndarray:
    """Two sides of a car, as seen from one place."""
    rng = np.random.default_rng(seed)
    along, up = rng.uniform([-2, 0], [2, 1.4], (num_points, 2)).T
    side = np.arange(num_points) % 3 > 0
    x, y = np.where(side, along, -2.0), np.where(side, -0.9, along * 0.45)
    return CENTRE + np.stack([x, y, up], 1) + rng.normal(0, 0.01, (num_points, 3))


def slow_information(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(N,3,3) as the formulas say, with an inverse of numpy."""
    x = points[near] - points[near].mean(1, keepdims=True)
    covariance = 10 * np.einsum("nki,nkj->nij", x, x) / near.shape[1]
    mean_variance = np.trace(covariance, axis1=1, axis2=2)[:, None, None] / 3
    return np.linalg.inv(covariance + (0.05**2 + 0.02 * mean_variance) * np.eye(3))


def slow_align(model: Model, points, predicted) -> np.ndarray | None:
    """Gauss-Newton with numerical derivatives, neighbours from another tree."""
    tree = cKDTree(model.points)
    _, near = tree.query(model.points, min(12, len(model.points)))
    information = slow_information(model.points, near.reshape(len(model.points), -1))
    state, points = predicted.copy(), points[:: max(1, len(points) // 250)]
    for gate_m in GATES_M:
        at_model = undo(state, points, CENTRE)
        distance, row = tree.query(at_model, distance_upper_bound=gate_m)
        near = np.isfinite(distance)
        if near.sum() < MIN_FIT:
            return None
        weight = (1 - (distance[near] / gate_m) ** 2) ** 2 * min(1, 60 / near.sum())
        A = information[row[near]] * weight[:, None, None]
        r = at_model[near] - model.points[row[near]]
        J = np.zeros((near.sum(), 3, 3))
        for k, axis in enumerate((0, 1, 3)):
            h = np.zeros(4)
            h[axis] = 1e-6
            ahead, behind = (undo(state + s * h, points[near], CENTRE) for s in (1, -1))
            J[:, :, k] = (ahead - behind) / 2e-6
        H = np.einsum("nik,nij,njl->kl", J, A, J) + np.diag(1 / STD**2)
        g = np.einsum("nik,nij,nj->k", J, A, r) - (predicted - state)[[0, 1, 3]] / STD**2
        state[[0, 1, 3]] -= np.linalg.solve(H, g)
    return state


@pytest.mark.parametrize("num_points", [MIN_FIT - 1, MIN_FIT, 40, 600])
@pytest.mark.parametrize("num_in_model", [8, 900, 2500])
@pytest.mark.parametrize("flat", [False, True])
def test_the_alignment_is_its_slow_twin(flat: bool, num_in_model: int, num_points: int) -> None:
    rng = np.random.default_rng(0)
    shape = corner(num_in_model, 0)
    model = Model(np.where(np.arange(3) == 1, CENTRE, shape) if flat else shape)
    true = np.array([*rng.normal(0, 0.5, 2), rng.normal(0, 0.1), rng.normal(0, 0.3)])
    points = apply(true, corner(num_points, 50), CENTRE)
    predicted = true + [*rng.normal(0, 0.2, 2), 0.0, rng.normal(0, 0.04)]
    found, expected = (
        model.align(points, CENTRE, predicted, STD),
        slow_align(model, points, predicted),
    )
    assert (found is None) == (expected is None) and (num_points >= MIN_FIT or found is None)
    if found is not None:
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert found[2] == predicted[2]


def test_the_prediction_holds_what_the_points_leave_open() -> None:
    """A single flat side may slide along itself: it stays where it is expected."""
    rng = np.random.default_rng(3)
    wall = CENTRE + np.column_stack([rng.uniform(-9, 9, 800), np.zeros(800), np.zeros(800)])
    seen = CENTRE + np.column_stack([rng.uniform(-1, 1, 80), np.zeros(80), np.zeros(80)])
    predicted = np.array([0.3, 0.2, 0.0, 0.0])
    found = Model(wall).align(seen, CENTRE, predicted, np.array([0.01, 0.3, 0.06]))
    assert abs(found[0] - 0.3) < 0.02 and abs(found[1]) < 0.02
