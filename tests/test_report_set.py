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
from densify.dataset.manifest import FileRecord, KeyRecord, describe_pace, describe_rest
from densify.dataset.plan import Recipe, plan, write_plan
from densify.dataset.report import write_report
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
    table = re.sub(r"</?(a|b)\b.*?>", "", table)
    rows = re.findall(r"<tr.*?>(.*?)</tr>", table)
    return [cells for row in rows if (cells := re.findall(r"<td>(.*?)</td>", row))]


def test_keys_with_the_most_ghosts_come_first(described: Path) -> None:
    write_manifest(described, *map(scored, FRAMES))
    page = page_of(described)
    rows = rows_of(page, "All keys, worst first")
    assert "9 done; 2.0 s a key" in page and page.count("<svg") == 3  # ghosts, measured, time
    assert float(rows[0][1]) == 3 and {row[2] for row in rows} == {"50.0"}
    assert "<td><b>3</b></td>" in page  # the score that ranks the key
    assert len(rows) == len(FRAMES) == page.count("<circle") / 3
    assert (
        "front camera, moving vehicle): ghosts. See" in page and "Outliers are not measured" in page
    )
    assert (write_report(described)[0]).read_text() == page  # to the last byte, figures too


def test_keys_that_are_not_done_say_why(described: Path) -> None:
    aside = replace(scored(FRAMES[3]), status="aside", reason="ghost rate <b>", files={})
    torn = KeyRecord(DRIVE, 99, "failed", "torn")
    write_manifest(described, *map(scored, FRAMES[:3]), aside, torn)
    page = page_of(described)
    rows = {row[0]: html.unescape(row[-1]) for row in rows_of(page, "Failed or put aside")}
    assert rows == {"key 39": "aside: ghost rate <b>", "key 99": "failed: torn"}
    assert "3 done, 1 put aside, 1 failed, 5 to make" in page and 'class="hollow"' in page
    assert "<b>Not finished: 4 of 9 keys</b>; the other 5 keys take about" in page


def test_pictures_show_the_image_filled_depth_and_confidence(described: Path) -> None:
    depth, confidence = np.full((40, 80), 256 * 10, np.uint16), np.full((40, 80), 255, np.uint8)
    files = {}
    for kind, pixels in (("groundtruth_filled", depth), ("confidence", confidence)):
        name = f"val/{DRIVE}/proj_depth/{kind}/image_02/{FRAMES[0]:010d}.png"
        (described / name).parent.mkdir(parents=True)
        cv2.imwrite(str(described / name), pixels)
        files[name] = FileRecord(1, "")
    lost = {"val/confidence/image_02/lost.png": FileRecord(1, "")}
    first = replace(scored(FRAMES[0]), files=files)
    write_manifest(described, first, replace(scored(FRAMES[1]), files=lost))
    page = page_of(described)
    alts = re.findall(r'<img alt="(.*?)" src="data:image/jpeg', page)
    assert alts == [
        f"{kind}, key 36" for kind in ("image image_02", "filled depth image_02", "confidence")
    ]
    assert "lost.png: cannot be read" in page
    (described / "dataset.json").write_text(
        (described / "dataset.json").read_text().replace('"data": "', '"data": "/moved')
    )
    assert page_of(described).count("<img") == 2  # the recording is no longer there


def test_the_slowest_key_has_no_part_in_the_time_of_the_others() -> None:
    records = [replace(scored(key), seconds=s) for key, s in enumerate((100.0, 6.0, 12.0, 6.0))]
    assert describe_pace(records) == "9.0 s a key (6.0 to 100.0)"
    assert describe_rest(records, 60) == "the other 60 keys take about 6 to 9 min in one process"
    assert describe_rest(records[:1], 60) == "60 keys are left"


def test_a_key_leads_to_its_own_page_and_many_keys_have_a_histogram(described: Path) -> None:
    files = {name: FileRecord(1, "") for name in ("000001/figure.png", "000001/report.html")}
    keys = (replace(scored(key), files=files if key == 1 else {}) for key in range(25))
    write_manifest(described, *keys)
    page = page_of(described)
    assert '<a href="000001/report.html">key 1</a>' in page and "<rect" in page
    assert page.count('class="usual"') == 2  # of ghosts and measured depth
    assert set(re.findall(r'<a href="#(row.*?)"', page)) <= set(re.findall(r'id="(row.*?)"', page))


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
