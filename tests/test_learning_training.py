# SPDX-License-Identifier: MIT
"""Training: it learns, it comes out the same, it survives a kill, and its files are checked."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from densify.cli import main
from densify.config.errors import ComputationError, InputError
from densify.learning.clips import ClipMaker
from densify.learning.losses.supervised import supervised_loss
from densify.learning.model_file import Model, read_model, write_model
from densify.learning.networks import build
from densify.learning.samples import NUM_DRAWN, sample_of, samples
from densify.learning.training import Training, chosen_device, train
from tests.learning_scenes import SmallClips, clip, train_small

CHECKOUT = Path(__file__).parents[1]


def losses_of(path: Path) -> list[float]:
    return read_model(path).beside["losses"].tolist()


def test_a_network_learns_what_moves() -> None:
    """One pair by heart: most of the motion, and that the rest stands."""
    sample, network = sample_of(clip(0), 1, 2, 3, "truth"), build("voxels")
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    for _ in range(20):
        optimizer.zero_grad()
        supervised_loss(network, sample).backward()
        optimizer.step()
    with torch.inference_mode():
        error_m = (network(sample.sweeps) - sample.flow).norm(dim=1)
    still, moved = error_m[~sample.moving].mean(), error_m[sample.moving].mean()
    assert moved < 0.3 and still < 0.15  # 1 m is what doing nothing earns


@pytest.mark.parametrize("teacher", ["objective", "pointpwc", "cycle", "engine"])
def test_every_teacher_trains_every_network(tmp_path: Path, teacher: str) -> None:
    for model in ("voxels", "flownet3d"):
        paths = train_small(str(tmp_path / model), teacher=teacher, model=model, steps=1)
        begun, trained = build(model), read_model(paths[0]).network
        changed = zip(begun.parameters(), trained.parameters(), strict=True)
        assert any(not torch.equal(a, b) for a, b in changed)
        assert paths[1].read_bytes().startswith(b"\x89PNG")


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    made = [
        train_small(str(tmp_path / name), steps=3, seed=seed)[0].read_bytes()
        for name, seed in (("a", 5), ("b", 5), ("c", 6))
    ]
    assert made[0] == made[1] != made[2]


def test_a_killed_training_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """SIGKILL at any moment; what is resumed equals what was never stopped."""
    whole = train_small(str(tmp_path / "whole.pt"), steps=12)[0]
    out, checkpoint = tmp_path / "killed.pt", tmp_path / "killed.pt.checkpoint"
    code = f"from tests.learning_scenes import train_small; train_small({str(out)!r}, steps=12)"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=CHECKOUT)
    try:
        until = time.monotonic() + 120
        while not checkpoint.exists() and time.monotonic() < until and process.poll() is None:
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert 5 <= len(losses_of(checkpoint)) < 12 and not out.exists()
    resumed = train_small(str(out), resume=True, steps=12)[0]
    assert resumed.read_bytes() == whole.read_bytes() and not checkpoint.exists()


def test_a_stopped_training_goes_on_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train_small(str(tmp_path / "whole.pt"), steps=7)[0]
    calls = []

    def stop(checkpoint: Path, model: Model) -> None:
        write_model(checkpoint, model)
        calls.append(checkpoint)
        raise KeyboardInterrupt

    monkeypatch.setattr("densify.learning.training.write_model", stop)
    with pytest.raises(KeyboardInterrupt):
        train_small(str(tmp_path / "stopped.pt"), steps=7)
    monkeypatch.undo()
    assert len(losses_of(calls[0])) == 5
    resumed = train_small(str(tmp_path / "stopped.pt"), resume=True, steps=7)[0]
    assert resumed.read_bytes() == whole.read_bytes()


def test_resuming_another_training_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "m.pt"
    with pytest.raises(InputError, match=r"--resume: no .*m\.pt\.checkpoint; leave --resume out"):
        train_small(str(out), resume=True, steps=7)
    made = Training(("streets",), "truth", steps=7).identity()
    write_model(tmp_path / "m.pt.checkpoint", Model("voxels", build("voxels"), made))
    with pytest.raises(InputError, match="was begun with teacher truth, got cycle"):
        train_small(str(out), resume=True, steps=7, teacher="cycle")
    with pytest.raises(InputError, match="no checkpoint, or damaged"):
        train_small(str(out), resume=True, steps=7)


def test_training_goes_on_from_a_model(tmp_path: Path) -> None:
    first = train_small(str(tmp_path / "first"), steps=2)[0]
    tuned = train_small(str(tmp_path / "tuned"), steps=1, start=first, teacher="objective")[0]
    near = [p.detach().numpy() for p in read_model(first).network.parameters()]
    far = [p.detach().numpy() for p in read_model(tuned).network.parameters()]
    assert max(np.abs(a - b).max() for a, b in zip(near, far, strict=True)) < 0.01
    with pytest.raises(InputError, match="a network voxels, expected flownet3d"):
        train_small(str(tmp_path / "x"), steps=1, start=first, model="flownet3d")


def test_a_loss_that_is_no_number_stops_it(tmp_path: Path, monkeypatch) -> None:
    def nothing(predict, sample) -> torch.Tensor:
        return torch.tensor(float("nan"), requires_grad=True)

    from densify.learning import training
    from densify.learning.losses import Teacher

    monkeypatch.setattr(training, "teacher", lambda name: Teacher(nothing, ""))
    with pytest.raises(ComputationError, match="the loss of step 0 is nan"):
        train_small(str(tmp_path / "m.pt"), steps=3)
    assert not list(tmp_path.iterdir())


def test_samples_follow_from_their_number() -> None:
    maker = SmallClips(("streets",), 3, "truth")
    stream = samples(maker, 3, 0)
    all_of_them = [next(stream) for _ in range(200)]  # more than one group of clips
    late = next(samples(maker, 3, 0, first=195))
    for one, other in zip(late.sweeps, all_of_them[195].sweeps, strict=True):
        assert (one is None) == (other is None)
        assert one is None or torch.equal(one.points, other.points)
    assert len({tuple(s.sweeps[0].points[0].tolist()) for s in all_of_them}) == 200


def test_a_change_moves_points_and_flow_alike() -> None:
    """Turned, mirrored and scaled, a point plus its flow is where it was seen next."""
    small = clip(0)
    rng = np.random.default_rng(2)
    for source, target in ((1, 2), (2, 1)):
        plain = sample_of(small, source, target, 2, "truth")
        changed = sample_of(small, source, target, 2, "truth", rng)
        a, b = plain.sweeps[0].points, changed.sweeps[0].points
        change, *_ = np.linalg.lstsq(a.numpy(), b.numpy(), rcond=None)
        np.testing.assert_allclose(plain.flow.numpy() @ change, changed.flow.numpy(), atol=1e-4)
        there = plain.sweeps[1].points.numpy() @ change
        np.testing.assert_allclose(there, changed.sweeps[1].points.numpy(), atol=1e-3)
        sign = 1 if target > source else -1
        assert plain.flow[plain.moving][:, 0].numpy() == pytest.approx(sign, abs=1e-6)
        assert plain.duration_s == pytest.approx(0.1)


def test_many_points_are_drawn_once_each() -> None:
    sample = sample_of(clip(0, num_points=NUM_DRAWN), 1, 2, 2, "")
    assert len(sample.drawn) == NUM_DRAWN == len(set(sample.drawn.tolist()))
    assert torch.equal(sample.drawn_source.points, sample.sweeps[0].points[sample.drawn])


class TestModelFiles:
    def test_a_model_comes_back(self, tmp_path: Path) -> None:
        model = Model("flownet3d", build("flownet3d", 3), {"teacher": "truth"})
        for name in ("a.pt", "b"):
            write_model(tmp_path / name, model)
        assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b").read_bytes()
        found = read_model(tmp_path / "b")
        assert found.name == "flownet3d" and found.made == {"teacher": "truth"}
        for name, tensor in model.network.state_dict().items():
            assert torch.equal(tensor, found.network.state_dict()[name])

    @pytest.mark.parametrize(
        "change, told",
        [
            ({"version": 2}, "a model of version 2, expected 1; train again, or use the densify"),
            ({"format": "other"}, "no model that densify train flow wrote"),
            ({"network": "resnet"}, "a network 'resnet', expected one of voxels, flownet3d"),
            ({"made": 3}, "no model that densify train flow wrote"),
        ],
        ids=str,
    )
    def test_another_header_is_refused(self, tmp_path: Path, change, told: str) -> None:
        path = tmp_path / "m.pt"
        write_model(path, Model("voxels", build("voxels")))
        with np.load(path) as file:
            arrays = dict(file)
        header = {**json.loads(bytes(arrays["header"])), **change}
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        with path.open("wb") as out:
            np.savez(out, **arrays)
        with pytest.raises(InputError, match=told):
            read_model(path)

    def test_other_weights_are_refused(self, tmp_path: Path) -> None:
        path, name = tmp_path / "m.pt", "weights/decode.4.bias"
        write_model(path, Model("voxels", build("voxels")))
        with np.load(path) as file:
            arrays = dict(file)
        told = {
            "got nothing, expected float32 of shape": None,
            r"got float32 of shape \(4,\)": np.zeros(4, np.float32),
            "got float64": np.zeros(3),
            "not all finite": np.full(3, np.nan, np.float32),
        }
        for message, array in told.items():
            changed = {k: v for k, v in arrays.items() if k != name}
            if array is not None:
                changed[name] = array
            with path.open("wb") as out:
                np.savez(out, **changed)
            with pytest.raises(InputError, match=message):
                read_model(path)

    def test_what_is_no_model_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "m.pt"
        with pytest.raises(InputError, match="no such file; expected a model"):
            read_model(path)
        torch.save({"weights": torch.zeros(3)}, path)  # a pickle in an archive
        with pytest.raises(InputError, match="no model that densify train flow wrote"):
            read_model(path)
        write_model(path, Model("voxels", build("voxels")))
        path.write_bytes(path.read_bytes()[:-1000])
        with pytest.raises(InputError, match=r"not a readable \.npz file"):
            read_model(path)


class TestCommand:
    def test_a_street_is_trained_on(self, tmp_path: Path, capsys, monkeypatch) -> None:
        """Whole: a recording is registered, labelled by our engine, learnt from; then refused."""
        monkeypatch.setattr("densify.learning.samples._NUM_MIXED", 1)  # clips made ahead
        out = tmp_path / "m.pt"
        command = ["train", "flow", "--data", "street?seed=31&sensor=vlp16", "--out", str(out)]
        command += ["--teacher", "engine", "--steps", "2", "--workers", "1"]
        command += ["--keep", str(tmp_path / "clips")]
        assert main(command) == 0
        told = capsys.readouterr().out.splitlines()
        assert told[0].startswith("2 steps, loss") and told[1:] == [str(out), f"{out}.png"]
        assert read_model(out).made["teacher"] == "engine"
        clips = ClipMaker(("street?seed=31&sensor=vlp16",), 0, "engine", tmp_path / "clips")
        moving = [s for n in range(2) for s in clips(n).sweeps if s.engine.moving.any()]
        assert moving, "no clip with movers says nothing"
        for sweep in moving:
            own = sweep.engine.moving & sweep.truth.moving
            error_m = np.linalg.norm(sweep.engine.flow - sweep.truth.flow, axis=2)[:, own]
            assert np.median(error_m) < 0.1
        assert main(command) == 2
        assert "there already, kept; give --overwrite" in capsys.readouterr().err

    @pytest.mark.parametrize(
        "options, told",
        [
            (["--steps", "0"], "--steps 0: expected 1 or more"),
            (["--steps", "1", "--data", "nowhere"], "nowhere"),
            (["--steps", "1", "--data", "streets?seed=3"], "seeds are drawn"),
            (["--steps", "1", "--resume"], "checkpoint; leave --resume out"),
            (["--steps", "1", "--start", "missing.pt"], "missing.pt: no such file"),
        ],
        ids=str,
    )
    def test_bad_input_is_one_line(self, tmp_path: Path, capsys, options, told: str) -> None:
        out = str(tmp_path / "m.pt")
        assert main(["train", "flow", "--out", out, "--workers", "0", *options]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and told in lines[0]
        assert not list(tmp_path.iterdir())

    @pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
    def test_cuda_that_is_absent_is_said(self, tmp_path: Path, capsys) -> None:
        command = ["train", "flow", "--out", str(tmp_path / "m.pt"), "--steps", "1"]
        assert main([*command, "--device", "cuda"]) == 2
        assert "torch finds no CUDA device here; use --device cpu" in capsys.readouterr().err

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    def test_cuda_trains(self, tmp_path: Path) -> None:
        path = train_small(str(tmp_path / "m.pt"), steps=3, device="cuda")[0]
        assert read_model(path).made["steps"] == 3


def test_settings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--steps, --minutes: expected one of them"):
        train(Training(("streets",)), tmp_path / "m.pt")
    with pytest.raises(InputError, match="--device gpu: expected auto, cpu or cuda"):
        chosen_device("gpu")


def test_a_recording_without_truth_cannot_be_the_teacher(tmp_path: Path, monkeypatch) -> None:
    class Plain:
        truth, frames, name = None, range(20), "plain"

    monkeypatch.setattr("densify.learning.clips.open_sequence", lambda spec: Plain())
    with pytest.raises(InputError, match=r"--data x: no truth of what moves; choose another"):
        ClipMaker(("x",), 0, "truth")(0)
    monkeypatch.setattr(Plain, "frames", range(3))
    with pytest.raises(InputError, match="--data x: 3 sweeps, expected 7 or more"):
        ClipMaker(("x",), 0)(0)
