# SPDX-License-Identifier: MIT
"""The gate: no figure of four keys becomes worse beyond its luck, and verdicts are right.

``densify bench gate`` judges all keys. To accept new figures: ``--write tests/gate.json``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from densify.bench import gate
from densify.bench.verdicts import beyond_luck, coverage, curve, outliers_at, verdicts
from densify.config import resolve
from densify.pipeline.recording import Recording
from densify.pipeline.run import densify as densify_key
from densify.readers import open_sequence
from tests.command import refused

STORED = Path(__file__).with_name("gate.json")
DRIVE = "kitti/2011_09_26/2011_09_26_drive_0013_sync"
KEYS = ("0013@10", "0013@120", "street:crossing?seed=302@60", "street?seed=307&sensor=vlp16@60")
SIGMAS = 4.0


@pytest.mark.parametrize("name", KEYS)
def test_no_figure_becomes_worse_beyond_its_luck(name: str) -> None:
    folder = os.environ.get("DENSIFY_TEST_DATA")
    if not name.startswith("street") and not folder:
        pytest.skip("DENSIFY_TEST_DATA is not set: no real recording")
    stored = gate.read(STORED)
    now = gate.measure(Path(folder) if folder else None, names=[name])
    luck = stored.luck[name]
    assert not beyond_luck(stored.figures[name], now.figures[name], luck, SIGMAS)


def test_the_luck_of_every_key_is_known() -> None:
    stored = gate.read(STORED)
    assert set(KEYS) <= set(stored.figures) <= {key.name for key in (*gate.KEYS, *gate.PAIRS)}
    assert set(stored.luck) == {key.name for key in gate.KEYS}
    assert all(min(luck.values()) >= 0 and max(luck.values()) > 0 for luck in stored.luck.values())


def test_a_curve_leaves_out_the_least_certain_pixels() -> None:
    confidence = np.linspace(1, 0, 1000)
    whole = curve(2000, confidence, confidence < 0.1)
    assert coverage(whole) == 50.0 and outliers_at(whole, 50.0) == pytest.approx(10.0)
    assert outliers_at(whole, 45.0) == pytest.approx(0.0, abs=0.02)
    assert outliers_at(whole, 47.5) == pytest.approx(100 * 50 / 950, rel=0.01)
    equal = curve(2000, np.full(1000, 0.5), confidence < 0.1)
    assert outliers_at(equal, 25.0) == pytest.approx(10.0)


def test_maps_are_compared_at_equal_coverage() -> None:
    """A map with more pixels, all wrong and known to be uncertain, is no worse."""
    rng = np.random.default_rng(0)
    confidence, wrong = rng.uniform(0.5, 1, 1000), rng.random(1000) < 0.02
    before = {"key": {"all": curve(2000, confidence, wrong)}}
    confidence = np.append(confidence, np.full(250, 0.1))
    now = {"key": {"all": curve(2000, confidence, np.append(wrong, np.ones(250, bool)))}}
    luck = {"key": {"all outliers": 0.05, "all coverage": 0.1}}
    (outliers, covered) = verdicts(before, now, luck)
    assert outliers.change == pytest.approx(0, abs=1e-6) and outliers.word == "no difference"
    assert covered.change == pytest.approx(12.5) and covered.word == "better"


def test_a_verdict_needs_more_than_luck_and_more_than_the_spread_of_keys() -> None:
    def word(changes: list[float], sigma: float) -> str:
        before = {str(k): {"error m": 1.0} for k in range(len(changes))}
        now = {str(k): {"error m": 1.0 + change} for k, change in enumerate(changes)}
        luck = {key: {"error m": sigma} for key in before}
        (verdict,) = verdicts(before, now, luck)
        return verdict.word

    assert word([0.1], 0.05) == "no difference"  # both measurements have luck
    assert word([0.2], 0.05) == "worse" and word([-0.2], 0.05) == "better"
    assert word([0.1, 0.1, 0.1, 0.1], 0.05) == "worse"
    assert word([0.4, 0.0, 0.0, 0.0], 0.05) == "no difference"  # one key alone

    # Recall is better when larger.
    before, luck = {"flow recall %": 90.0}, {"flow recall %": 1.0}
    (verdict,) = verdicts({"a": before}, {"a": {"flow recall %": 80.0}}, {})
    assert verdict.word == "worse" and verdict.worst == ("a", -10.0)
    assert beyond_luck(before, {"flow recall %": 80.0}, luck, 4.0)
    assert not beyond_luck(before, {"flow recall %": 85.0}, luck, 4.0)


def test_repeated_draws_carry_their_own_luck() -> None:
    before, now = {"a": {"pair error m": [0.1, 0.3] * 4}}, {"a": {"pair error m": [0.25] * 8}}
    (verdict,) = verdicts(before, now, {})
    assert verdict.change == pytest.approx(0.05) and verdict.luck == pytest.approx(0.1 / 8**0.5)
    assert verdict.word == "no difference"


def test_stored_figures_come_back(tmp_path: Path) -> None:
    figures = {"a": {"all": curve(9, np.ones(2), np.array([True, False])), "pair": [0.5, 1.0]}}
    stored = gate.Stored(figures, {"a": {"x": 0.1}})
    gate.write(tmp_path / "gate.json", stored)
    assert gate.read(tmp_path / "gate.json") == stored


def test_the_command_refuses_what_it_does_not_know(tmp_path: Path, capsys) -> None:
    assert "--only scores" in refused(capsys, 2, "bench", "gate", "--only", "scores")
    (tmp_path / "other.json").write_text(json.dumps({"a": 1}))
    said = refused(capsys, 2, "bench", "gate", "--stored", tmp_path / "other.json")
    assert "other.json" in said and "--write" in said
    assert "no such key" in refused(capsys, 2, "bench", "gate", "--keys", "street@1")


def test_a_real_drive(test_data: Path) -> None:
    sequence = open_sequence(str(test_data / DRIVE))
    recording = Recording(sequence, resolve(None), 5, [120], looks_around=True)
    single, icp, flow = densify_key(recording, 120, ["none", "icp", "flow"], ["image_02"]).values()
    assert flow.frames == tuple(range(115, 126))
    assert flow.metrics["ghosts"]["all"] <= 0.5 * icp.metrics["ghosts"]["all"]
    assert flow.cloud.far.sum() > 100_000 and not icp.cloud.far.any()
    assert flow.cloud.frame.min() < 110 and flow.cloud.frame.max() > 130
    cloud = flow.cloud.select(~flow.cloud.far)
    assert cloud.moving.sum() > 1000
    still = ~cloud.moving
    assert cloud.points[still].tobytes() == cloud.rigid_points[still].tobytes()
    number_of = np.full((11, cloud.row.max() + 1), -1)
    number_of[icp.cloud.frame - 115, icp.cloud.row] = np.arange(len(icp.cloud))
    rigid = icp.cloud.points[number_of[cloud.frame - 115, cloud.row]]
    assert cloud.rigid_points.tobytes() == rigid.tobytes()
    dense, sparse = (result.metrics["density"]["image_02"]["measured"] for result in (flow, single))
    assert dense > 2 * sparse
