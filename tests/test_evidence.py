# SPDX-License-Identifier: MIT
"""Which points are suspected to move: those that some other sweep saw through."""

from __future__ import annotations

import numpy as np
import pytest

from densify import poses
from densify.config import FlowSettings
from densify.flow.evidence import Candidates, FreeSpace, find_candidates, link
from densify.types import Stretch
from tests.scenes import SWEEP_S, Arc, Scanner, Scene, World, car, street

MIN_HEIGHT_M = FlowSettings().min_height_m
KEY, FAST = 5, 2


@pytest.fixture(scope="module")
def scene() -> Scene:
    movers = car(14, -1.6, 10, 1), car(8, 1.6, 30, FAST)
    return Scene(World((*street(), *movers)), Arc(0, -1.5, 0, 6.0), Scanner(sigma_m=0.01))


@pytest.fixture(scope="module")
def stretch(scene) -> Stretch:
    return scene.stretch(KEY, 4)


@pytest.fixture(scope="module")
def heights_m(scene, stretch) -> list[np.ndarray]:
    return [scene.height_m(f) for f in stretch.frames]


@pytest.fixture(scope="module")
def space(stretch) -> FreeSpace:
    return FreeSpace.of(stretch)


@pytest.fixture(scope="module")
def evidence(stretch, space, heights_m) -> tuple[Candidates, ...]:
    return find_candidates(stretch, space, heights_m, MIN_HEIGHT_M)


def test_candidates_are_where_and_when_their_rows_say(stretch, evidence):
    for i, (registered, c) in enumerate(zip(stretch.sweeps, evidence, strict=True)):
        placed = poses.transform(registered.T_world_lidar, registered.sweep.points[c.row])
        np.testing.assert_allclose(c.points, placed)
        fired_s = i * SWEEP_S + registered.sweep.offset_ns[c.row] * 1e-9
        np.testing.assert_allclose(c.time_s, fired_s, atol=1e-9)
        assert len(c.row) == len(np.unique(c.row)) == len(c.seed) == len(c.cluster)
        assert set(np.unique(c.cluster)) == set(range(c.num_clusters))


def test_candidates_are_few_and_above_the_ground(heights_m, evidence):
    for height_m, c in zip(heights_m, evidence, strict=True):
        assert (height_m[c.row] >= MIN_HEIGHT_M).all()
        assert 0 < len(c.row) < 0.1 * len(height_m)


def test_movers_are_seen_through_and_walls_are_not(scene, stretch, space):
    i, j = stretch.frames.index(KEY), stretch.frames.index(KEY + 4)
    scan, registered = scene.scan(KEY), stretch[KEY]
    points = poses.transform(registered.T_world_lidar, registered.sweep.points)
    free = space.seen_through(points, j)
    assert free[scan.instance == FAST].mean() > 0.5
    still = (scan.instance < 0) & (scan.box >= 0)
    assert free[still].mean() < 1e-3
    assert not space.seen_through(points, i).any()


def test_a_higher_limit_of_height_lets_less_in(stretch, space, heights_m):
    few = find_candidates(stretch, space, heights_m, 1.0)
    for height_m, c in zip(heights_m, few, strict=True):
        assert (height_m[c.row] >= 1.0).all()


def test_links_of_voxels():
    gap = [[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.3, 0, 0]]
    number, label = link(np.array(gap), 0.6)
    assert number == 2
    assert label[0] == label[1] == label[2] != label[3] == label[4]


def test_links_against_a_slow_twin():
    points = np.random.default_rng(3).uniform(-6, 6, (300, 3)) * [1, 1, 0.1]
    number, label = link(points, 0.6)
    assert set(label) == set(range(number)) and label.dtype == np.int64
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)

    def groups(reach):
        group = np.arange(len(points))
        for _ in range(len(points)):
            grown = np.array([group[row].min() for row in distance <= reach])
            if np.array_equal(grown, group):
                break
            group = grown
        return group

    # what is certainly close shares a label, what is certainly apart does not
    inner, outer = groups(0.6 - 0.3 * np.sqrt(3)), groups(0.6 + 0.3 * np.sqrt(3))
    for a, b in np.random.default_rng(0).integers(0, len(points), (3000, 2)):
        assert label[a] == label[b] or inner[a] != inner[b]
        assert label[a] != label[b] or outer[a] == outer[b]


def test_links_of_nothing():
    number, label = link(np.empty((0, 3)), 0.6)
    assert number == 0 and label.shape == (0,)
