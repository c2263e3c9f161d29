# SPDX-License-Identifier: MIT
"""The examples and the notebook run as they are, and what they print is plausible."""

from __future__ import annotations

import ast
import json
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import densify
from densify.readers.street import Street
from tests.writers import write_street

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOK = EXAMPLES / "your_data.ipynb"


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
    recipe = densify.Recipe(window=1, cameras=("image_02",))
    densify.make_dataset(["street?sensor=vlp16"], tmp_path / "set", slice(119, 121), recipe)
    text = output_of("train_completion.py", *2 * [str(tmp_path / "set")], "2")
    untrained, trained = (float(share) for share in re.findall(r"([\d.]+)%", text))
    assert 0 < untrained < 50 and 0 < trained < 50 and untrained != trained


def test_the_weights_of_confidence_are_found_again(monkeypatch) -> None:
    """Outliers are drawn from known odds, with weights of the other recordings for each."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import fit_confidence as example

    known = np.array([-4.0, 1.5, 0.4, 1.0, 0.8, 0.5, 0.7, 0.6, 0.3, 0.9])

    def drawn(seed: int) -> example.Evidence:
        rng = np.random.default_rng(seed)
        rejected = rng.random(40_000) < 0.2
        usual = rng.uniform(0, 1.5, (40_000, 8))
        features = np.column_stack([np.ones(40_000), usual, rejected])
        outlier = rng.random(len(features)) < 1 / (1 + np.exp(-features @ known))
        return example.Evidence(str(seed), str(seed % 3), features, outlier, outlier, outlier)

    maps = [drawn(seed) for seed in range(6)]
    np.testing.assert_allclose(example.fit(maps), known, atol=0.25)
    assert [*example.left_out(maps)] == ["0", "1", "2"]
    assert example.area(maps[0].features @ known, maps[0].outlier) > 0.65


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


def run_cells() -> list[Any]:
    """Return the value of the last expression of each cell of code, as the notebook shows it."""
    names: dict[str, Any] = {}
    shown = []
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            lines = ast.parse("".join(cell["source"])).body
            last = lines.pop() if isinstance(lines[-1], ast.Expr) else None
            exec(compile(ast.Module(lines, []), NOTEBOOK.name, "exec"), names)
            if isinstance(last, ast.Expr):
                code = compile(ast.Expression(last.value), NOTEBOOK.name, "eval")
                shown.append(eval(code, names))
    return shown


def test_your_data(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.delenv("DENSIFY_DATA", raising=False)
    monkeypatch.delenv("DENSIFY_KEY", raising=False)
    monkeypatch.chdir(tmp_path)
    shown, text = run_cells(), capsys.readouterr().out
    (picture,) = (np.asarray(value) for value in shown if isinstance(value, Image.Image))
    assert picture.shape[0] > 200 and picture.std() > 20
    assert "fine" in text and "frames 116 to 120" in text
    ghosts, alone = map(float, re.findall(r"ghosts: ([\d.]+)%, .* ([\d.]+)%", text)[0])
    assert ghosts < alone
    assert np.load("depth.npy").shape == (375, 1242)
    assert len(np.load("cloud.npy")) > 100_000
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    stored = [output for cell in cells for output in cell.get("outputs", ())]
    assert sum("image/png" in output.get("data", {}) for output in stored) == 1
