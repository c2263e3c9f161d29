# SPDX-License-Identifier: MIT
"""A key of a training set is judged beside its neighbours, and put aside if it is far worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from densify.dataset import make
from densify.dataset.loader import DepthDataset
from densify.dataset.make import worse_than_neighbours
from densify.dataset.manifest import KeyRecord
from densify.dataset.report import write_report
from tests.command import exit_code
from tests.dataset_scenes import DRIVE, FRAMES, OPTIONS, keys_of, maps_in

USUAL = [0.0003 + 0.0001 * (key % 3) for key in range(30)]


def drive_of(shares: list[float | None], **scores) -> dict:
    """Records of a drive by ghost rate, with windows of five sweeps that the ends cut."""
    ends = (0, len(shares) - 1)
    records = (
        KeyRecord(
            DRIVE,
            key,
            "done",
            frames=tuple(range(max(ends[0], key - 2), min(ends[1], key + 2) + 1)),
            scores={"ghost": share, **scores},
        )
        for key, share in enumerate(shares)
    )
    return {record.name: record for record in records}


@pytest.mark.parametrize(
    ("shares", "worse"),
    [
        (USUAL, []),
        ([0.016, 0.012, *USUAL, 0.009], [0, 1, 32]),  # the ends stand out
        ([0.01] * 20, []),  # worse than other drives, everywhere
        ([0.001 * 1.15**key for key in range(30)], []),  # or slowly becoming so
        ([0.007, *[0.0] * 20], []),  # no more ghosts than usual
        ([None] * 9, []),
        ([0.5, 0.0], []),  # which of two is unusual?
        ([], []),
    ],
)
def test_keys_far_worse_than_those_around(shares: list, worse: list[int]) -> None:
    assert [key for _, key in worse_than_neighbours(drive_of(shares), 4.0)] == worse


def test_outliers_count_by_the_worst_camera_and_only_of_keys_that_are_kept() -> None:
    records = drive_of([0.0] * 12, outliers={"a": 0.01, "b": None})
    bad = replace(records[DRIVE, 4], scores={"ghost": 0, "outliers": {"a": 0.01, "b": 0.05}})
    records[bad.name] = bad
    ((name, text),) = worse_than_neighbours(records, 4.0).items()
    assert name == (DRIVE, 4) and text.startswith("held-out outliers 5 %, more than 4 times the")
    assert "ghosts" not in text
    records[bad.name] = replace(bad, status="aside", reason="outliers")
    assert not worse_than_neighbours(records, 4.0)


def test_a_key_far_worse_than_its_neighbours_is_put_aside(
    border_drive: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """Its files go, default loading leaves it out, and command, status and page say so."""
    make_key = make.make_key

    def made(job_and_key) -> KeyRecord:
        record = make_key(job_and_key)
        return replace(record, scores={**record.scores, "ghost": 0.02 * (record.key == FRAMES[0])})

    monkeypatch.setattr(make, "make_key", made)
    out, cheap = tmp_path / "set", (*OPTIONS, "--method", "none", "--workers", "1")
    reason = "ghosts 2 %, more than 4 times the 0 % of the neighbouring keys (median)"
    assert exit_code("dataset", border_drive, *cheap, "--out", out, "--preview", "8") == 0
    assert "aside" not in capsys.readouterr().out  # neighbours of a preview may be far away
    for command in (("--data", border_drive, *cheap, "--out", out), ("--status", out)):
        assert exit_code("dataset", *command) == 0
        assert f"{DRIVE} {FRAMES[0]} aside: {reason}" in capsys.readouterr().out
    assert keys_of(maps_in(out)) == {*FRAMES} - {FRAMES[0]}
    assert [sample["frame"] for sample in DepthDataset(out)] == [*FRAMES][1:]
    (page,) = write_report(out)
    assert page.read_text().count(reason) == 2  # with its picture, and in the table
    assert (out / "aside" / DRIVE / f"{FRAMES[0]:010d}.jpg").is_file()
    assert f"put aside ({reason})" in (out / "densify.log").read_text()
