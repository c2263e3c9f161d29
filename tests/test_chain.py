# SPDX-License-Identifier: MIT
"""Chaining on motions whose composition is known."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.engines import ChainedMotion
from densify.geometry.types import FlowField
from tests.exact_motion import (
    FRAMES,
    KEY,
    NUM_MOVING,
    NUM_STATIC,
    PAIRS,
    T_world_lidar,
    chained,
    drifting,
    in_world,
    scene,
    true_flow,
    turning,
)


@pytest.mark.parametrize(
    ("body", "num_points"),
    [(drifting, NUM_MOVING), (turning, NUM_MOVING), (drifting, 1), (drifting, 2)],
)
def test_steps_compose_exactly_though_every_sweep_has_other_points(body, num_points):
    """Objects of one or two points move without turning. The velocity is that of the last step."""
    motion = scene(body, sizes=dict.fromkeys(FRAMES, num_points))
    for frame, target in PAIRS:
        flow = motion.flow(frame, target)
        found = in_world(frame, flow.displacement)[NUM_STATIC:]
        np.testing.assert_allclose(found, true_flow(motion, frame, target, body), atol=1e-9)
        assert not flow.lost.any()
        if body is drifting:
            velocity_m_s = in_world(frame, flow.velocity_m_s)[NUM_STATIC:]
            expected_m_s = np.tile([15.0, -5.0, 1.0], (num_points, 1))
            np.testing.assert_allclose(velocity_m_s, expected_m_s, atol=1e-6)


def test_each_step_is_asked_for_once_when_needed_and_never_written_to():
    motion = scene()
    given: dict[tuple[int, int], FlowField] = {}

    def step(here: int, there: int) -> FlowField:
        assert (here, there) not in given
        given[here, there] = motion.step(here, there)
        return given[here, there]

    watched = ChainedMotion(motion.stretch, step)
    for frame, target, asked in (
        (101, KEY, {(1, 2), (2, 3)}),
        (100, KEY, {(0, 1), (1, 2), (2, 3)}),
        (100, KEY + 1, {(0, 1), (1, 2), (2, 3), (3, 4)}),
    ):
        watched.flow(frame, target)
        assert set(given) == asked
    for pair, field in given.items():
        assert field.displacement.tobytes() == motion.step(*pair).displacement.tobytes()
        assert field.velocity_m_s is None and not field.lost.any()


@pytest.mark.parametrize("missing", [KEY - 1, KEY - 2, KEY + 2])
def test_lost_where_a_sweep_in_between_has_nothing_of_the_object(missing):
    motion = scene(sizes={f: 0 if f == missing else NUM_MOVING for f in FRAMES})
    for frame, target in PAIRS:
        if frame == missing:
            continue
        flow = motion.flow(frame, target)
        behind = (missing - target) * (frame - missing) > 0
        assert (flow.lost[NUM_STATIC:] == behind).all()
        assert not flow.lost[:NUM_STATIC].any()
        if not behind:
            found = in_world(frame, flow.displacement)[NUM_STATIC:]
            np.testing.assert_allclose(found, true_flow(motion, frame, target), atol=1e-9)


def test_what_is_not_rigid_follows_its_nearest():
    """Two arms of one object that swing against each other."""
    rng = np.random.default_rng(2)
    arm = np.repeat([-1.0, 1.0], 20)
    points = {
        f: np.stack([arm + f - KEY, rng.uniform(-0.2, 0.2, 40), rng.uniform(0, 1, 40)], 1)
        for f in FRAMES
    }
    swing = np.stack([np.ones(40), 0.1 * arm, 0 * arm], 1)
    motion = chained(points, lambda f, t: (t - f) * swing, dict.fromkeys(FRAMES, np.zeros(40)))
    for frame, target in PAIRS:
        if abs(frame - target) == 2:
            found = in_world(frame, motion.flow(frame, target).displacement)
            np.testing.assert_allclose(found, (target - frame) * swing, atol=0.03)


def everything_moves(gap_m: float) -> ChainedMotion:
    """As the published method has it: no objects, every point with its own flow, 0.4 m ahead per
    sweep. In the sweep before the key the points beyond y = 0 stand ``gap_m`` further aside."""
    base = np.random.default_rng(4).uniform(-3, 3, (200, 3))
    ahead = np.array([0.4, 0, 0])
    points = {f: base + ahead * (f - KEY) for f in FRAMES}
    points[KEY - 1][base[:, 1] > 0, 1] += gap_m
    nobody = dict.fromkeys(FRAMES, np.full(200, -1))
    return chained(points, lambda f, t: np.tile(ahead * (t - f), (200, 1)), nobody)


def test_points_without_an_object_follow_the_nearest_and_are_lost_over_a_gap():
    motion = everything_moves(gap_m=0.0)
    for frame, target in PAIRS:
        flow = motion.flow(frame, target)
        assert flow.moving.all() and not flow.lost.any()
        expected = np.tile([0.4 * (target - frame), 0, 0], (200, 1))
        np.testing.assert_allclose(in_world(frame, flow.displacement), expected, atol=1e-9)
    motion = everything_moves(gap_m=20.0)
    y = in_world(KEY, motion.stretch[KEY].sweep.points)[:, 1] + T_world_lidar(KEY)[1, 3]
    before = motion.flow(KEY - 2, KEY)
    assert before.lost[y > 0.6].all() and not before.lost[y < 0].any()
    assert motion.flow(KEY - 3, KEY).lost[y > 0.6].all()  # and stays lost farther out
    assert not motion.flow(KEY + 2, KEY).lost.any()
    assert not everything_moves(0.45).flow(KEY - 2, KEY).lost.any()
