# SPDX-License-Identifier: MIT
"""How far a moving object reaches: along its sides, not into its neighbours, with the ground."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.tracking.candidates import Strips
from densify.flow.tracking.extent import find_shape
from densify.flow.tracking.objects import Observation, Track
from densify.geometry.clock import Clock
from tests.found_motion import KEY, NOISE, Found
from tests.scenes import Arc, Box, Scene, World, car, street

EXTRA = len(street())  # number of the first box that a test adds
PARKED_M = (4.2, 1.8, 1.4)


def marked(found: Found, box: int) -> np.ndarray:
    """Which of the box's returns, of all sweeps, move."""
    return np.concatenate([f.moving[s.box == box] for _, s, f in found.near_key(4)])


def test_a_parked_car_in_line_stays():
    """As wide and as high as the one that leaves, and at first so close behind it."""
    rear, y, speed_m_s = 14.0, 2.2, 4.0
    leaving = car(rear + 0.5 * PARKED_M[0] - 0.1 * speed_m_s, y, speed_m_s, 1, size_m=PARKED_M)
    parked = Box(PARKED_M, Arc(rear - 0.4 - 0.5 * PARKED_M[0], y), 0.15)
    found = Found.of([leaving], extra=[parked])
    still = marked(found, EXTRA)
    assert len(still) > 10_000 and not still.any()
    assert found.share_moving(1, 4) > 0.85
    assert np.quantile(found.errors_m(1, 4), 0.9) < 0.05


def test_a_wall_that_somebody_walks_along_stays():
    """It goes on from him without a hole and nothing is ever seen through it, but it is still there
    where he has been."""
    wall = Box((16.0, 0.2, 1.9), Arc(12.0, 3.42))
    found = Found.of([car(9, 3.0, 1.6, 1, size_m=(0.8, 0.6, 1.75))], extra=[wall])
    still = marked(found, EXTRA)
    assert found.share_moving(1, 4) > 0.9
    assert len(still) > 20_000 and still.mean() < 0.04  # an arm's length of it


def test_the_wall_behind_a_walker_is_no_part_of_the_shape():
    """Every sweep claims 2.6 m of the wall along with the walker."""
    body = np.random.default_rng(0).uniform((-0.2, -0.2, 0), (0.2, 0.2, 1.7), (120, 3))
    x, z = np.meshgrid(np.arange(-3, 6, 0.1), np.arange(0, 2.4, 0.1))
    wall = np.stack([x.ravel(), np.full(x.size, 0.6), z.ravel()], 1)
    track, obstacles, clock = Track(np.zeros(3)), [], Clock(np.arange(9) * 100_000_000)
    for i in range(9):
        state = np.array([0.12 * i, 0.0, 0.0, 0.0])
        points = np.concatenate([body + state[:3], wall])
        beside = np.abs(wall[:, 0] - state[0]) < 1.3
        track.observations[i] = Observation(state, 0.1 * i, i * 100_000_000, (i,))
        track.claimed[i] = np.flatnonzero(np.append(np.ones(120, bool), beside))
        seed, time_s = np.arange(len(points)) < 120, np.full(len(points), 0.1 * i)
        sweep = SimpleNamespace(points=points, time_s=time_s, seed=seed, strips=Strips(points))
        obstacles.append(sweep)
    track.smooth()
    space = SimpleNamespace(gap_m=lambda *_: 0.05, clock=clock)
    shape = find_shape(track, obstacles, space)
    assert len(shape.points) > 0.9 * 9 * 120 and shape.points[:, 1].max() < 0.3


@pytest.fixture(scope="module")
def hill() -> Found:
    """One car drives ahead, one comes towards."""
    movers = car(12, -1.6, 10, 1), car(25, 1.6, 14, 2, yaw=np.pi)
    world = World((*street(), *movers), -0.08)
    return Found.around(KEY, Scene(world, Arc(0, -1.5, 0, 6.0), NOISE), 4)


def test_what_moves_rises_and_falls_with_the_ground(hill):
    for frame, target in [(1, 9), (8, 1), (4, 6)]:
        flow, true = hill.motion.flow(frame, target), hill.scene.displacement(frame, target)
        for instance in (1, 2):
            on = (hill.scene.scan(frame).instance == instance) & flow.moving
            assert np.abs(true[on, 2]).min() > 0.09
            np.testing.assert_allclose(flow.displacement[on, 2], true[on, 2], atol=0.015)


def test_an_object_is_one_object_on_a_hill(hill):
    """Downhill its roof is hit by rings more than a metre apart, each of which, followed alone,
    would stay behind."""
    assert len(hill.motion.tracks) == 2
    for instance in (1, 2):
        assert hill.share_moving(instance, 4) > 0.9
        assert np.quantile(hill.errors_m(instance, 4), 0.99) < 0.02
