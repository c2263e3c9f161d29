# SPDX-License-Identifier: MIT
"""The shape of an object: its outline and how far it reaches."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.surface_matching import apply
from densify.flow.tracking.shapes import Shape


def test_the_outline_is_that_of_all_points_seen_from_above() -> None:
    """A triangle, 5 cm beyond its sides allowed."""
    corners = np.array([[0.0, 0, 0], [4, 0, 1], [0, 3, 9]])
    rng = np.random.default_rng(0)
    within = rng.dirichlet(np.ones(3), 500) @ corners
    shape = Shape.of(np.concatenate([corners, within]))
    asked = rng.uniform(-1, 5, (3000, 3)) * [1, 1, 50]
    x, y, _ = asked.T
    beyond = np.max([-x, -y, (3 * x + 4 * y - 12) / 5], axis=0)
    np.testing.assert_array_equal(shape.within_outline(asked), beyond < 0.05)


@pytest.mark.parametrize("num_points", [1, 2, 30])
def test_what_has_no_outline_holds_nothing(num_points: int) -> None:
    line = np.linspace(0, 1, num_points)[:, None] * [1.0, 2.0, 3.0]
    shape = Shape.of(line)
    assert not shape.within_outline(line).any()
    np.testing.assert_array_equal(shape.rim, line)


@pytest.mark.parametrize("yaw", np.linspace(0, 3, 7))
def test_the_rim_reaches_as_far_as_all_points_however_turned(yaw: float) -> None:
    points = np.random.default_rng(1).normal(size=(4000, 3)) * [4, 1, 0.7]
    shape = Shape.of(points)
    assert len(shape.rim) < 60
    state, centre = np.array([30.0, -4.0, 0.5, yaw]), np.array([1.0, 2.0, 3.0])
    all_there, rim = apply(state, points, centre), apply(state, shape.rim, centre)
    np.testing.assert_array_equal(rim.min(0), all_there.min(0))
    np.testing.assert_array_equal(rim.max(0), all_there.max(0))
