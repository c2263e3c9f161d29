# SPDX-License-Identifier: MIT
"""The depth benchmark: counts against an independent count, another scanner as truth, the table."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from densify.bench.depth import bench_depth
from densify.cli import bench_tables as tables
from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from tests.scenes import TinySequence, by_flow
from tests.small_street import KEY, one_car

CONFIG = resolve({"register": {"source": "dataset"}})


class TwoScanners(TinySequence):
    """Every second column of each sweep is another scanner's, which measures ``off_m`` too far."""

    off_m = 0.0

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        azimuth_deg = np.rad2deg(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
        other = (np.floor(azimuth_deg) % 4 == 0).astype(np.uint8)
        away = sweep.points / np.linalg.norm(sweep.points, axis=1, keepdims=True)
        return replace(sweep, lidar=other, points=sweep.points + self.off_m * away * other[:, None])


def test_counts_are_those_of_an_image_of_truth():
    sequence = one_car()
    sparse = resolve({"register": {"source": "dataset"}}, ["project.fill_reach=0.3"])
    found = bench_depth(sequence, [KEY], 2, {"usual": CONFIG, "sparse": sparse})["variants"]
    made = by_flow(sequence, KEY, 2, config=CONFIG)
    camera = sequence.cameras["front"]
    true_m = sequence.truth.depth_m("front", KEY)
    # Straight ahead of a level scanner the top ring is a curve of constant elevation.
    v, u = np.indices(true_m.shape)
    right, down = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
    forward = true_m + 0.2
    rise = -(down * true_m + 0.1) / np.hypot(right * true_m, forward)
    points = sequence[KEY].points
    top = np.quantile(points[:, 2] / np.linalg.norm(points[:, :2], axis=1), 0.999)
    known = (true_m > 0) & (rise <= top)
    for product, depth_m in (
        ("measured", made.depth["front"].depth_m),
        ("filled", made.depth["front"].filled_m),
    ):
        score = found["usual"]["scores"]["truth"][product]["all"]
        assert score["num_pixels"] == pytest.approx(known.sum(), rel=0.02)
        both = known & (depth_m > 0)
        assert score["coverage"] == pytest.approx(both.sum() / known.sum(), abs=0.01)
        disparity_px, true_px = (0.54 * 150 / d[both] for d in (depth_m, true_m))
        off_px = np.abs(disparity_px - true_px)
        wrong = (off_px > 3) & (off_px > 0.05 * true_px)
        assert score["outliers"] == pytest.approx(wrong.mean(), abs=0.002)
        assert found["usual"]["density"][product] == np.mean(depth_m > 0)
    assert found["sparse"]["density"]["filled"] < found["usual"]["density"]["filled"]


@pytest.mark.parametrize(("off_m", "wrong"), [(0.0, (0, 0.02)), (2.5, (0.7, 1))])
def test_the_scanner_held_out_is_the_truth_and_not_in_the_maps(off_m, wrong):
    sequence = TwoScanners(one_car().scene, range(7))
    sequence.off_m = off_m
    found = bench_depth(sequence, [KEY], 2, {"usual": CONFIG}, scanner=1)["variants"]["usual"]
    score = found["scores"]["scanner"]["filled"]["all"]
    assert score["num_pixels"] > 500 and score["coverage"] > 0.5
    assert wrong[0] <= score["outliers"] <= wrong[1]
    assert found["scores"]["truth"]["measured"]["all"]["outliers"] < 0.02


def test_bad_input():
    with pytest.raises(InputError, match=r"--scanner 3: .* sweep 3"):
        bench_depth(one_car(), [KEY], 2, {"usual": CONFIG}, scanner=3)
    with pytest.raises(InputError, match="--method best: expected one of none, icp"):
        bench_depth(one_car(), [KEY], 2, {"usual": CONFIG}, method="best")


def test_table_has_a_row_per_variant(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "depth.json"
    spec = "street:static?sensor=vlp16&cameras=fast"
    arguments = ["--window", "1", "--camera", "fast", "--key", "40", "--out", str(out)]
    variant = ["--variant", "bare", "project.visibility=false"]
    chosen = ["--config", "fast", *variant]
    assert main(["bench", "depth", "--data", spec, *arguments, *chosen]) == 0
    shown = capsys.readouterr().out
    assert "keys 40, against truth" in shown and "keys 40, against key held out" in shown
    numbers = json.loads(out.read_text())
    assert list(numbers["variants"]) == ["as configured", "bare"]
    assert tables.depth_table(numbers).strip() in shown
    scores = {
        name: v["scores"]["truth"]["measured"]["all"] for name, v in numbers["variants"].items()
    }
    assert scores["bare"]["outliers"] > 2 * scores["as configured"]["outliers"]  # shines through
