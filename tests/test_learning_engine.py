# SPDX-License-Identifier: MIT
"""A network as an engine: it proposes, and only what is proven moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from densify.cli import main
from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.flow.engines import Scene, check_engine, estimate_motion
from densify.free_space.ground import ground
from densify.learning import engine
from densify.learning.network import Model, build, write_model
from tests import scenes
from tests.small_street import KEY, POSES_GIVEN, one_car


@pytest.fixture(scope="module")
def drive() -> scenes.Scene:
    movers = (*scenes.street(), scenes.car(14, -1.6, 10, 1))
    return scenes.Scene(scenes.World(movers), scenes.Arc(0, -1.5, 0, 6.0, 0.0))


@pytest.fixture(scope="module")
def driving(drive: scenes.Scene) -> Scene:
    stretch = drive.stretch(5, 2)
    return Scene(stretch, ground(stretch))


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "random.pt"
    write_model(path, Model(build()))
    return path


def proposing(monkeypatch: pytest.MonkeyPatch, flow_of) -> None:
    """flow_of: of sweep i, from its standing points (n,3), world."""

    def flows(network, standing, origins):
        return [flow_of(i, s.points) for i, s in enumerate(standing)]

    monkeypatch.setattr(engine, "flows_of", flows)


def moved(scene: Scene, path: Path) -> list[np.ndarray]:
    motion = estimate_motion(scene, Config(), f"network:{path}")
    return [motion.flow(frame, 5).displacement for frame in scene.stretch.frames]


def truly_moving(drive: scenes.Scene) -> list[np.ndarray]:
    return [drive.scan(frame).instance == 1 for frame in range(3, 8)]


def test_what_the_network_rightly_sees_move_moves(
    drive: scenes.Scene, driving: Scene, model, monkeypatch
) -> None:
    """Told roughly: 20 % too slow, only half of the car; the same car with the same motion."""
    exact = estimate_motion(driving, Config(), "groups")
    last = len(driving.stretch.frames) - 1

    def roughly(i: int, points: np.ndarray) -> np.ndarray:
        frames = driving.stretch.frames
        field = exact.flow(frames[i], frames[i + 1 if i < last else i - 1])
        R_world_lidar = driving.stretch.sweeps[i].T_world_lidar[:3, :3]
        flow = 0.8 * field.displacement[driving.candidates[i].row] @ R_world_lidar.T
        flow[::2] = 0
        return flow

    proposing(monkeypatch, roughly)
    found = moved(driving, model)
    for frame, got, moving in zip(driving.stretch.frames, found, truly_moving(drive), strict=True):
        expected = exact.flow(frame, 5)
        off_m = np.linalg.norm(got - expected.displacement, axis=1)[expected.moving]
        assert (off_m < 0.1).mean() > 0.95
        assert not got[~moving].any()


def test_nothing_that_stands_moves_whatever_the_network_says(
    drive: scenes.Scene, driving: Scene, model, monkeypatch
) -> None:
    step = np.array([10.0, 0.0, 0.0]) * 0.1
    last = len(driving.stretch.frames) - 1
    proposing(monkeypatch, lambda i, points: np.tile(step if i < last else -step, (len(points), 1)))
    for got, moving in zip(moved(driving, model), truly_moving(drive), strict=True):
        assert not got[~moving].any()


def test_a_run_takes_a_network(model: Path) -> None:
    """Untrained, but whole: no static point leaves its rigid place."""
    sequence = one_car()
    settings = {**POSES_GIVEN, "flow": {"engine": f"network:{model}"}}
    result = scenes.by_flow(sequence, KEY, 2, config=settings)
    again = scenes.by_flow(one_car(), KEY, 2, config=settings)
    assert len(result.cloud.points) and not result.cloud.displaced[~result.cloud.moving].any()
    np.testing.assert_array_equal(result.cloud.points, again.cloud.points)


def test_a_model_is_checked_before_anything_is_computed(tmp_path: Path, capsys) -> None:
    with pytest.raises(InputError, match=r"no\.pt: no such file; expected a model"):
        check_engine(f"network:{tmp_path / 'no.pt'}")
    with pytest.raises(InputError, match="got 'network', expected network:MODEL"):
        resolve(None, ["flow.engine=network"])
    command = ["run", "--key", "120", "--flow", f"network:{tmp_path / 'no.pt'}"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert "expected a model that densify train flow wrote" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
