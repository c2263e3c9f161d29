# SPDX-License-Identifier: MIT
"""The page of a training set."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.report import write_report
from densify.outputs.kitti_tree import FileRecord
from tests.command import refused


def table_of(page: Path) -> list[list[str]]:
    """Return the cells of the table of keys."""
    body = page.read_text().partition("<tbody>")[2]
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", body)]


def links(page: Path) -> list[str]:
    return [unquote(link) for link in re.findall(r'href="([^"]*)"', page.read_text())]


def test_every_key_with_its_scores_and_a_link(border_set: Path, tmp_path: Path) -> None:
    (page,) = write_report(border_set, tmp_path / "set.html")
    records = list(read_manifests(border_set).values())
    rows = table_of(page)
    assert len(rows) == len(records) and "9 done, 0 to make" in page.read_text()
    ghosts = {int(re.sub("<.*?>", "", row[1])): float(row[8]) for row in rows}
    assert list(ghosts.values()) == sorted(ghosts.values(), reverse=True)
    for record in records:
        assert ghosts[record.key] == pytest.approx(record.scores["ghost"], rel=1e-4)
    assert len(links(page)) == len(records)
    for link in links(page):
        shown = (tmp_path / link).resolve()
        assert shown.is_file() and "groundtruth/image_02" in shown.as_posix()


def test_keys_that_are_not_done_come_first_and_say_why(border_set: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(border_set, root)
    done = list(read_manifests(root).values())
    aside = replace(done[3], status="aside", reason="ghost rate <b>", files={})
    lines = [*done[:3], aside, KeyRecord(done[4].drive, 99, "failed", "torn")]
    (root / "manifest.jsonl").write_bytes(b"".join(r.to_line() for r in lines))
    (page,) = write_report(root)
    assert [row[2:4] for row in table_of(page)[:2]] == [
        ["failed", "torn"],
        ["aside", "ghost rate &lt;b&gt;"],
    ]
    assert "6 to make" not in page.read_text() and "5 to make" in page.read_text()


def test_names_that_lead_out_of_the_set_are_not_linked(border_set: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    root.mkdir()
    shutil.copy(border_set / "dataset.json", root)
    names = ("../000001/depth/image_02.png", f"{tmp_path}/000001/depth/image_02.png")
    records = [
        KeyRecord("a drive", key, "done", files={name: FileRecord(9, "0" * 64)})
        for key, name in enumerate(names)
    ]
    (root / "manifest.jsonl").write_bytes(b"".join(r.to_line() for r in records))
    assert links(write_report(root)[0]) == []


def test_a_damaged_set_and_several_keys_are_refused(tmp_path: Path, capsys) -> None:
    for key in ("000001", "000002"):
        (tmp_path / key).mkdir()
        (tmp_path / key / "compare.json").write_text("{}")
    with pytest.raises(InputError, match="holds 2 keys; name one"):
        write_report(tmp_path)
    (tmp_path / "dataset.json").write_text("{}")
    assert "dataset.json" in refused(capsys, 2, "report", tmp_path)
