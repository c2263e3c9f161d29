# SPDX-License-Identifier: MIT
"""The pipeline on what recordings and users give it: poses, sweeps without times or points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import RegisterSettings
from densify.config.errors import ComputationError, InputError
from densify.geometry import poses
from densify.pipeline.run import compare, run
from densify.readers.timeline import read_sweep
from tests.scenes import TinySequence, by_flow
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


def test_a_sweep_without_times_is_not_deskewed():
    class Timeless(TinySequence):
        def __getitem__(self, frame):
            return replace(super().__getitem__(frame), offset_ns=None)

    good = one_car()
    sequence = Timeless(good.scene, good.frames)
    result = by_flow(sequence, KEY, 1, config=POSES_GIVEN)
    own = result.cloud.frame == KEY
    kept = read_sweep(sequence, KEY, RegisterSettings())
    np.testing.assert_allclose(result.cloud.points[own], kept.points, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"key": 99}, "--key 99"),
        ({"key": 3.0}, r"--key 3\.0: expected a frame's number"),
        ({"key": "3"}, "--key '3': expected a frame's number"),
        ({"key": [3]}, "--key .3.: expected a frame's number"),
        ({"window": "1"}, "--window '1'"),
        ({"window": True}, "--window True"),
        ({"cameras": "front"}, "cameras: got 'front', expected a list"),
        ({"cameras": 5}, "cameras: got 5, expected a list of names, such as .'front'."),
        ({"method": "magic"}, "--method magic: expected one of none, icp, flow"),
        ({"window": -2}, "--window -2"),
        ({"cameras": ["back"]}, "--camera back.*front"),
        ({"config": {"objective": {"alhpa": 1}}}, "alpha"),
        ({"method": "paper"}, "--method paper: expected one of none, icp, flow"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_read(arguments, message):
    sequence = one_car(())
    with pytest.raises(InputError, match=message) as caught:
        run(sequence, **{"key": KEY, "window": 1, **arguments})
    assert "\n" not in str(caught.value)
    assert not sequence.read


def test_unknown_methods_are_refused_before_anything_is_read():
    sequence = one_car(())
    with pytest.raises(InputError, match="--methods magic: expected some of none, icp, "):
        compare(sequence, KEY, 1, methods=("icp", "magic"))
    with pytest.raises(InputError, match="--methods: got no name, expected some of none, icp, "):
        compare(sequence, KEY, 1, methods=[])
    assert not sequence.read


class Sparse(TinySequence):
    """One sweep has next to no returns."""

    sparse, num_points = KEY, 0

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        few = np.arange(len(sweep)) < self.num_points
        return sweep.select(few) if frame == self.sparse else sweep


@pytest.mark.parametrize("num_points", [0, 50])
def test_an_almost_empty_key_cannot_be_registered(num_points):
    sequence = Sparse(one_car(()).scene, range(7))
    sequence.num_points = num_points
    with pytest.raises(InputError, match=rf"sweep {KEY} has {num_points} points"):
        run(sequence, KEY, 1)


def test_an_almost_empty_sweep_beside_the_key_ends_its_window():
    sequence = Sparse(one_car(()).scene, range(7))
    sequence.sparse, sequence.num_points = KEY + 1, 50
    result = run(sequence, KEY, 1, "icp")
    assert result.frames == (KEY - 1, KEY)
    assert f"sweep {KEY + 1} has 50 points" in result.warnings[0]
