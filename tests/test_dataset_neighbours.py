# SPDX-License-Identifier: MIT
"""A key of a training set is judged beside its neighbours, and the command says so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.neighbours import worse_than_neighbours
from densify.dataset.plan import Recipe, plan, write_plan
from densify.dataset.report import write_report
from tests.command import exit_code
from tests.dataset_scenes import DRIVE, FRAMES


def drive_of(shares: list[float | None], name: str = DRIVE, **scores: Any) -> dict:
    """Records of a drive by ghost rate, with windows of five sweeps that the ends cut."""
    last = len(shares) - 1
    records = (
        KeyRecord(
            name,
            key,
            "done",
            frames=tuple(range(max(0, key - 2), min(last, key + 2) + 1)),
            scores={"ghost": share, **scores},
        )
        for key, share in enumerate(shares)
    )
    return {record.name: record for record in records}


def keys_in(records: dict) -> list[int]:
    return [key for _, key in worse_than_neighbours(records)]


def test_ends_stand_out() -> None:
    usual = [0.0003 + 0.0001 * (key % 3) for key in range(30)]
    assert keys_in(drive_of(usual)) == []
    assert keys_in(drive_of([0.006, 0.004, *usual, 0.003])) == [0, 1, 32]


def test_a_drive_that_is_worse_everywhere_does_not() -> None:
    """Nor does one that slowly becomes so, or one with next to no ghosts."""
    assert keys_in(drive_of([0.01] * 20) | drive_of([0.0001] * 20, "other")) == []
    assert keys_in(drive_of([0.001 * 1.15**key for key in range(30)])) == []
    assert keys_in(drive_of([0.0009, *[0.0] * 20])) == []


def test_outliers_count_by_the_worst_camera() -> None:
    records = drive_of([0.0] * 12, outliers={"a": 0.01, "b": None})
    bad = records[DRIVE, 4]
    records[bad.name] = replace(bad, scores={"ghost": 0, "outliers": {"a": 0.01, "b": 0.05}})
    ((name, text),) = worse_than_neighbours(records).items()
    assert name == (DRIVE, 4) and "held-out outliers of the neighbouring keys" in text
    assert "ghosts" not in text.partition(";")[0]


def test_what_is_not_known_is_not_judged() -> None:
    assert keys_in(drive_of([None] * 9)) == [] == keys_in({})
    assert keys_in(drive_of([0.5, 0.0])) == []
    records = drive_of([0.001, 0.001, 0.001, 0.5, 0.001])
    records[DRIVE, 3] = replace(records[DRIVE, 3], status="aside", reason="ghosts")
    assert keys_in(records) == []


def test_the_command_and_the_page_say_so(border_drive: Path, tmp_path: Path, capsys) -> None:
    write_plan(tmp_path, Recipe(), plan([str(border_drive)], None, Recipe()))
    records = [
        KeyRecord(DRIVE, key, "done", frames=(key,), scores={"ghost": 0.02 * (key == FRAMES[0])})
        for key in FRAMES
    ]
    (tmp_path / "manifest.jsonl").write_bytes(b"".join(record.to_line() for record in records))
    assert exit_code("dataset", "--status", tmp_path) == 0
    said = f"{DRIVE} key {FRAMES[0]}: more than 4 times the ghosts of the neighbouring keys"
    assert f"densify: warning: {said}" in capsys.readouterr().err
    assert exit_code("dataset", "--status", tmp_path, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert [(w["drive"], w["key"]) for w in answer["worse_than_neighbours"]] == [(DRIVE, FRAMES[0])]
    (page,) = write_report(tmp_path)
    assert page.read_text().count("times the ghosts of the neighbouring keys") == 1
    assert read_manifests(tmp_path)[DRIVE, FRAMES[0]].status == "done"
