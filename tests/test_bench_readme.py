# SPDX-License-Identifier: MIT
"""The tables of the documentation: their rows, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from densify.bench import images, readme, registration
from densify.cli import main
from densify.config import resolve
from densify.readers import open_sequence

RESULTS = Path(__file__).parents[1] / "docs" / "results.md"


def test_every_scene_is_a_street_that_opens():
    for table in readme.TABLES.values():
        for scene in table.scenes:
            sequence = open_sequence(scene.data)
            assert set(scene.keys) <= set(sequence.frames) and scene.camera in sequence.cameras


def test_a_row_is_what_its_bench_measures(capsys, monkeypatch):
    scene = readme.Scene("street:static?seed=5&sensor=vlp16", (30,), window=1)
    table = readme.TABLES["flow"]._replace(scenes=(scene,))
    monkeypatch.setattr(readme, "TABLES", {"flow": table, "none": table._replace(scenes=())})
    assert main(["bench", "readme", "flow", "none"]) == 0
    lines = capsys.readouterr().out.splitlines()
    about, _, titles, rule, row = lines[:5]
    assert lines[5:] == ["", about, "", titles, rule]
    assert about == table.about and rule.count("---") == titles.count("|") - 1
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    # Nothing moves on this street, and nothing is said to.
    assert cells[:5] == [
        "`street:static?seed=5&sensor=vlp16`, key 30",
        "– %",
        "– (–)",
        "– (–)",
        "0.0000 %",
    ]
    assert re.fullmatch(r"0\.\d\d %", cells[5]) and cells[6] == ""


def test_unknown_tables_are_refused_before_anything_is_measured(capsys):
    assert main(["bench", "readme", "flows"]) == 2
    said = capsys.readouterr().err
    assert (
        "flows" in said
        and "methods, depth, parts, flow, rings, registration, rates, segmentation, pairs, prior"
        in said
    )


def test_real_rows_come_with_their_folders(tmp_path):
    table = readme.TABLES["depth"]
    assert len(readme._scenes(table, tmp_path, None)) == len(table.scenes) + 1
    assert readme._scenes(table, None, tmp_path)[-1].scanner == 1
    assert readme._scenes(readme.TABLES["flow"], tmp_path, tmp_path) == readme._FLOW


def test_help_names_every_table(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "readme", "--help"])
    assert f"of {', '.join(readme.TABLES)} (default" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", readme.TABLES)
def test_the_results_name_the_command_of_each_table(name):
    assert f"densify bench readme {name}" in RESULTS.read_text("utf-8")


def test_wrong_images_are_measured_against_strict_maps(monkeypatch):
    wrong = {name: images.FAULTS[name] for name in ("right", "noise instead")}
    monkeypatch.setattr(images, "FAULTS", wrong)
    found = images.bench_images(
        open_sequence("street:static?seed=5&sensor=vlp16&cameras=fast"), 30, "fast", 1
    )
    assert [*found] == ["right", "noise instead", "the next frame's"]
    assert found["noise instead"] == [images.Compared(None, None)]
    right = found["right"][0]
    assert right.wrong is not None and 0 <= right.as_dense <= right.wrong
    ramp = np.tile(np.arange(20, dtype=np.uint8)[:, None, None], (1, 30, 3))
    shifted = images.moved(0, 2)(ramp)
    assert (shifted[2:] == ramp[:-2]).all() and (shifted[:2] == 0).all()


def test_poses_are_held_against_exact_ones(monkeypatch) -> None:
    street, settings = open_sequence("street:static?seed=5&sensor=vlp16"), resolve(None)
    given = resolve(None, ["register.source=dataset"])
    monkeypatch.setattr(registration, "resolve", lambda _: given)
    exact = registration.bench_registration(street, 30, 2)
    assert exact.rms_m < 1e-9 and exact.rms_deg < 1e-6
    monkeypatch.setattr(registration, "resolve", lambda _: settings)
    off = registration.bench_registration(street, 30, 2)
    assert 1e-4 < off.rms_m < 0.05 and 1e-4 < off.rms_deg < 0.2
