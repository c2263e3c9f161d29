# SPDX-License-Identifier: MIT
"""The shape of an object: its outline and how far it reaches."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.surface_matching import apply
from densify.flow.tracking.shapes import Body, Shape
from densify.flow.tracking.sightings import Sighting, Track


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


def two_sides(length_m: float, width_m: float, yaw_rad: float) -> np.ndarray:
    """(N,3) an upright rectangle seen from one corner, with 2 cm of noise: as many points on the
    short side as on the long one."""
    rng = np.random.default_rng(3)
    along = np.stack([rng.uniform(0, length_m, 300), np.zeros(300), rng.uniform(0, 2, 300)], 1)
    across = np.stack([np.zeros(300), rng.uniform(0, width_m, 300), rng.uniform(0, 2, 300)], 1)
    points = np.concatenate([along, across]) + rng.normal(0, 0.02, (600, 3))
    return apply(np.array([5.0, -3.0, 0.0, yaw_rad]), points, np.zeros(3))


@pytest.mark.parametrize("yaw_deg", [0, 7, 31, 44, 60, 89, 135, 200])
@pytest.mark.parametrize("size_m", [(6.0, 2.5), (13.0, 2.5), (4.5, 1.8), (6.0, 0.01)])
def test_sides_are_found_however_the_object_stands(yaw_deg: float, size_m: tuple) -> None:
    shape = Shape.of(two_sides(*size_m, np.deg2rad(yaw_deg)))
    off_deg = (np.rad2deg(shape.side_rad) - yaw_deg + 45) % 90 - 45
    assert abs(off_deg) <= 0.75


@pytest.mark.parametrize(
    ("length_m", "aside_deg", "pointing_deg"), [(6.0, 25, 40), (6.0, -30, 40), (2.4, 25, 65)]
)
def test_what_is_long_points_along_its_side_and_what_is_not_where_it_goes(
    length_m: float, aside_deg: float, pointing_deg: float
) -> None:
    """It stands turned by 40 degrees and goes aside of that; at 45 it would be its other side."""
    shape = Shape.of(two_sides(length_m, 1.0, np.deg2rad(40)))
    way = np.deg2rad(40 + aside_deg)
    track = Track(np.zeros(3))
    for i in range(5):
        state = np.array([0.5 * i * np.cos(way), 0.5 * i * np.sin(way), 0.0, 0.0])
        track.sightings[i] = Sighting(state, 0.1 * i, i * 100_000_000, (i,))
        track.claimed[i] = np.arange(8)
    track.smooth()
    x, y = Body(track, shape).pointing(0.2)
    assert np.hypot(x, y) == pytest.approx(1)
    assert np.rad2deg(np.arctan2(y, x)) == pytest.approx(pointing_deg, abs=1)


def test_a_turned_object_points_where_it_has_turned_to() -> None:
    shape = Shape.of(two_sides(6.0, 1.0, 0.0))
    track = Track(np.zeros(3))
    for i in range(5):
        state = np.array([0.5 * i, 0.0, 0.0, 0.1 * i])
        track.sightings[i] = Sighting(state, 0.1 * i, i * 100_000_000, (i,))
        track.claimed[i] = np.arange(8)
    track.smooth()
    for at_s in (0.0, 0.2, 0.4):
        x, y = Body(track, shape).pointing(at_s)
        assert np.arctan2(y, x) == pytest.approx(at_s, abs=0.02)
