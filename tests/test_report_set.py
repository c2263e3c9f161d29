# SPDX-License-Identifier: MIT
"""The page of a training set."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from densify.dataset.manifest import KeyRecord
from densify.dataset.plan import Recipe, plan, write_plan
from densify.dataset.report import write_report
from tests.command import refused
from tests.dataset_scenes import DRIVE, FRAMES


def table_of(page: Path) -> list[list[str]]:
    """Return the cells of the table of keys."""
    body = page.read_text().partition("<tbody>")[2]
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", body)]


def scored(key: int) -> KeyRecord:
    scores = {
        "num_points": 9,
        "num_moving": 1,
        "ghost": key % 4 / 100,
        "density": {"image_02": 0.5},
    }
    return KeyRecord(DRIVE, key, "done", frames=(key,), scores=scores)


@pytest.fixture
def described(border_drive: Path, tmp_path: Path) -> Path:
    """The description of a set of nine keys."""
    write_plan(tmp_path, Recipe(), plan([str(border_drive)], None, Recipe()))
    return tmp_path


def test_keys_that_are_not_done_come_first_then_the_most_ghosts(described: Path) -> None:
    aside = replace(scored(FRAMES[3]), status="aside", reason="ghost rate <b>", files={})
    torn = KeyRecord(DRIVE, 99, "failed", "torn")
    records = (*map(scored, FRAMES[:3]), aside, torn)
    (described / "manifest.jsonl").write_bytes(b"".join(r.to_line() for r in records))
    (page,) = write_report(described)
    rows = table_of(page)
    assert [row[2:4] for row in rows[:2]] == [["failed", "torn"], ["aside", "ghost rate &lt;b&gt;"]]
    assert "3 done" in page.read_text() and "5 to make" in page.read_text()
    ghosts = {int(row[1]): float(row[8]) for row in rows[2:]}
    assert list(ghosts.values()) == sorted(ghosts.values(), reverse=True)
    assert ghosts == {key: key % 4 / 100 for key in FRAMES[:3]}
    assert {row[9] for row in rows[2:]} == {"0.5"}


def test_a_damaged_set_and_several_keys_are_refused(tmp_path: Path, capsys) -> None:
    for key in ("000001", "000002"):
        (tmp_path / key).mkdir()
        (tmp_path / key / "compare.json").write_text("{}")
    assert "holds 2 keys; name one" in refused(capsys, 2, "report", tmp_path)
    (tmp_path / "dataset.json").write_text("{}")
    assert "dataset.json" in refused(capsys, 2, "report", tmp_path)
