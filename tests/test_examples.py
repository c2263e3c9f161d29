# SPDX-License-Identifier: MIT
"""The examples run as they are, and what they print is plausible."""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.depth import confidence as scale
from densify.readers.street import Street
from tests.writers import write_street

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def output_of(tmp_path: Path, monkeypatch, capsys) -> Callable[..., str]:
    """Return a function that runs a script in an empty folder and returns what it prints."""

    def run(script: str, *arguments: str) -> str:
        path = str(EXAMPLES / script)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", [path, *arguments])
        runpy.run_path(path, run_name="__main__")
        return capsys.readouterr().out

    return run


def number_before(text: str, words: str) -> float:
    found = re.search(rf"([\d.,]+) ?%? {words}", text)
    assert found, text
    return float(found.group(1).replace(",", ""))


def test_street(output_of, tmp_path: Path) -> None:
    text = output_of("street.py", "depth.npy")
    depth_m = np.load(tmp_path / "depth.npy")
    assert depth_m.shape == (375, 1242) and depth_m.dtype == np.float32
    found = re.search(r"median error ([\d.]+) m", text)
    assert found and float(found.group(1)) < 0.1
    assert number_before(text, "points, ") > 300_000
    assert number_before(text, "of them on moving objects") > 0
    assert f"depth in {np.mean(depth_m > 0):.1%} of the pixels" in text


def test_kitti(output_of, short_drive: Path, tmp_path: Path) -> None:
    text = output_of("kitti.py", str(short_drive), "120")
    assert text.startswith("key 120: sweeps 118 to 122, ")
    assert number_before(text, "points\n") > 5 * 100_000
    assert number_before(text, "points moved") > 100
    assert not list(tmp_path.iterdir())


def test_kitti_stereo(output_of, tmp_path: Path) -> None:
    street = Street("street", 0, "vlp16")
    drive = write_street("kitti", street, tmp_path, range(119, 122), ["image_02"])
    true_m, path = street.truth.depth_m("image_02", 120), str(tmp_path / "{}.png")
    disparity = 256 * 0.532725 * street.cameras["image_02"].focal_px / np.maximum(true_m, 1)
    cv2.imwrite(path.format("true"), np.where(true_m > 0, disparity, 0).astype(np.uint16))
    moving = street.truth.moving_mask("image_02", 120)
    cv2.imwrite(path.format("objects"), moving.astype(np.uint8))
    text = output_of("kitti_stereo.py", str(drive), "120", *map(path.format, ("true", "objects")))
    rows = re.findall(r"(\w+, \w+, \w+) +outliers +([\d.]+)%, coverage ([\d.]+)", text)
    outliers = {name: float(percent) for name, percent, _ in rows}
    assert len(outliers) == 18
    assert outliers["flow, measured, moving"] < 0.2 * outliers["icp, measured, moving"]


def test_train_completion(output_of, tmp_path: Path) -> None:
    street = Street("street", 0, "vlp16")
    drive = str(write_street("kitti", street, tmp_path, range(118, 121), ["image_02"]))
    data = ["--data", drive, "--test", drive, "--keys", "119:120", "--test-keys", "119:120"]
    text = output_of("train_completion.py", *data, "--window", "1", "--steps", "2")
    rows = re.findall(r"^(nothing|icp, seed 0|flow, seed 0)  +(.*)$", text, re.MULTILINE)
    scores = {name: [float(number) for number in re.findall(r"[\d.]+", row)] for name, row in rows}
    assert len(scores) == 3, text
    for numbers in scores.values():
        assert len(numbers) == 9 and 0 < numbers[0] < numbers[1] < 30, text
    assert len(set(map(tuple, scores.values()))) == 3, "trained on nothing?"
    assert {p.name for p in (tmp_path / "completion").iterdir()} == {"icp", "flow", "test"}


def test_the_tables_of_confidence_are_found_again(monkeypatch) -> None:
    """Outliers are drawn from known tables: shares that fall with the rank, one for each group."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import fit_confidence as example

    at_zero = np.array([0.01, 0.1, 0.3] * 3)[:, None]
    known = at_zero * 10.0 ** (-1.2 * np.linspace(0, 1, scale.NUM_RANKS))

    def drawn(seed: int) -> example.Evidence:
        rng = np.random.default_rng(seed)
        shown = rng.poisson(800, known.shape)
        return example.Evidence({}, shown, shown, rng.binomial(shown, known))

    shares = example.fit([drawn(seed) for seed in range(4)])
    assert (np.diff(shares) <= 1e-12).all() and shares.min() >= 0
    off = np.log10(shares[..., 10:-10]) - np.log10(known[..., 10:-10])
    assert np.abs(off.mean(axis=1)).max() < 0.06
    written = {g: example.knots(row) for g, row in zip(scale.GROUPS, shares, strict=True)}
    np.testing.assert_allclose(scale.tables_of({"tables": written}), shares, rtol=2e-3, atol=1e-9)


def test_the_weights_of_tracks_are_found_again(monkeypatch) -> None:
    """Tracks are drawn from known odds; where a static one costs more, the price is higher."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import fit_tracks as example

    rng, num = np.random.default_rng(0), len(example.names())
    known = np.linspace(-2.0, 2.0, num)
    terms = rng.normal(1.0, 2.0, (40_000, num))
    moves = rng.random(len(terms)) < 1 / (1 + np.exp(0.7 - terms @ known))
    streets = [example.Tracks("", terms, moves, moves)]
    monkeypatch.setattr(example, "PRICE", 1.0)
    np.testing.assert_allclose(example.fit(streets), [*known, 0.7], atol=0.1)
    monkeypatch.setattr(example, "PRICE", 10.0)
    assert example.fit(streets)[-1] > 1.5
