# SPDX-License-Identifier: MIT
"""A depth map shows the moment it is asked for: camera and movers are where they were then."""

from __future__ import annotations

import numpy as np
import pytest

from densify.pipeline.run import run
from tests.scenes import (
    SWEEP_S,
    Arc,
    Box,
    Scanner,
    Scene,
    TinySequence,
    World,
    by_flow,
    street,
)
from tests.small_street import KEY, POSES_GIVEN, one_car


@pytest.mark.parametrize("late_s", [-0.04, 0.05])
def test_an_image_of_another_moment_sees_from_where_the_camera_was(late_s):
    """At 20 m/s a shutter 50 ms late is 1 m nearer to the wall ahead."""
    boxes = (Box((1.0, 60.0, 30.0), Arc(45, 0)), *street())
    scene = Scene(World(boxes), Arc(-10, -1.5, 0, 20.0), Scanner(num_azimuths=900))
    sequence = TinySequence(scene, range(9), late_s)
    result = run(sequence, 4, 1, "icp", config=POSES_GIVEN)
    truth = sequence.truth.depth_m("front", 4)
    found = result.depth["front"].depth_m
    wall_m = 44.5 - float(scene.ego.at(4 * SWEEP_S + late_s)[0]) - 0.2  # the lens is 0.2 m ahead
    on_wall = (np.abs(truth - wall_m) < 0.02) & (found > 0)
    assert on_wall.sum() > 300
    assert abs(np.median(found[on_wall]) - wall_m) < 0.05
    maps = result.depth["front"]
    since_s = (maps.frame[found > 0] - 4) * SWEEP_S
    np.testing.assert_allclose(maps.age_s[found > 0], np.abs(since_s - late_s), atol=1e-6)
    assert len(np.unique(since_s)) == 3
    np.testing.assert_array_equal(np.isnan(maps.age_s), maps.filled_m == 0)


def test_at_the_sweeps_time_the_shutter_does_not_matter():
    def depth(late_s: float, at: str) -> np.ndarray:
        config = POSES_GIVEN | {"project": {"at": at}}
        return by_flow(one_car(late_s=late_s), KEY, 1, config=config).depth["front"].depth_m

    at_sweep, at_camera = depth(0.05, "sweep"), depth(0.05, "camera")
    assert at_sweep.tobytes() == depth(0.0, "camera").tobytes()
    moving = one_car().truth.moving_mask("front", KEY)
    moving &= one_car(late_s=0.05).truth.moving_mask("front", KEY)
    both = moving & (at_sweep > 0) & (at_camera > 0)
    assert both.sum() > 200
    farther_m = np.median((at_camera - at_sweep)[both])
    assert abs(farther_m - (8 - 4) * 0.05) < 0.05  # the car pulls away
