# SPDX-License-Identifier: MIT
"""The page of a training set, and its manifest as a table."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import densify
from densify.config.errors import InputError
from densify.dataset.judged_set import limits_of, read_judged
from densify.dataset.make import beyond_limits
from densify.dataset.manifest import FileRecord, KeyRecord, describe_pace, describe_rest
from densify.dataset.plan import Gate, Recipe, plan, write_plan
from densify.dataset.report import write_report
from tests.command import refused
from tests.dataset_scenes import DRIVE, FRAMES


def scored(key: int) -> KeyRecord:
    scores = {"num_points": 9, "ghost": key % 4 / 100, "density": {"image_02": 0.5}}
    return KeyRecord(DRIVE, key, "done", frames=(key,), scores=scores, seconds=2.0)


def with_cameras(key: int, front: float, left: float, outliers: float = 0.005) -> KeyRecord:
    scores = {
        "ghost": 0.001,
        "density": {"front": front, "left": left},
        "outliers": {"front": outliers, "left": None},
    }
    return replace(scored(key), scores=scores)


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
    table = re.sub(r"</?(a|b|code)\b.*?>", "", table)
    rows = re.findall(r"<tr.*?>(.*?)</tr>", table)
    return [cells for row in rows if (cells := re.findall(r"<td.*?>(.*?)</td>", row))]


def test_keys_with_the_most_ghosts_come_first(described: Path) -> None:
    write_manifest(described, *map(scored, FRAMES))
    page = page_of(described)
    rows = rows_of(page, "All keys, worst first")
    assert "9 done; 2.0 s a key" in page and page.count("<svg") == 3  # ghosts, measured, time
    assert float(rows[0][1]) == 3 and {row[2] for row in rows} == {"50.0"}
    assert rows_of(page, "Scores")[0][4] == "6"  # suspect: all but those without ghosts
    assert len(rows) == len(FRAMES) == page.count("<circle") / 3
    assert '<p class="verdict bad">' in page and "moving vehicle): ghosts" in page
    assert "Outliers are not measured" in page
    assert (write_report(described)[0]).read_text() == page  # to the last byte, figures too


def test_coverage_is_judged_by_the_other_keys_of_the_camera(described: Path) -> None:
    """A side camera has less depth than KITTI's front camera, and no key of it is suspect."""
    keys = [with_cameras(key, 0.45, 0.15) for key in FRAMES]
    write_manifest(described, *keys)
    page = page_of(described)
    assert '<p class="verdict plain">' in page and "judged in 0 of 9 keys" in page
    keys[4] = with_cameras(FRAMES[4], 0.45 - 0.15, 0.15)
    keys[6] = with_cameras(FRAMES[6], 0.45, 0.15, outliers=0.02)
    write_manifest(described, *keys)
    judged = read_judged(described)
    found = {
        key: [(j.series.score.name, j.series.camera) for j in j_all]
        for (_, key), j_all in judged.suspects.items()
    }
    assert found == {FRAMES[4]: [("density", "front")], FRAMES[6]: [("outliers", "front")]}
    assert {record.key for record in judged.worst_first[:2]} == {FRAMES[4], FRAMES[6]}
    page = page_of(described)
    assert '<p class="verdict look">' in page and "2 of 9 keys are suspect" in page
    assert "measured depth of front 30.0 %, median 45.0 %" in page
    assert page.count('class="camera-1') > len(FRAMES)  # dots of the second camera
    aside = Gate(max_ratio=None, suspects="aside")
    assert set(beyond_limits({r.name: r for r in keys}, aside)) == {
        (DRIVE, FRAMES[4]),
        (DRIVE, FRAMES[6]),
    }


def test_a_limit_tells_how_many_keys_it_puts_aside(described: Path) -> None:
    write_manifest(
        described, *(replace(scored(key), scores={"ghost": key / 10_000}) for key in range(40))
    )
    judged = read_judged(described)
    limits = {limit.setting: limit.num_lost for limit in limits_of(judged)}
    assert limits == {
        "dataset.max_ghost=0.0038": 1,
        "dataset.max_ghost=0.0037": 2,
        "dataset.max_ghost=0.0035": 4,
    }
    for setting, num_lost in limits.items():
        gate = Gate(max_ghost=float(setting.partition("=")[2]))
        reasons = [
            gate.reason({**r.scores, "density": {}, "outliers": {}}, 9) for r in judged.records
        ]
        assert sum(reason is not None for reason in reasons) == num_lost


def test_keys_that_are_not_done_say_why(described: Path) -> None:
    aside = replace(scored(FRAMES[3]), status="aside", reason="ghost rate <b>", files={})
    torn = KeyRecord(DRIVE, 99, "failed", "torn")
    write_manifest(described, *map(scored, FRAMES[:3]), aside, torn)
    page = page_of(described)
    rows = rows_of(page, "Failed or put aside")
    texts = [html.unescape(row[-1]) for row in rows]
    assert [row[0] for row in rows[::2]] == ["key 99", "key 39"]  # failed ones first
    assert texts[1::2] == ["<div>failed: torn</div>", "<div>aside: ghost rate <b></div>"]
    assert [row[1] for row in rows_of(page, "Reasons and warnings")] == ["1", "1"]
    assert "3 done, 1 put aside, 1 failed, 5 to make" in page
    assert "hollow" in page and page.count('<path class="failed"') == 3  # in each plot
    assert "<b>Not finished: 4 of 9 keys</b>; the other 5 keys take about" in page


def test_pictures_show_the_image_depth_and_confidence(described: Path) -> None:
    depth, confidence = np.full((40, 80), 256 * 10, np.uint16), np.full((40, 80), 255, np.uint8)
    files = {}
    maps = (("groundtruth", depth), ("groundtruth_filled", depth), ("confidence", confidence))
    for kind, pixels in maps:
        name = f"val/{DRIVE}/proj_depth/{kind}/image_02/{FRAMES[0]:010d}.png"
        (described / name).parent.mkdir(parents=True)
        cv2.imwrite(str(described / name), pixels)
        files[name] = FileRecord(1, "")
    lost = {"val/confidence/image_02/lost.png": FileRecord(1, "")}
    first = replace(scored(FRAMES[0]), files=files)
    write_manifest(described, first, replace(scored(FRAMES[1]), files=lost))
    page = page_of(described)
    alts = re.findall(r'<img alt="(.*?)" src="data:image/jpeg', page)
    kinds = ("image image_02", "measured depth image_02", "filled depth image_02", "confidence")
    assert sorted(alts) == sorted(["key 36", *(f"{kind}, key 36" for kind in kinds)])
    links = set(re.findall(r'<a href="(val/.*?)"', page))
    assert links == {name for name in files if "confidence" not in name}
    assert "lost.png: cannot be read" in page
    (described / "dataset.json").write_text(
        (described / "dataset.json").read_text().replace('"data": "', '"data": "/moved')
    )
    assert page_of(described).count("<img") == 4  # the recording is no longer there


def test_the_slowest_key_has_no_part_in_the_time_of_the_others() -> None:
    records = [replace(scored(key), seconds=s) for key, s in enumerate((100.0, 6.0, 12.0, 6.0))]
    assert describe_pace(records) == "9.0 s a key (6.0 to 100.0)"
    assert describe_rest(records, 60) == "the other 60 keys take about 6 to 9 min in one process"
    assert describe_rest(records[:1], 60) == "60 keys are left"
    files = {"a": FileRecord(800_000, "")}
    made = [replace(record, files=files) for record in records]
    rest = "the other 9,992 keys take about 17 to 25 h in one process and 8.0 GB"
    assert describe_rest(made, 9_992) == rest
    assert describe_rest(made, 2).endswith("about 12 to 18 s in one process and 2 MB")


def test_the_page_of_many_recordings_stays_whole(described: Path) -> None:
    """Every link has its target, and every mark lies within its plot."""
    plan_file = described / "dataset.json"
    table = json.loads(plan_file.read_text())
    (drive,) = table["drives"].values()
    names = [f"drive_{number:03d}" for number in range(150)]
    table["drives"] = {n: {**drive, "folder": f"val/{n}", "frames": [[0, 19]]} for n in names}
    plan_file.write_text(json.dumps(table))
    records = (replace(scored(key), drive=name) for name in names for key in range(20))
    write_manifest(described, *records)
    page = page_of(described)
    targets = set(re.findall(r'<a href="#(.*?)"', page))
    assert len(targets) > 500 and targets <= set(re.findall(r'id="(.*?)"', page))
    across_px = [float(x) for x in re.findall(r'<circle cx="(.*?)"', page)]
    assert min(across_px) > 0 and max(across_px) <= 400
    assert len(rows_of(page, "Recordings")) == 12 and "The other recordings" in page


def test_a_key_leads_to_its_own_page(described: Path) -> None:
    files = {name: FileRecord(1, "") for name in ("000001/figure.png", "000001/report.html")}
    keys = (replace(scored(key), files=files if key == 1 else {}) for key in range(25))
    write_manifest(described, *keys)
    page = page_of(described)
    assert '<a href="000001/report.html">key 1</a>' in page and 'class="bar camera-0"' in page
    assert page.count('class="limit') == 2  # of ghosts and measured depth


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
