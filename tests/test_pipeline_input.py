# SPDX-License-Identifier: MIT
"""The pipeline on what recordings and users give it: poses, sweeps without times or points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import RegisterSettings
from densify.config.errors import ComputationError, InputError
from densify.dataset.make import make_dataset
from densify.geometry import poses
from densify.pipeline.run import compare, run
from densify.readers.timeline import read_sweep
from tests.scenes import TinySequence, by_flow
from tests.small_street import KEY, POSES_GIVEN, one_car


def test_progress_names_every_stage():
    seen: list[tuple[str, int, int]] = []
    run(one_car(()), KEY, 1, "icp", config=POSES_GIVEN, progress=lambda *step: seen.append(step))
    names = list(dict.fromkeys(name for name, _, _ in seen))
    assert names[:5] == ["read", "register", "images", "deskew", "accumulate"]
    # These are worked out side by side.
    assert sorted(names[5:]) == ["colour", "held out", "project", "score"]
    assert all(0 <= done <= total for _, done, total in seen)
    for name in names:
        steps = [(done, total) for n, done, total in seen if n == name]
        assert steps[0][0] == 0 and steps[-1][0] == steps[-1][1]


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


def test_without_a_camera_there_is_a_cloud_and_no_depth():
    result = run(one_car(()), KEY, 1, "icp", cameras=[], config=POSES_GIVEN)
    assert len(result.cloud) and not result.depth and not result.metrics["density"]


def test_without_truth_there_are_no_errors_of_depth():
    result = run(one_car((), with_truth=False), KEY, 1, "icp", config=POSES_GIVEN)
    assert "depth" not in result.metrics and result.metrics["ghosts"]["num_points"] > 0


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
    assert not sequence.read


def test_texts_are_no_lists_and_no_recordings() -> None:
    sequence = one_car(())
    for other in ("street", None, 3):
        with pytest.raises(InputError, match=f"sequence: got {other!r}, expected what densify"):
            run(other, KEY, 1)
    with pytest.raises(InputError, match="methods: got 'flow', expected a list of names"):
        compare(sequence, KEY, 1, methods="flow")
    with pytest.raises(InputError, match="data: got 'street', expected a list of recordings"):
        make_dataset("street", "nowhere")
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


@pytest.mark.parametrize("num_points", [0, 50])
@pytest.mark.parametrize("sparse", [KEY, KEY + 1])
def test_an_almost_empty_sweep_of_known_pose_does_no_harm(num_points, sparse):
    sequence = Sparse(one_car().scene, range(7))
    sequence.sparse, sequence.num_points = sparse, num_points
    cloud = by_flow(sequence, KEY, 1, config=POSES_GIVEN).cloud
    assert (cloud.frame == sparse).sum() <= num_points
    assert np.isfinite(cloud.points).all() and not cloud.moving[cloud.frame == sparse].any()
