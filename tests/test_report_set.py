# SPDX-License-Identifier: MIT
"""The page of many keys: training sets and folders of runs."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.report import write_report
from densify.outputs import write_depth_png
from densify.outputs.kitti_tree import FileRecord
from densify.outputs.report.page_file import Blobs
from densify.outputs.report.thumbnails import HEIGHT_PX, WIDTH_PX, sheets
from tests.browser import Opened, chromium
from tests.command import refused
from tests.report_runs import FOLDER, write_run
from tests.test_report import data_of

NUM_KEYS = 1000


@pytest.fixture(scope="module")
def large_set(border_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A thousand keys in the manifest of a real set."""
    root = tmp_path_factory.mktemp("sets") / "large"
    shutil.copytree(border_set, root)
    real = next(iter(read_manifests(root).values()))
    rng = np.random.default_rng(0)
    ghosts, outliers = rng.gamma(2, 0.001, NUM_KEYS), rng.gamma(2, 0.01, NUM_KEYS)
    lines = []
    for key in range(NUM_KEYS):
        scores = {**real.scores, "ghost": ghosts[key], "outliers": {"image_02": outliers[key]}}
        record = replace(real, drive=f"drive {key // 200}", key=key % 200, scores=scores)
        if key % 100 == 7:
            why = f"ghost rate {ghosts[key]:.5f}, expected at most 0.001"
            record = replace(record, status="aside", reason=why, files={})
        lines.append(record.to_line())
    (root / "manifest.jsonl").write_bytes(b"".join(lines))
    write_report(root)
    return root


class TestFiles:
    def test_every_key_with_its_scores_and_picture(self, border_set: Path, tmp_path: Path) -> None:
        (page,) = write_report(border_set, tmp_path / "set.html")
        data = data_of(page.read_bytes())
        records = list(read_manifests(border_set).values())
        assert [(r["drive"], r["key"]) for r in data["rows"]] == [r.name for r in records]
        for row, record in zip(data["rows"], records, strict=True):
            assert row["ghost"] == record.scores["ghost"]
            assert row["density"] == [record.scores["density"]["image_02"]]
            assert row["picture"] is not None and not row["is_page"]
            shown = (tmp_path / unquote(row["link"])).resolve()
            assert shown.is_file() and "groundtruth/image_02" in shown.as_posix()
        assert data["cameras"] == ["image_02"] and data["num_left"] == 0

    def test_pictures_show_depth(self, tmp_path: Path) -> None:
        near_left = np.zeros((200, 800), np.float32)
        near_left[:, :400], near_left[:, 400:] = 3.0, 80.0
        paths = [tmp_path / "depth.png", tmp_path / "missing.png", tmp_path / "tall.png"]
        write_depth_png(paths[0], near_left)
        write_depth_png(paths[2], near_left[:, :100])
        blobs = Blobs()
        entry, found = sheets(blobs, paths)
        assert found == [True, False, True] and len(entry["sheets"]) == 1
        data = base64.b64decode(blobs.texts[entry["sheets"][0]["blob"]])
        sheet = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
        assert sheet.shape == (HEIGHT_PX, 16 * WIDTH_PX, 3)
        assert np.abs(sheet[10, 20].astype(int) - [253, 231, 37]).max() < 25  # viridis' ends
        assert np.abs(sheet[10, 90].astype(int) - [68, 1, 84]).max() < 25
        assert sheet[:, WIDTH_PX + 8 : 2 * WIDTH_PX - 8].max() < 12
        assert sheet[34, 2 * WIDTH_PX + 8 : 2 * WIDTH_PX + 10].mean() > 100

    def test_a_thousand_keys_stay_small(self, large_set: Path) -> None:
        page = (large_set / "report.html").read_bytes()
        assert len(data_of(page)["rows"]) == NUM_KEYS and len(page) < 1_500_000

    def test_names_that_lead_out_of_the_set_are_not_read(
        self, border_set: Path, tmp_path: Path
    ) -> None:
        root = tmp_path / "set"
        root.mkdir()
        (root / "dataset.json").write_bytes((border_set / "dataset.json").read_bytes())
        stolen = next(border_set.rglob("proj_depth/groundtruth/image_02/*.png"))
        (tmp_path / "000001" / "depth").mkdir(parents=True)
        shutil.copy(stolen, tmp_path / "000001" / "depth" / "image_02.png")
        lines = []
        for key, name in enumerate(
            ["../000001/depth/image_02.png", str(tmp_path / "000001" / "depth" / "image_02.png")]
        ):
            files = {name: FileRecord(9, "0" * 64)}
            lines.append(KeyRecord("a drive", key, "done", files=files).to_line())
        (root / "manifest.jsonl").write_bytes(b"".join(lines))
        (page,) = write_report(root)
        rows = data_of(page.read_bytes())["rows"]
        assert [(r["picture"], r["link"]) for r in rows] == [(None, "")] * 2

    def test_a_folder_of_runs(self, tmp_path: Path) -> None:
        folder = write_run(tmp_path)
        shutil.copytree(folder, tmp_path / "000009")
        (tmp_path / "000009" / "report.html").unlink()
        shutil.copytree(folder, tmp_path / "000011")
        (tmp_path / "000011" / "metrics.json").write_text("{}")
        (page,) = write_report(tmp_path)
        assert page == tmp_path / "report.html"
        rows = data_of(page.read_bytes())["rows"]
        metrics = json.loads((folder / "metrics.json").read_text())
        assert rows[0]["ghost"] == metrics["ghosts"]["all"]
        assert [r["link"] for r in rows] == [
            f"{FOLDER}/report.html",
            "000009/depth/front.png",
            "",
        ]
        assert [r["status"] for r in rows] == ["done", "done", "failed"]

    @pytest.mark.parametrize("content", ["{", "{}", '{"schema_version": 99}'])
    def test_a_damaged_set(self, content: str, tmp_path: Path, capsys) -> None:
        (tmp_path / "dataset.json").write_text(content)
        assert "dataset.json" in refused(capsys, 2, "report", tmp_path)

    def test_two_comparisons_are_not_one(self, tmp_path: Path) -> None:
        for key in ("000001", "000002"):
            (tmp_path / key).mkdir()
            (tmp_path / key / "compare.json").write_text("{}")
        with pytest.raises(InputError, match="holds 2 comparisons; name one"):
            write_report(tmp_path)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as program:
        yield program


@pytest.fixture
def opened(browser: Any, large_set: Path) -> Iterator[Opened]:
    page = Opened(browser, large_set / "report.html", width=1300)
    yield page
    assert page.told == [] and page.foreign() == [] and page.problems() == []
    page.page.close()


def shown(opened: Opened, column: int) -> list[str]:
    """Cells of a column, from the top."""
    return opened.value(
        f"""[...document.querySelectorAll("#body [role=row]")]
        .sort((a, b) => a.ariaRowIndex - b.ariaRowIndex)
        .map((row) => row.children[{column}].textContent)"""
    )


def click(opened: Opened, head: str) -> None:
    opened.page.locator("#head button", has_text=re.compile(f"^{head}$")).click()
    opened.settle()


class TestInABrowser:
    def test_only_what_is_in_view_is_in_the_document(self, opened: Opened) -> None:
        assert opened.text("#listed") == "1,000 of 1,000 keys"
        assert opened.page.locator("#body [role=row]").count() < 60
        opened.value("document.getElementById('body').scrollTop = 44 * 800")
        opened.page.wait_for_timeout(300)
        assert opened.page.locator("#body [role=row]").count() < 60
        assert "drive 4" in shown(opened, 1)[8]

    def test_every_score_sorts(self, opened: Opened) -> None:
        rows = data_of(Path(opened.page.url.removeprefix("file://")).read_bytes())["rows"]
        worst = sorted((r["ghost"] for r in rows), reverse=True)
        click(opened, "ghosts")
        assert shown(opened, 8)[:5] == [f"{100 * g:.2f} %" for g in worst[:5]]
        click(opened, "ghosts")
        assert shown(opened, 8)[:5] == [f"{100 * g:.2f} %" for g in worst[:-6:-1]]
        assert opened.value("document.querySelectorAll('[aria-sort=ascending]').length") == 1
        for head in ("measured", "filled", "wrong, held out", "mean error", "seconds", "key"):
            click(opened, head)

    def test_filters_and_bars(self, opened: Opened) -> None:
        opened.set("status", "aside")
        assert opened.text("#listed") == "10 of 1,000 keys"
        assert all(cell.startswith("put aside: ghost rate") for cell in shown(opened, 11))
        opened.set("drive", "drive 3")
        assert opened.text("#listed") == "2 of 1,000 keys"
        opened.set("search", "ghost 107")
        assert [shown(opened, 2), shown(opened, 1)] == [["107"], ["drive 3"]]
        opened.set("search", "")
        opened.set("drive", "")
        opened.set("status", "")
        ghosts = opened.page.locator("#histograms .panel", has_text="ghosts")
        bar = ghosts.locator("rect[tabindex='0']").nth(2)
        said = bar.get_attribute("aria-label")
        bar.focus()
        opened.page.keyboard.press("Enter")
        count = int(re.search(r": ([\d,]+) keys", said)[1].replace(",", ""))
        assert opened.text("#listed") == f"{count:,} of 1,000 keys" and count < 1000
        opened.page.locator("#histograms rect.chosen").click()
        assert opened.text("#listed") == "1,000 of 1,000 keys"

    def test_reasons_count_together(self, opened: Opened) -> None:
        said = opened.text("#reasons")
        assert "put aside: ghost rate …" in said and "10" in said.split()

    def test_pictures_are_drawn(self, opened: Opened) -> None:
        picture = opened.page.locator("#body .picture").nth(3)
        picture.scroll_into_view_if_needed()
        opened.page.wait_for_timeout(300)
        image = cv2.imdecode(np.frombuffer(picture.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
