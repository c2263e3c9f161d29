# SPDX-License-Identifier: MIT
"""A key of a training set is judged beside its neighbours, and put aside if it is far worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from densify.dataset import key as one_key
from densify.dataset import make
from densify.dataset.key import Job
from densify.dataset.loader import DepthDataset
from densify.dataset.manifest import KeyRecord
from densify.dataset.neighbours import worse_than_neighbours
from densify.dataset.report import write_report
from tests.command import exit_code
from tests.dataset_scenes import DRIVE, FRAMES, OPTIONS, keys_of, maps_in, statuses


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
    return [key for _, key in worse_than_neighbours(records, 4.0)]


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
    ((name, text),) = worse_than_neighbours(records, 4.0).items()
    assert name == (DRIVE, 4) and "held-out outliers of the neighbouring keys" in text
    assert "ghosts" not in text


def test_what_is_not_known_is_not_judged() -> None:
    assert keys_in(drive_of([None] * 9)) == [] == keys_in({})
    assert keys_in(drive_of([0.5, 0.0])) == []
    records = drive_of([0.001, 0.001, 0.001, 0.5, 0.001])
    records[DRIVE, 3] = replace(records[DRIVE, 3], status="aside", reason="ghosts")
    assert keys_in(records) == []


def test_a_key_far_worse_than_its_neighbours_is_put_aside(
    border_drive: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """Its files go, default loading leaves it out, and command, status and page say so."""

    def made(job_and_key: tuple[Job, int]) -> KeyRecord:
        record = one_key.make_key(job_and_key)
        return replace(record, scores={**record.scores, "ghost": 0.02 * (record.key == FRAMES[0])})

    monkeypatch.setattr(make, "make_key", made)
    out, cheap = tmp_path / "set", (*OPTIONS, "--method", "none", "--workers", "1")
    command = ("dataset", "--data", border_drive, *cheap, "--out", out)
    said = f"{DRIVE} {FRAMES[0]} aside: more than 4 times the ghosts of the neighbouring keys"
    for _ in range(2):  # made, and continued with nothing to make
        assert exit_code(*command) == 0
        assert said in capsys.readouterr().out
    assert exit_code("dataset", "--status", out) == 0
    assert said in capsys.readouterr().out
    assert keys_of(maps_in(out)) == {*FRAMES} - {FRAMES[0]}
    assert [sample["frame"] for sample in DepthDataset(out)] == [*FRAMES][1:]
    (page,) = write_report(out)
    assert page.read_text().count("times the ghosts of the neighbouring keys") == 1
    everything = tmp_path / "everything"
    assert exit_code(*command[:-1], everything, "--set", "dataset.max_ratio=null") == 0
    assert statuses(everything)[FRAMES[0]] == "done"
