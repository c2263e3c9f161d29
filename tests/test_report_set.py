# SPDX-License-Identifier: MIT
"""The page of a training set, and its manifest as a table."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import densify
from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord
from densify.dataset.plan import Recipe, plan, write_plan
from densify.dataset.report import write_report
from densify.outputs.kitti_tree import FileRecord
from tests.command import refused
from tests.dataset_scenes import DRIVE, FRAMES


def scored(key: int) -> KeyRecord:
    scores = {"num_points": 9, "ghost": key % 4 / 100, "density": {"image_02": 0.5}}
    return KeyRecord(DRIVE, key, "done", frames=(key,), scores=scores, seconds=2.0)


@pytest.fixture
def described(border_drive: Path, tmp_path: Path) -> Path:
    """The description of a set of nine keys."""
    write_plan(tmp_path, Recipe(), plan([str(border_drive)], None, Recipe()))
    return tmp_path


def write_manifest(root: Path, *records: KeyRecord) -> None:
    (root / "manifest.jsonl").write_bytes(b"".join(r.to_line() for r in records))


def page_of(root: Path) -> str:
    (page,) = write_report(root, overwrite=True)
    return page.read_text()


def rows_of(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading, without its head."""
    table = page.partition(f"<h2>{heading}</h2>")[2].partition("</table>")[0]
    rows = (re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", table))
    return [row for row in rows if row]


def test_keys_with_the_most_ghosts_come_first(described: Path) -> None:
    write_manifest(described, *map(scored, FRAMES))
    page = page_of(described)
    rows = rows_of(page, "The worst keys")
    assert "9 done; 2.0 s a key" in page and page.count("<svg") == 3  # ghosts, measured, time
    assert float(rows[0][2]) == 3 and {row[4] for row in rows} == {"50.0"}
    assert len(rows) == len(FRAMES)
    assert page_of(described) == page  # to the last byte, figures too


def test_keys_that_are_not_done_say_why(described: Path) -> None:
    aside = replace(scored(FRAMES[3]), status="aside", reason="ghost rate <b>", files={})
    torn = KeyRecord(DRIVE, 99, "failed", "torn")
    write_manifest(described, *map(scored, FRAMES[:3]), aside, torn)
    page = page_of(described)
    reasons = {row[2]: html.unescape(row[3]) for row in rows_of(page, "Failed or put aside")}
    assert reasons == {"failed": "torn", "aside": "ghost rate <b>"}
    assert "3 done, 1 put aside, 1 failed, 5 to make" in page


def test_pictures_show_filled_depth_and_confidence_and_lead_to_the_map(described: Path) -> None:
    depth, confidence = np.full((40, 80), 256 * 10, np.uint16), np.full((40, 80), 255, np.uint8)
    files = {}
    for kind, pixels in (("groundtruth_filled", depth), ("confidence", confidence)):
        name = f"val/{DRIVE}/proj_depth/{kind}/image_02/0000000001.png"
        (described / name).parent.mkdir(parents=True)
        cv2.imwrite(str(described / name), pixels)
        files[name] = FileRecord(1, "")
    lost = {"val/confidence/lost.png": FileRecord(1, "")}
    write_manifest(described, replace(scored(1), files=files), replace(scored(2), files=lost))
    page = page_of(described)
    assert page.count('src="data:image/jpeg') == 2 and "lost.png: cannot be read" in page
    assert f'<a href="val/{DRIVE}/proj_depth/confidence' in page


def test_the_manifest_is_a_table(described: Path) -> None:
    write_manifest(described, *map(scored, FRAMES))
    with pytest.raises(InputError, match=r"no key in manifest\*\.jsonl"):
        densify.manifest(described.parent / "none")
    table = densify.manifest(described)
    assert list(table["key"]) == list(FRAMES) and (table["density.image_02"] == 0.5).all()
    assert table["ghost"].tolist() == [key % 4 / 100 for key in FRAMES]


def test_a_damaged_set_and_several_keys_are_refused(tmp_path: Path, capsys) -> None:
    for key in ("000001", "000002"):
        (tmp_path / key).mkdir()
        (tmp_path / key / "compare.json").write_text("{}")
    with pytest.raises(InputError, match="holds 2 keys; name one"):
        write_report(tmp_path)
    (tmp_path / "dataset.json").write_text("{}")
    assert "dataset.json" in refused(capsys, 2, "report", tmp_path)
