# SPDX-License-Identifier: MIT
"""A network as an engine: it proposes, and only what is proven moves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ground
from densify.learning import engine
from densify.learning.network import Model, build, write_model
from tests import scenes
from tests.command import refused
from tests.small_street import KEY, POSES_GIVEN, one_car

MOVERS = (*scenes.street(), scenes.car(14, -1.6, 10, 1))
DRIVE = scenes.Scene(scenes.World(MOVERS), scenes.Arc(0, -1.5, 0, 6.0, 0.0))
KEY_FRAME = 5


@pytest.fixture(scope="module")
def driving() -> Scene:
    stretch = DRIVE.stretch(KEY_FRAME, 2)
    return Scene(stretch, ground(stretch))


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "random.pt"
    write_model(path, Model(build()))
    return path


def moved(monkeypatch, scene: Scene, path: Path, flow_of: Callable) -> list[np.ndarray]:
    """flow_of: sweep number, (n,3) points above the ground -> flow that the network proposes."""

    def flows(network, above, origins):
        return [flow_of(i, sweep.points) for i, sweep in enumerate(above)]

    monkeypatch.setattr(engine, "flows_of", flows)
    motion = estimate_motion(scene, Config(), f"network:{path}")
    displacement = [motion.flow(frame, KEY_FRAME).displacement for frame in scene.stretch.frames]
    for frame, moves in zip(scene.stretch.frames, displacement, strict=True):
        assert not moves[DRIVE.scan(frame).instance != 1].any()  # nothing that stands moves
    return displacement


def test_what_the_network_rightly_sees_move_moves(driving: Scene, model, monkeypatch) -> None:
    """Told roughly: 20 % too slow, only half of the car; the same car with the same motion."""
    exact, frames = estimate_motion(driving, Config(), "groups"), driving.stretch.frames

    def roughly(i: int, points: np.ndarray) -> np.ndarray:
        field = exact.flow(frames[i], frames[i + 1 if i + 1 < len(frames) else i - 1])
        R_world_lidar = driving.stretch.sweeps[i].T_world_lidar[:3, :3]
        flow = 0.8 * field.displacement[driving.obstacles[i].row] @ R_world_lidar.T
        flow[::2] = 0
        return flow

    for frame, got in zip(frames, moved(monkeypatch, driving, model, roughly), strict=True):
        expected = exact.flow(frame, KEY_FRAME)
        off_m = np.linalg.norm(got - expected.displacement, axis=1)[expected.moving]
        assert (off_m < 0.1).mean() > 0.95


def test_nothing_that_stands_moves_whatever_the_network_says(
    driving: Scene, model, monkeypatch
) -> None:
    last, step_m = len(driving.stretch.frames) - 1, np.array([1.0, 0.0, 0.0])
    moved(monkeypatch, driving, model, lambda i, x: np.zeros_like(x) + step_m * (-1) ** (i == last))


def test_a_run_takes_a_network(model: Path) -> None:
    """Untrained, but whole: no static point leaves its rigid place."""
    sequence = one_car()
    settings = {**POSES_GIVEN, "flow": {"engine": f"network:{model}"}}
    result = scenes.by_flow(sequence, KEY, 2, config=settings)
    again = scenes.by_flow(one_car(), KEY, 2, config=settings)
    assert len(result.cloud.points) and not result.cloud.displaced[~result.cloud.moving].any()
    np.testing.assert_array_equal(result.cloud.points, again.cloud.points)


def test_a_model_is_checked_before_anything_is_computed(tmp_path: Path, capsys) -> None:
    with pytest.raises(InputError, match="got 'network', expected network:MODEL"):
        resolve(None, ["flow.engine=network"])
    command = ["run", "street", "--key", "120", "--flow", f"network:{tmp_path / 'no.pt'}"]
    message = refused(capsys, 2, *command, "--out", tmp_path / "out")
    assert "no.pt: no such file; expected a model that densify train flow wrote" in message
    assert not (tmp_path / "out").exists()
