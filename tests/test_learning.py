# SPDX-License-Identifier: MIT
"""Learning: losses against slow twins, the network, training, model files, and the engine."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from densify.cli import main
from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.flow.energy import on_one_thread
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ground
from densify.learning import network
from densify.learning.network import Model, NetworkCloud, build, order_for, read_model, write_model
from densify.learning.training import (
    ALPHA,
    NUM_NEIGHBORS,
    Clip,
    ClipMaker,
    Sample,
    Training,
    make_clip,
    objective_loss,
    sample_of,
    supervised_loss,
    train,
)
from tests import scenes
from tests.command import refused
from tests.small_street import KEY, POSES_GIVEN, one_car


@pytest.fixture(scope="module")
def clip() -> Clip:
    """A street and a car at 8 m/s along x, with exact flow."""
    return make_clip(one_car(), KEY, resolve(POSES_GIVEN), "truth")


def cloud(count: int, seed: int = 0, reach_m: float = 30.0) -> NetworkCloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach_m, reach_m, (count, 3)).astype(np.float32)
    points[:, 2] = rng.uniform(-1.5, 1.0, count)
    return NetworkCloud(torch.from_numpy(points), torch.from_numpy(points[:, 2] + 1.7))


def pair(source: np.ndarray, target: np.ndarray, flow: np.ndarray | None = None) -> Sample:
    points = (torch.from_numpy(np.asarray(p, np.float32)) for p in (source, target))
    first, second = (NetworkCloud(p, p[:, 2]) for p in points)
    everything = torch.arange(len(source))
    in_reach = torch.ones(len(source), dtype=torch.bool)
    labels: tuple = (None, None)
    if flow is not None:
        moving = torch.from_numpy(np.abs(flow).sum(1) > 0)
        labels = (torch.from_numpy(np.asarray(flow, np.float32)), moving)
    return Sample((first, second), everything, second.points, in_reach, 0.1, *labels)


def squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None] - b[None]) ** 2).sum(-1)


def test_the_objective_equals_its_slow_twin() -> None:
    rng = np.random.default_rng(4)
    source, target = rng.uniform(-2, 2, (80, 3)), rng.uniform(-2, 2, (70, 3))
    flow = rng.normal(0, 0.2, (80, 3))
    between = squared(source, source)
    near = np.zeros_like(between, bool)
    np.put_along_axis(near, np.argsort(between, axis=1)[:, : NUM_NEIGHBORS + 1], True, axis=1)
    weights = np.where(near | near.T, np.exp(-between), 0.0)
    degree = weights.sum(1)
    matrix = (np.diag(degree) - weights) / np.sqrt(np.outer(degree, degree))
    apart = squared(source + flow, target)
    data = apart.min(1).sum() + apart.min(0).sum()
    expected = (data + ALPHA * np.trace(flow.T @ matrix @ flow)) / len(source)
    assert ALPHA == 4.0 and NUM_NEIGHBORS == 50
    tensor = torch.from_numpy(flow.astype(np.float32))
    got = objective_loss(lambda sweeps: tensor, pair(source, target))
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_static_slow_and_fast_points_weigh_the_same() -> None:
    true = np.zeros((100, 3))
    true[98], true[99] = [0.05, 0, 0], [2.0, 0, 0]  # 0.5 and 20 m/s
    sample = pair(np.zeros((100, 3)), np.zeros((5, 3)), true)
    off = torch.zeros(100, 3)
    off[:98, 1], off[98], off[99] = 0.01, torch.tensor([0.05, 0.2, 0]), torch.tensor([2, 0, 0.5])
    assert float(supervised_loss(lambda sweeps: off, sample)) == pytest.approx(0.71, abs=1e-3)


def test_the_network_takes_any_clouds_and_any_number_of_threads() -> None:
    network, before = build().eval(), torch.get_num_threads()
    with torch.inference_mode():
        for sweeps in ([cloud(500), cloud(300, 1)], [cloud(500), cloud(40, 1), None]):
            flow = network(sweeps)
            assert flow.shape == (500, 3) and torch.isfinite(flow).all() and flow.any()
        assert network([cloud(0), cloud(9)]).shape == (0, 3)
        one, other = (network([cloud(500), cloud(300, seed)]) for seed in (1, 2))
    assert (one != other).any()
    sweeps, flows = [cloud(20_000, n) for n in range(3)], []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with on_one_thread(), torch.inference_mode():
            flows.append(network(sweeps))
    torch.set_num_threads(before)
    assert torch.equal(*flows)


def test_sweeps_before_the_source_come_in_the_direction_of_time() -> None:
    assert order_for(3, 4, 7) == [3, 4, 2]
    assert order_for(3, 2, 4) == [3, 2, None]
    assert order_for(0, 1, 5) == [0, 1, None]


def test_the_network_learns_what_moves(clip: Clip) -> None:
    """One pair by heart: most of the motion, and that the rest is static."""
    sample, network = sample_of(clip, 1, 2), build()
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    with on_one_thread():
        for _ in range(12):
            optimizer.zero_grad()
            supervised_loss(network, sample).backward()
            optimizer.step()
    with torch.inference_mode():
        error_m = (network(sample.sweeps) - sample.flow).norm(dim=1)
    static, moving = error_m[~sample.moving].mean(), error_m[sample.moving].mean()
    assert moving < 0.3 and static < 0.15  # a flow of 0 has an error of 0.8 m


def test_training_changes_the_network_and_a_seed_gives_the_same_bytes(
    clip: Clip, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(ClipMaker, "__call__", lambda maker, number: clip)
    paths = [tmp_path / f"{i}.pt" for i in range(3)]
    for path, seed in zip(paths, (0, 0, 1), strict=True):
        train(Training(("streets",), steps=1, seed=seed), path)
    first, again, other = (path.read_bytes() for path in paths)
    assert first == again != other
    trained = read_model(paths[0]).network.parameters()
    changed = zip(build().parameters(), trained, strict=True)
    assert any(not torch.equal(a, b) for a, b in changed)


def test_a_random_change_moves_points_and_flow_alike(clip: Clip) -> None:
    """Turned, mirrored and scaled, a point plus its flow is where it was seen next."""
    rng = np.random.default_rng(2)
    for source, target in ((1, 2), (2, 1)):
        plain = sample_of(clip, source, target)
        changed = sample_of(clip, source, target, rng)
        a, b = plain.sweeps[0].points, changed.sweeps[0].points
        change, *_ = np.linalg.lstsq(a.numpy(), b.numpy(), rcond=None)
        np.testing.assert_allclose(plain.flow.numpy() @ change, changed.flow.numpy(), atol=1e-4)
        there = plain.sweeps[1].points.numpy() @ change
        np.testing.assert_allclose(there, changed.sweeps[1].points.numpy(), atol=1e-3)
        sign = 1 if target > source else -1
        assert plain.flow[plain.moving][:, 0].numpy() == pytest.approx(0.8 * sign, abs=1e-4)
        assert plain.duration_s == pytest.approx(0.1)


def test_a_model_comes_back(tmp_path: Path) -> None:
    model = Model(build(3), {"teacher": "truth"})
    for name in ("a.pt", "b"):
        write_model(tmp_path / name, model)
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b").read_bytes()
    back = read_model(tmp_path / "b")
    assert back.provenance == model.provenance
    for name, tensor in model.network.state_dict().items():
        assert torch.equal(tensor, back.network.state_dict()[name])


def test_other_models_are_refused(tmp_path: Path) -> None:
    path, bias = tmp_path / "m.pt", "weights/decode.4.bias"
    write_model(path, Model(build()))
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(bytes(arrays["header"]))
    other = np.frombuffer(json.dumps({**header, "version": 2}).encode(), np.uint8)
    for change, message in (
        ({"header": other}, "2, 'voxels'.*expected"),
        ({bias: np.zeros(4, np.float32)}, "damaged: .*size mismatch"),
        ({bias: np.full(3, np.nan, np.float32)}, "not finite"),
    ):
        with path.open("wb") as out:
            np.savez(out, **{**arrays, **change})
        with pytest.raises(InputError, match=message):
            read_model(path)
    torch.save({"weights": torch.zeros(3)}, path)  # a pickle
    with pytest.raises(InputError, match="no model that densify train flow wrote"):
        read_model(path)


def test_the_command_trains_on_a_street(tmp_path: Path, capsys, monkeypatch) -> None:
    """A recording is labelled by our engine, and a network learns from it."""
    module = "densify.learning.training"
    monkeypatch.setattr(f"{module}._NUM_MIXED", 1)  # clips made ahead
    monkeypatch.setattr(f"{module}.open_sequence", lambda spec: one_car())
    monkeypatch.setattr(f"{module}.resolve", lambda _: resolve(POSES_GIVEN))
    out = tmp_path / "m.pt"
    command = ["train", "flow", "--data", "street", "--out", str(out), "--teacher", "engine"]
    command += ["--steps", "2"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("2 steps, loss") and lines[1:] == [str(out)]
    assert read_model(out).provenance["teacher"] == "engine"
    assert "already there and kept; give --overwrite" in refused(capsys, 2, *command)
    estimated, true = (ClipMaker(("street",), 0, teacher)(0) for teacher in ("engine", "truth"))
    assert any(sweep.moving.any() for sweep in estimated), "no moving points say nothing"
    for sweep, truth in zip(estimated, true, strict=True):
        moving = sweep.moving & truth.moving
        error_m = np.linalg.norm(sweep.flow - truth.flow, axis=2)[:, moving]
        assert not moving.any() or np.median(error_m) < 0.1


@pytest.mark.parametrize(
    ("steps", "data", "message"),
    [
        ("0", "streets", "--steps 0: expected 1 or more"),
        ("1", "nowhere", "nowhere"),
        ("1", "streets?seed=3", "seeds are drawn"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, capsys, steps, data, message: str) -> None:
    command = ["train", "flow", "--out", tmp_path / "m.pt", "--steps", steps, "--data", data]
    assert message in refused(capsys, 2, *command)
    assert not list(tmp_path.iterdir())


# --- the engine: a network proposes, and only what is proven moves --------------------------------

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

    def flows(trained, above, origins):
        return [flow_of(i, sweep.points) for i, sweep in enumerate(above)]

    monkeypatch.setattr(network, "flows_of", flows)
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
