# SPDX-License-Identifier: MIT
"""Pages in a real browser: what they show is what the files say, and a control changes it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from densify.dataset.report import write_report
from densify.outputs.export import export_run
from densify.readers.decoded_files import decode_image
from tests.browser import Opened, chromium
from tests.report_runs import results, write_run


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as program:
        yield program


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def opened(browser: Any, run: Path) -> Iterator[Opened]:
    page = Opened(browser, run / "report.html")
    yield page
    assert page.told == [] and page.foreign() == []
    page.page.close()


def numbers(text: str) -> list[float]:
    return [float(n) for n in re.findall(r"-?\d+\.?\d*", text)]


def kept(opened: Opened) -> list[list[float]]:
    """Rows measured and filled: density, expected wrong, wrong, mean error."""
    return [numbers(opened.text(f"#kept tr:nth-child({row})")) for row in (2, 3)]


def pixels(png: bytes) -> np.ndarray:
    return decode_image(png, "screen").astype(int)


def test_its_numbers_are_those_of_the_run(opened: Opened, run: Path) -> None:
    assert opened.problems() == [] and opened.text("h1") == "tiny street, key 3"
    metrics = json.loads((run / "metrics.json").read_text())
    for product, row in zip(("measured", "filled"), kept(opened), strict=True):
        scores = metrics["depth"]["front"][product]["all"]
        assert row[0] == pytest.approx(100 * metrics["density"]["front"][product], abs=0.006)
        expected = metrics["expected_outliers"]["front"][product]
        assert row[1] == pytest.approx(100 * expected, abs=0.02)
        assert row[2] == pytest.approx(100 * scores["outliers"], abs=0.03)
        assert row[3] == pytest.approx(scores["mae_m"], abs=0.002)
    table = opened.text("#score-tables div:first-of-type")
    assert f"{100 * metrics['depth']['front']['measured']['all']['outliers']:.2f} %" in table
    stages = yaml.safe_load((run / "run.yaml").read_text())["stages"]
    assert all(stage["name"] in opened.text("#costs") for stage in stages)
    check_pointer(opened)


def check_pointer(opened: Opened) -> None:
    depth = results()["flow"].depth["front"]
    row, column = np.argwhere((depth.depth_m > 0) & (depth.frame != 3))[40]
    box = opened.page.locator("#picture").bounding_box()
    height, width = depth.depth_m.shape
    opened.page.mouse.move(
        box["x"] + (column + 0.5) * box["width"] / width,
        box["y"] + (row + 0.5) * box["height"] / height,
    )
    said = opened.text("#reading")
    assert f"u {column}, v {row}" in said and "measured" in said
    assert f"{depth.depth_m[row, column]:.2f} m" in said
    assert re.search(rf"source sweep\s*{depth.frame[row, column]} ", said)
    assert f"{round(1000 * depth.age_s[row, column])} ms" in said
    assert f"{depth.confidence[row, column]:.2f}: one in" in said
    opened.page.locator("#picture").focus()
    opened.page.keyboard.press("ArrowRight")
    opened.page.keyboard.press("Shift+ArrowDown")
    assert f"u {column + 1}, v {min(row + 10, height - 1)}" in opened.text("#reading")


def test_sliders_keep_what_export_keeps(opened: Opened, run: Path, tmp_path: Path) -> None:
    before = opened.picture("#picture")
    opened.set("confidence", 0.35)
    opened.set("age", 150)
    exported = export_run(run, "npy", tmp_path / "a", min_confidence=0.35, max_age_ms=150)
    shares = exported.density["front"]
    for product, row in zip(("measured", "filled"), kept(opened), strict=True):
        assert row[0] == pytest.approx(100 * shares[product].after, abs=0.006)
        assert shares[product].after < shares[product].before
    assert opened.picture("#picture") != before
    assert "--min-confidence 0.35" in opened.text("#export-command")


def test_the_divider_and_every_layer_change_pixels(opened: Opened) -> None:
    seen = []
    for share in (0, 30, 100):
        opened.set("split", share)
        seen.append(opened.picture("#picture"))
    for layer in opened.value("[...document.getElementById('left').options].map((o) => o.value)"):
        opened.set("left", layer)
        seen.append(opened.picture("#picture"))
    layers = len(seen) - 3
    assert layers == 11 and len({*seen}) >= len(seen) - 1  # the divider at 100 shows the left layer
    opened.set("palette", "turbo")
    opened.set("left", "filled")
    assert opened.picture("#picture") not in seen


def drawn(opened: Opened) -> float:
    """The share of the 3-D view, without border and note, that is not background."""
    opened.value(  # until all points are drawn
        """new Promise((done) => { const look = () => cloudPane.whole && !cloudPane.waiting
        ? done() : requestAnimationFrame(look); look(); })"""
    )
    shown = pixels(opened.picture("#space"))[20:-60, 20:-20]
    return float((np.abs(shown - [10, 7, 5]).max(axis=2) > 12).mean())


def test_the_cloud_is_drawn_and_its_controls_change_it(opened: Opened) -> None:
    opened.page.locator("#cloud").scroll_into_view_if_needed()
    opened.page.wait_for_timeout(600)
    assert drawn(opened) > 0.1
    for name in ("show-paths", "show-cameras"):
        opened.value(f"document.getElementById('{name}').click()")
    everything = drawn(opened)
    last = opened.picture("#space")
    for control, value in (
        *(("colouring", "1"), ("morph", 0), ("sweeps-shown", "one"), ("sweep", 0)),
        *(("sweeps-shown", "all"), ("point-size", 3)),
    ):
        opened.set(control, value)
        opened.page.wait_for_timeout(350)
        now = opened.picture("#space")
        assert now != last, (control, value)
        last = now
    opened.set("point-size", 1)
    opened.value("document.getElementById('only-moving').click()")
    opened.page.wait_for_timeout(350)
    assert 0 < drawn(opened) < 0.2 * everything


def test_a_damaged_run_says_what_is_damaged(browser: Any, run: Path, tmp_path: Path) -> None:
    folder = write_run(tmp_path, report=False)
    for name in ("confidence/front.png", "cloud.laz", "scene/image/front.jpg"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])
    (folder / "metrics.json").write_text('{"baselines": [1], "depth": 7, "held_out": {"front": 3}}')
    page = Opened(browser, write_report(folder)[0])
    said = "\n".join(page.problems())
    for name in ("confidence/front.png", "cloud.laz", "scene/image/front.jpg"):
        assert name in said
    assert page.told == [] and page.foreign() == []
    assert not page.page.locator("#cloud").is_visible()
    page.set("left", "icp")
    page.set("right", "measured")
    assert len(np.unique(pixels(page.picture("#picture")).reshape(-1, 3), axis=0)) > 50
    page.page.close()


EVIL = '</script><img src=x onerror="alert(1)"><b id=evil>'


def test_texts_of_others_stay_texts(browser: Any, tmp_path: Path) -> None:
    folder = write_run(tmp_path, report=False)
    about = yaml.safe_load((folder / "run.yaml").read_text())
    about |= {"data": EVIL, "warnings": [EVIL], "versions": {EVIL: EVIL}, "method": EVIL}
    about["config"][EVIL] = {EVIL: EVIL}
    about["stages"] = [{"name": EVIL, "seconds": EVIL, "peak_memory_mb": None}]
    (folder / "run.yaml").write_text(yaml.safe_dump(about))
    scene = json.loads((folder / "scene" / "scene.json").read_text())
    scene["views"] |= {EVIL: {"T_cam_key": EVIL, "K": 3}}
    (folder / "scene" / "scene.json").write_text(json.dumps(scene))
    (folder / "movers.json").write_text(json.dumps({"objects": [{"instance": EVIL}]}))
    for kind in ("depth", "depth_filled", "confidence", "age"):
        (folder / kind / "front.png").rename(folder / kind / "<b id=evil>.png")
    page = Opened(browser, write_report(folder)[0])
    assert page.page.locator("#evil").count() == 0 and page.told == [] and page.foreign() == []
    assert EVIL in page.text("#warnings")
    assert page.value("document.getElementById('camera').value") == "<b id=evil>"
    page.page.close()
