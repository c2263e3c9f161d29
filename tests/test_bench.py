# SPDX-License-Identifier: MIT
"""The benches of depth and flow: counts against independent ones, flow where the truth is known,
and the commands."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from densify.bench import flow as flow_bench
from densify.bench.depth import bench_depth
from densify.bench.flow import bench_flow
from densify.bench.gate import ip_basic
from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from densify.readers import open_sequence
from tests.command import exit_code, refused
from tests.scenes import Arc, Scanner, Scene, TinySequence, World, by_flow, car, street
from tests.small_street import KEY, one_car

CONFIG = resolve(
    {
        "register": {"source": "dataset"},
        "flow": {"look_around_s": 0.0},
        "objective": {"num_neighbors": 10},
    }
)
RESULTS = Path(__file__).parents[1] / "docs" / "flow-results.md"


class TwoScanners(TinySequence):
    """Every second column of each sweep is another scanner's, which measures ``off_m`` too far."""

    off_m = 0.0

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        azimuth_deg = np.rad2deg(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
        other = (np.floor(azimuth_deg) % 4 == 0).astype(np.uint8)
        away = sweep.points / np.linalg.norm(sweep.points, axis=1, keepdims=True)
        return replace(sweep, lidar=other, points=sweep.points + self.off_m * away * other[:, None])


def test_depth_counts_are_those_of_an_image_of_truth():
    sequence = one_car()
    bare = resolve({"register": {"source": "dataset"}}, ["project.visibility=false"])
    found = bench_depth(sequence, [KEY], 2, {"usual": CONFIG, "bare": bare})["variants"]
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
    assert found["bare"]["density"]["measured"] != found["usual"]["density"]["measured"]


def test_the_scanner_held_out_is_the_truth_and_not_in_the_maps():
    sequence = TwoScanners(one_car().scene, range(7))
    sequence.off_m = 2.5
    found = bench_depth(sequence, [KEY], 2, {"usual": CONFIG}, scanner=1)["variants"]["usual"]
    score = found["scores"]["scanner"]["filled"]["all"]
    assert score["num_pixels"] > 500 and score["coverage"] > 0.5
    assert score["outliers"] > 0.7
    assert found["scores"]["truth"]["measured"]["all"]["outliers"] < 0.02


def tiny() -> TinySequence:
    movers = (car(6, 1.8, 9, 1), car(25, 1.8, 8, 2, yaw=np.pi))
    world = World((*street(40.0), *movers))
    return TinySequence(Scene(world, Arc(0, -1.5, 0, 5.0), Scanner(32, 450)), range(8))


def test_methods_of_flow_do_what_they_are_for():
    measured = bench_flow(tiny(), 4, 2, CONFIG, ("rigid", "paper", "ours"))
    rows = measured["methods"]
    assert tuple(rows) == ("ours", "paper", "rigid")  # in the table's order
    assert measured["frames"] == [2, 3, 4, 5, 6] and measured["num_pairs"] == 4
    json.dumps(measured, allow_nan=False)
    step, hops = rows["rigid"]["step"], rows["rigid"]["window"]["movers_m_by_hops"]
    assert step["movers_m"] == pytest.approx(0.85, abs=0.05)  # 9 and 8 m/s for 0.1 s
    assert step["found"] == step["falsely_moving"] == 0 and step["found_movers_m"] is None
    assert hops["2"] == pytest.approx(2 * hops["1"], rel=0.02)
    ours, paper = rows["ours"], rows["paper"]["step"]
    assert ours["step"]["movers_m"] < 0.5 * step["movers_m"]
    assert ours["step"]["background_m"] == 0 < ours["seconds_per_pair"]
    assert paper["movers_m"] < step["movers_m"] and paper["background_m"] > 0  # all points move
    for n, error_m in ours["window"]["found_movers_m_by_hops"].items():
        assert error_m <= ours["window"]["movers_m_by_hops"][n] + 1e-9


def sampled(depth_m: np.ndarray) -> np.ndarray:
    """One pixel in sixteen."""
    sparse_m = np.zeros_like(depth_m)
    sparse_m[2::4, 2::4] = depth_m[2::4, 2::4]
    return sparse_m


def test_ip_basic_fills_a_wall_not_a_large_hole_and_smears_silhouettes_little():
    wall_m = np.full((80, 200), 20.0, np.float32)
    wall_m[:, 80:] = 0
    filled_m = ip_basic(sampled(wall_m))
    np.testing.assert_allclose(filled_m[8:-8, 8:76], 20.0, atol=1e-4)
    assert not filled_m[:, 110:].any()
    scene_m = np.full((80, 200), 40.0, np.float32)
    scene_m[:, 100:] = 10.0
    filled_m = ip_basic(sampled(scene_m))
    assert filled_m.min() > 9.9 and (filled_m[8:-8, 8:90] > 39.9).all()
    assert (filled_m[8:-8, 103:190] < 10.1).all()


@pytest.mark.parametrize(
    ("measure", "words"),
    [
        (lambda: bench_flow(tiny(), 4, 1, CONFIG, ("ours", "magic")), "methods: got magic"),
        (lambda: bench_flow(tiny(), 4, 1, CONFIG, ()), "methods: got none"),
        (lambda: bench_flow(tiny(), 4, 0, CONFIG), "no pair to score"),
        (lambda: bench_depth(one_car(), [KEY], 2, {"": CONFIG}, scanner=3), "--scanner 3: .* 3"),
        (lambda: bench_depth(one_car(), [KEY], 2, {"": CONFIG}, method="best"), "method best"),
    ],
)
def test_bad_input_is_named(measure, words):
    with pytest.raises(InputError, match=words):
        measure()


def test_the_commands_print_tables_or_numbers(border_drive, capsys):
    given = [border_drive, "--window", "1", "--key", "40", "--set", "register.source=dataset"]
    given += ["--set", "accumulate.far_m=0"]
    assert exit_code("bench", "flow", *given, "--methods", "rigid", "--json") == 0
    assert list(json.loads(capsys.readouterr().out)["runs"][0]["methods"]) == ["rigid"]
    variant = ["--variant", "bare", "project.visibility=false"]
    assert exit_code("bench", "depth", *given, *variant) == 0
    text = capsys.readouterr().out
    assert "scores key held out filled all coverage" in text
    assert text.splitlines()[1].split() == ["as", "configured", "bare"]
    assert "did you mean flow?" in refused(capsys, 2, "bench", "readme", "flows")


def test_rows_of_the_readme(capsys, monkeypatch):
    for name, table in flow_bench.TABLES.items():
        assert f"densify bench readme {name}" in RESULTS.read_text("utf-8")
        assert all(street.key in open_sequence(street.data).frames for street in table.scenes)
    chosen = {
        name: flow_bench.TABLES[name]._replace(scenes=(flow_bench.KeySweep("car", KEY, window=1),))
        for name in ("flow", "registration")
    }
    monkeypatch.setattr(flow_bench, "TABLES", chosen)
    monkeypatch.setattr(flow_bench, "open_sequence", lambda _: one_car())
    monkeypatch.setattr(flow_bench, "resolve", lambda *_: CONFIG)
    assert main(["bench", "readme"]) == 0
    flow, _, registration = capsys.readouterr().out.partition(chosen["registration"].about)
    titles, rule, row = (line for line in flow.splitlines() if line.startswith("|"))
    assert rule.count("---") == titles.count("|") - 1
    errors = r"(\d\.\d cm \(\d\.\d cm\) \| ){2}"
    cells = rf"\| `car`, key \d \| 100\.0 % \| {errors}0\.0000 % \| \d\.\d\d % \|"
    assert re.fullmatch(cells, row), row
    assert "| 0 mm | 0.000° |" in registration
