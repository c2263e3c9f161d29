# SPDX-License-Identifier: MIT
"""The pipeline on what recordings and users give it: poses, sweeps without times or points."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import ComputationError, InputError
from densify.geometry import poses
from densify.pipeline.run import compare, run
from tests.scenes import TinySequence
from tests.small_street import KEY, POSES_GIVEN, one_car


def test_the_data_sets_poses_are_taken_as_they_are():
    sequence = one_car(())
    result = run(sequence, KEY, 1, "icp", config=POSES_GIVEN)
    T = poses.inverse(sequence.T_world_lidar(KEY)) @ sequence.T_world_lidar(KEY + 1)
    mine = result.cloud.frame == KEY + 1
    true = poses.transform(
        poses.inverse(sequence.T_world_lidar(KEY)), sequence.scene.scan(KEY + 1).world
    )
    near = np.linalg.norm(sequence[KEY + 1].points, axis=1) >= 2.8
    np.testing.assert_allclose(
        result.cloud.points[mine], true[near][result.cloud.row[mine]], atol=0.02
    )
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.4, abs=0.01)


def test_poses_of_the_data_set_are_checked_too():
    class Jumping(TinySequence):
        def T_world_lidar(self, frame):
            T = super().T_world_lidar(frame)
            T[0, 3] += 30.0 * (frame > KEY)
            return T

    good = one_car(())
    result = run(Jumping(good.scene, good.frames), KEY, 2, "icp", config=POSES_GIVEN)
    assert result.frames == (KEY - 2, KEY - 1, KEY)
    assert f"frame {KEY} to {KEY + 1}" in result.warnings[0]

    class Alone(TinySequence):
        def T_world_lidar(self, frame):
            T = super().T_world_lidar(frame)
            T[0, 3] += 30.0 * (frame % 2)
            return T

    with pytest.raises(ComputationError, match="registration jumps"):
        run(Alone(good.scene, good.frames), KEY, 2, "icp", config=POSES_GIVEN)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"key": 99}, "key 99"),
        ({"key": 3.0}, r"key 3\.0: expected a frame's number"),
        ({"key": [3]}, "key .3.: expected a frame's number"),
        ({"window": True}, "window True"),
        ({"cameras": 5}, "cameras: got 5, expected a list of names, such as .'front'."),
        ({"window": -2}, "window -2"),
        ({"cameras": ["back"]}, "camera back.*front"),
        ({"config": {"objective": {"alhpa": 1}}}, "alpha"),
        ({"method": "paper"}, "method paper: expected one of none, icp, flow"),
        ({"methods": ("icp", "magic")}, "methods magic: expected some of none, icp, "),
        ({"methods": []}, "methods: got no name, expected some of none, icp, "),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_read(arguments, message):
    sequence = one_car(())
    with pytest.raises(InputError, match=message) as caught:
        make = compare if "methods" in arguments else run
        make(sequence, **{"key": KEY, "window": 1, **arguments})
    assert "\n" not in str(caught.value)
    assert not sequence.read
