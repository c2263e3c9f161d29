# SPDX-License-Identifier: MIT
"""The network that completes depth: what it learns, repeats and refuses, and its benchmark."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from densify.bench import training
from densify.bench.training import Plan, bench_training, mean_and_error
from densify.cli import main
from densify.config.errors import InputError
from densify.learning.completion import Completion, Sample, predict, train
from densify.scores.metrics import depth_errors

FOCAL_PX = 100.0
H, W = 48, 96


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A bright box in front of a dark wall: image (3,H,W), true depth, one return in sixteen."""
    rng = np.random.default_rng(seed)
    left, top = rng.integers(10, 50), rng.integers(5, 20)
    true_m = np.full((H, W), 20.0, np.float32)
    true_m[top : top + 24, left : left + 36] = 8.0
    image = np.repeat((true_m < 10)[None].astype(np.float32), 3, 0)
    sparse_m = np.where(rng.random((H, W)) < 1 / 16, true_m, np.float32(0))
    return image, true_m, sparse_m


def outliers(network: Completion) -> float:
    shares = []
    for seed in (100, 101, 102):
        image, true_m, sparse_m = scene(seed)
        depth_m = predict(network, Sample.of(image, sparse_m, focal_px=FOCAL_PX))
        assert depth_m.shape == (H, W) and (depth_m > 0).all()
        error_m = np.abs(depth_m - true_m)
        shares.append(float(np.mean(error_m > 0.05 * true_m)))
    return float(np.mean(shares))


def trained(shift_px: int, steps: int = 200, by_weight: bool = False) -> Completion:
    """Train on the true depth, shifted to the right; weights leave out what the shift spoils."""
    samples = []
    for seed in range(8):
        image, true_m, sparse_m = scene(seed)
        target_m = np.roll(true_m, shift_px, axis=1)
        weight = (target_m == true_m).astype(np.float32) if by_weight else None
        samples.append(Sample.of(image, sparse_m, target_m, weight, focal_px=FOCAL_PX))
    return train(samples, steps, device="cpu")


def test_true_maps_train_better_than_shifted_ones_and_weights_mend_these() -> None:
    true, shifted = outliers(trained(0)), outliers(trained(8))
    assert true < 0.3 * outliers(Completion().eval())
    assert shifted > 2 * true
    assert outliers(trained(8, by_weight=True)) < 0.6 * shifted


def test_an_untrained_network_interpolates() -> None:
    plane_m = np.full((H, W), 12.0, np.float32)
    sparse_m = np.where(np.random.default_rng(0).random((H, W)) < 0.05, plane_m, np.float32(0))
    image = np.zeros((3, H, W), np.float32)
    for focal_px in (100.0, 1600.0):  # the second is reduced
        sample = Sample.of(image, sparse_m, focal_px=focal_px)
        depth_m = predict(Completion().eval(), sample)
        np.testing.assert_allclose(depth_m, plane_m, rtol=1e-3)


def test_training_repeats_byte_for_byte_and_seeds_differ() -> None:
    image, true_m, sparse_m = scene(0)
    for target_m in (true_m, None):  # None holds out returns
        sample = Sample.of(image, sparse_m, target_m, focal_px=FOCAL_PX)
        first, again, other = (
            predict(train([sample], 3, seed, device="cpu"), sample) for seed in (0, 0, 1)
        )
        assert first.tobytes() == again.tobytes() != other.tobytes()


@pytest.mark.parametrize("size, steps", [("small", s) for s in (1, 2, 10, 11)] + [("large", 1)])
def test_any_number_of_steps_trains(size: str, steps: int) -> None:
    image, true_m, sparse_m = scene(0)
    sample = Sample.of(image, sparse_m, true_m, focal_px=FOCAL_PX)
    assert np.isfinite(predict(train([sample], steps, size=size, device="cpu"), sample)).all()


def test_the_image_alone_is_used_without_returns() -> None:
    image, true_m, sparse_m = scene(0)
    network = train(
        [Sample.of(image, sparse_m, true_m, focal_px=FOCAL_PX)], 2, with_returns=False, device="cpu"
    )
    with_sweep, without = (
        predict(network, Sample.of(image, depth_m, focal_px=FOCAL_PX))
        for depth_m in (sparse_m, 0 * sparse_m)
    )
    assert with_sweep.tobytes() == without.tobytes()


def test_the_scale_invariant_error_of_analytic_maps() -> None:
    true_m = np.full((2, 8), 10.0, np.float32)
    assert depth_errors(3 * true_m, true_m, focal_px=700.0).silog == pytest.approx(0, abs=1e-6)
    half_m = true_m * np.array([[2.0], [1.0]], np.float32)
    expected = 0.5 * np.log(2)  # the standard deviation of ln 2 and 0
    assert depth_errors(half_m, true_m, focal_px=700.0).silog == pytest.approx(expected, rel=1e-6)


def test_means_and_their_standard_errors() -> None:
    assert mean_and_error([]) == (None, None)
    assert mean_and_error([2.0]) == (2.0, None)
    assert mean_and_error([1.0, 2.0, 3.0]) == pytest.approx((2.0, 1 / 3**0.5))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """One key of a sparse street to train on, another one to test on."""
    part = training.Part("street?sensor=vlp16", range(119, 122))
    monkeypatch.setattr(training, "SETS", {"streets": (part,)})
    key = training.GateKey("street?sensor=vlp16", 123)
    monkeypatch.setattr(training, "TESTS", {"street, exact": (key,)})
    monkeypatch.setattr(training, "_WINDOW", 1)


def command(plan: Plan) -> list[str]:
    """The options of a plan on the CPU."""
    numbers = ["--seeds", str(plan.seeds), "--steps", str(plan.steps)]
    return ["--maps", ",".join(plan.targets), *numbers, "--device", "cpu"]


def test_an_interrupted_benchmark_continues_to_the_same_bytes(
    small, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.delenv("DENSIFY_TEST_DATA", raising=False)
    maps = ("rigid (ICP)", "densify filled by confidence")
    plan = Plan(("streets",), maps, seeds=2, steps=2, device="cpu")

    def stop(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("train", 5):  # in the third of four networks
            raise KeyboardInterrupt

    folder, other = tmp_path / "cut", tmp_path / "whole"
    with pytest.raises(KeyboardInterrupt):
        bench_training(None, folder, plan, stop)
    assert len(json.loads((folder / "training.json").read_text())["rows"]) == 3
    table = bench_training(None, folder, plan)
    (folder / "maps").rename(other.with_name("maps"))
    other.mkdir()
    other.with_name("maps").rename(other / "maps")
    assert bench_training(None, other, plan) == table
    names = ("cut", "whole")
    first, second = ((tmp_path / name / "training.json").read_bytes() for name in names)
    assert first == second
    of_seeds = table["streets"]["rigid (ICP)"]
    assert len(of_seeds) == 2 and of_seeds[0] != of_seeds[1]
    assert 0 < of_seeds[0]["street, exact"]["moving"]["outliers"] < 1
    assert main(["bench", "training", *command(plan), "--out", str(folder)]) == 0
    (row,) = re.findall(r"streets +rigid \(ICP\) +(.*)", capsys.readouterr().out)
    assert row.count("±") == 7
    with pytest.raises(InputError, match="with steps 2, asked for 3"):
        bench_training(None, folder, plan._replace(steps=3))
    with pytest.raises(InputError, match="got 'rigid'"):
        bench_training(None, folder, plan._replace(targets=("rigid",)))
