# SPDX-License-Identifier: MIT
"""What proves that a group moved between two clouds: surfaces, and nothing that slides."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.pair_groups import PairCloud, RigidMotion, _is_ambiguous, judge
from densify.flow.two_clouds import estimate_flow
from densify.geometry import poses
from tests.scenes import Arc, Scanner, Scene, World, car, street

WAY = np.array([1.3, -0.2, 0.0])


def bar(num: int, length_m: float, yaw: float = 0.0) -> np.ndarray:
    """A level bar .3 m high and 5 cm thick."""
    x, y, z = np.random.default_rng(0).uniform(-0.5, 0.5, (3, num))
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return np.outer(length_m * x, along) + np.outer(0.05 * y, across) + np.outer(0.3 * z, [0, 0, 1])


@pytest.mark.parametrize("yaw", [0.0, 1.1])
@pytest.mark.parametrize(
    ("num", "length_m", "direction", "slides"),
    [
        (30, 1.7, np.pi / 2, False),  # the back of a car, far away, and it drives away
        (30, 1.7, np.pi / 2 + 0.1, False),
        (30, 1.7, 0.0, True),  # a rail along itself,
        (30, 1.7, 1.2, True),  # or to the rail beside
        (30, 4.0, np.pi / 2, True),  # no car is so wide
        (150, 1.7, np.pi / 2, True),  # or so low, so near
    ],
)
def test_a_level_bar_moves_only_as_the_back_of_a_far_car_does(
    num, length_m, direction, slides, yaw
):
    way = np.array([np.cos(yaw + direction), np.sin(yaw + direction), 0.0])
    assert _is_ambiguous(bar(num, length_m, yaw), way) == slides


def corner(num: int, seed: int) -> np.ndarray:
    """The rear and the side of a car, noise of 1 cm."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 1, (2, num))
    rear = np.arange(num) % 2 == 0
    x, y = np.where(rear, 0.0, 3 * u), np.where(rear, 1.8 * u, 0.0)
    return np.column_stack([x, y, 1.3 * v]) + 0.01 * rng.standard_normal((num, 3))


@pytest.mark.parametrize("moved", [True, False])
def test_both_clouds_tell_whether_a_group_moved(moved):
    """The source shows where it was, the target where it is and that its old position is free."""
    source = PairCloud(corner(600, 1), np.zeros(600))
    target = PairCloud(corner(600, 2) + WAY * moved, np.ones(600))
    gain = {}
    for share in (0.5, 1.0, 1.5):
        motion = RigidMotion(np.append(share * WAY, 0.0), source.points.mean(0))
        judged = judge(0, np.arange(600), motion, source, target)
        assert judged.moves() or not (moved and share == 1.0)
        assert moved or not judged.moves()
        gain[share] = judged.gain
    assert gain[1.0] > max(gain[0.5], gain[1.5]) + 50 if moved else max(gain.values()) < 0


def test_a_group_whose_old_position_is_still_taken_did_not_move():
    """As a static car with a second one where the first could have gone."""
    source = PairCloud(corner(600, 1), np.zeros(600))
    both = np.concatenate([corner(600, 2), corner(600, 3) + WAY])
    target = PairCloud(both, np.ones(1200))
    motion = RigidMotion(np.append(WAY, 0.0), source.points.mean(0))
    assert not judge(0, np.arange(600), motion, source, target).moves()


@pytest.mark.parametrize("timed", [False, True])
def test_rings_that_lie_elsewhere_on_a_near_car_are_no_misfit(timed):
    """Sixteen rings: hardly a point of the car has a neighbour where it went."""
    world = World((car(5.0, 3.0, 14.0, 1), *street()))
    scene = Scene(world, Arc(-0.4, -1.5, 0.0, 8.0, 0.1), Scanner(16, sigma_m=0.01))
    stretch = scene.stretch(2, 1)
    here, there = stretch[2].sweep, stretch[3].sweep
    target = poses.transform(stretch.T_target_source(2, 3), there.points)
    columns = {"source_offset_ns": here.offset_ns, "target_offset_ns": there.offset_ns}
    field = estimate_flow(here.points, target, **(columns if timed else {}))
    mine = scene.scan(2).instance == 1
    error_m = np.linalg.norm(field.displacement - scene.displacement(2, 3), axis=1)
    assert mine.sum() > 300 and field.moving[mine].mean() > 0.9
    assert error_m[mine & field.moving].mean() < 0.03
