# SPDX-License-Identifier: MIT
"""The page of a training set."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.report import write_report
from tests.command import refused


def table_of(page: Path) -> list[list[str]]:
    """Return the cells of the table of keys."""
    body = page.read_text().partition("<tbody>")[2]
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", body)]


def test_every_key_with_its_scores(border_set: Path, tmp_path: Path) -> None:
    for name in ("dataset.json", "manifest.jsonl"):
        shutil.copy(border_set / name, tmp_path)
    (page,) = write_report(tmp_path)
    records = list(read_manifests(border_set).values())
    rows = table_of(page)
    assert len(rows) == len(records) and "9 done, 0 to make" in page.read_text()
    ghosts = {int(row[1]): float(row[8]) for row in rows}
    assert list(ghosts.values()) == sorted(ghosts.values(), reverse=True)
    for record in records:
        assert ghosts[record.key] == pytest.approx(record.scores["ghost"], rel=1e-4)


def test_keys_that_are_not_done_come_first_and_say_why(border_set: Path, tmp_path: Path) -> None:
    shutil.copy(border_set / "dataset.json", tmp_path)
    done = list(read_manifests(border_set).values())
    aside = replace(done[3], status="aside", reason="ghost rate <b>", files={})
    lines = [*done[:3], aside, KeyRecord(done[4].drive, 99, "failed", "torn")]
    (tmp_path / "manifest.jsonl").write_bytes(b"".join(r.to_line() for r in lines))
    (page,) = write_report(tmp_path)
    assert [row[2:4] for row in table_of(page)[:2]] == [
        ["failed", "torn"],
        ["aside", "ghost rate &lt;b&gt;"],
    ]
    assert "6 to make" not in page.read_text() and "5 to make" in page.read_text()


def test_a_damaged_set_and_several_keys_are_refused(tmp_path: Path, capsys) -> None:
    for key in ("000001", "000002"):
        (tmp_path / key).mkdir()
        (tmp_path / key / "compare.json").write_text("{}")
    with pytest.raises(InputError, match="holds 2 keys; name one"):
        write_report(tmp_path)
    (tmp_path / "dataset.json").write_text("{}")
    assert "dataset.json" in refused(capsys, 2, "report", tmp_path)
