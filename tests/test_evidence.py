# SPDX-License-Identifier: MIT
"""Which points are suspected to move: those that some other sweep saw through."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config import FlowSettings, GroundSettings
from densify.flow.tracking.evidence import FreeSpace, Standing, find_candidates
from densify.free_space.ground import ground
from densify.free_space.height_map import HeightMap
from densify.geometry import poses
from densify.geometry.types import Stretch
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
def heights(stretch) -> HeightMap:
    return ground(stretch, GroundSettings())


@pytest.fixture(scope="module")
def space(stretch) -> FreeSpace:
    return FreeSpace.of(stretch)


@pytest.fixture(scope="module")
def evidence(stretch, space, heights) -> tuple[Standing, ...]:
    found = find_candidates(stretch, space, heights, MIN_HEIGHT_M)
    return tuple(Standing.of(stretch, i, candidates) for i, candidates in enumerate(found))


def test_standing_points_are_where_and_when_their_rows_say(stretch, evidence):
    for i, (registered, c) in enumerate(zip(stretch.sweeps, evidence, strict=True)):
        placed = poses.transform(registered.T_world_lidar, registered.sweep.points[c.row])
        np.testing.assert_allclose(c.points, placed)
        fired_s = i * SWEEP_S + registered.sweep.offset_ns[c.row] * 1e-9
        np.testing.assert_allclose(c.time_s, fired_s, atol=1e-9)
        assert len(c.row) == len(np.unique(c.row)) == len(c.seed) == len(c.cluster)
        assert set(np.unique(c.cluster[c.candidate])) == set(range(c.num_clusters))
        assert (c.cluster[~c.candidate] == -1).all()


@pytest.mark.parametrize("min_height_m", [MIN_HEIGHT_M, 1.0])
def test_what_stands_is_above_the_height_and_nothing_else_is(stretch, space, heights, min_height_m):
    for found, s in zip(
        find_candidates(stretch, space, heights, min_height_m), stretch.sweeps, strict=True
    ):
        height_m = heights.above(poses.transform(s.T_world_lidar, s.sweep.points))
        np.testing.assert_array_equal(found.row, np.flatnonzero(height_m >= min_height_m))


def test_what_truly_stands_is_there(scene, stretch, evidence):
    for frame, c in zip(stretch.frames, evidence, strict=True):
        near = np.linalg.norm(stretch[frame].sweep.points, axis=1) < 35
        stands = (scene.height_m(frame) > MIN_HEIGHT_M + 0.1) & (scene.scan(frame).box >= 0) & near
        found = np.isin(np.flatnonzero(stands), c.row)
        assert found.mean() > 0.99


def test_candidates_are_few_and_the_movers_are_among_them(scene, stretch, evidence):
    for frame, c in zip(stretch.frames, evidence, strict=True):
        assert 0 < c.candidate.sum() < 0.1 * len(stretch[frame].sweep)
        assert c.candidate[c.seed].mean() > 0.5
    c, instance = evidence[stretch.frames.index(KEY)], scene.scan(KEY).instance
    for mover in (1, FAST):
        mine = instance[c.row] == mover
        assert mine.sum() > 100 and c.candidate[mine].mean() > 0.8


def test_movers_are_seen_through_and_walls_are_not(scene, stretch, space):
    i, j = stretch.frames.index(KEY), stretch.frames.index(KEY + 4)
    scan, registered = scene.scan(KEY), stretch[KEY]
    points = poses.transform(registered.T_world_lidar, registered.sweep.points)
    free = space.seen_through(points, j)
    assert free[scan.instance == FAST].mean() > 0.5
    still = (scan.instance < 0) & (scan.box >= 0)
    assert free[still].mean() < 1e-3
    assert not space.seen_through(points, i).any()
