# SPDX-License-Identifier: MIT
"""Pages as files and in a real browser: what they carry and show is what the files say, they stay
small, and nothing in them can run."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from densify.config import as_mapping, resolve
from densify.dataset.report import write_report
from densify.geometry.types import Result
from densify.outputs.cloud_files import read_cloud, write_cloud
from densify.outputs.depth_png import encode_png, read_stored
from densify.outputs.finished_run import export_run
from densify.outputs.key_outputs import write_comparison, write_result
from densify.outputs.report_page import Blobs, pack_cloud, page_file, thin_cloud
from densify.pipeline.run import compare
from densify.readers.decoded_files import decode_image
from tests.command import refused
from tests.exported import cloud_of
from tests.small_street import KEY, POSES_GIVEN, one_car

CONFIG = POSES_GIVEN | {"output": {"report": True, "rejected": True}}
FOLDER = f"{KEY:06d}"


@cache
def results() -> dict[str, Result]:
    return compare(one_car(), KEY, 2, config=CONFIG, methods=("none", "icp", "flow"))


def write_run(out: Path, report: bool = True) -> Path:
    """The key's folder."""
    config = as_mapping(resolve(CONFIG if report else POSES_GIVEN))
    write_result(results()["flow"], out, config=config, data="tiny street")
    return out / FOLDER


KINDS = {1: np.uint8, 2: np.uint16, 4: np.uint32}


def unpacked(blobs: Blobs, entry) -> np.ndarray:
    """As page/unpack.js does it."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(blobs.texts[entry["blob"]])), np.uint8)
    values = np.zeros(planes.size // entry["bytes"], KINDS[entry["bytes"]])
    for place, plane in enumerate(planes.reshape(entry["bytes"], -1)):
        values += plane.astype(values.dtype) << values.dtype.type(8 * place)
    values = values.reshape(entry["shape"])
    return np.cumsum(values, axis=-1, dtype=values.dtype) if entry["delta"] else values


def data_of(page: bytes) -> dict:
    return json.loads(re.search(rb'id="page-data">(.*?)</script>', page, re.DOTALL)[1])


def blobs_of(page: bytes) -> Blobs:
    blobs = Blobs()
    found = re.findall(r'<script type="text/plain" id="(.*?)">(.*?)</script>', page.decode())
    blobs.texts.update(found)
    return blobs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run"))


def test_arrays_come_back() -> None:
    rng = np.random.default_rng(3)
    for kind in KINDS.values():
        array = rng.integers(0, np.iinfo(kind).max, (5, 11), kind, endpoint=True)
        for values in (array, np.cumsum(array // 64, axis=-1, dtype=kind)):  # smooth; wraps around
            blobs = Blobs()
            assert np.array_equal(unpacked(blobs, blobs.add(values)), values)


def test_thinning_keeps_moving_and_distant_points() -> None:
    rng = np.random.default_rng(1)
    points, moving = rng.normal(0, [30, 30, 2], (40_000, 3)), np.arange(40_000) < 500
    assert len(thin_cloud(points, moving, 40_000)) == 40_000
    rows = thin_cloud(points, moving, 5000)
    assert len(rows) == 5000 and (np.diff(rows) > 0).all()
    assert moving[rows].sum() > 400
    assert np.array_equal(rows, thin_cloud(points, moving, 5000))
    left = np.linalg.norm(points[rows], axis=1) > 40
    all_far = np.linalg.norm(points, axis=1) > 40
    assert left.mean() > 1.5 * all_far.mean()


def test_points_come_back_to_half_a_step(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.laz", cloud_of(3000))
    cloud, blobs = read_cloud(tmp_path / "cloud.laz"), Blobs()
    num_moving = int(cloud.moving.sum())
    entry = pack_cloud(blobs, cloud, [119, 120, 121], [2, 0])
    assert (entry["num_points"], entry["num_all"]) == (3000, 3000)
    assert entry["num_moving"] == num_moving and entry["step_m"] < 0.0035
    places = np.stack([unpacked(blobs, e) for e in entry["places"]], axis=1)
    points = np.array(entry["low_m"]) + entry["step_m"] * places
    nearest = [np.abs(cloud.points - p).max(axis=1).argmin() for p in points]
    assert sorted(nearest) == list(range(3000))
    assert np.abs(cloud.points[nearest] - points).max() <= 0.5001 * entry["step_m"]
    assert np.array_equal(unpacked(blobs, entry["sweep"]), cloud.frame[nearest] - 119)
    number = {2: 2, 0: 3}  # the others have no number
    pairs = zip(cloud.instance.tolist(), cloud.moving.tolist(), strict=True)
    expected = np.array([number.get(i, 1) if moves else 0 for i, moves in pairs])
    assert np.array_equal(unpacked(blobs, entry["mover"]), expected[nearest])
    displaced = np.stack([unpacked(blobs, e) for e in entry["displaced"]], axis=1) - 32768.0
    off_m = entry["displaced_step_m"] * displaced - cloud.displacement[nearest[:num_moving]]
    assert np.abs(off_m).max() <= 0.51 * entry["displaced_step_m"]
    rgb = np.stack([unpacked(blobs, e) for e in entry["rgb"]], axis=1)
    observed = cloud.observed[nearest]
    assert np.array_equal(rgb[observed], cloud.rgb[nearest][observed] >> 2)
    confidence = unpacked(blobs, entry["confidence"]) / entry["confidence_steps"]
    off = np.abs(confidence - cloud.confidence[nearest])
    assert off.max() <= 0.5001 / entry["confidence_steps"]


def test_maps_come_back_as_the_files_have_them(run: Path) -> None:
    page = (run / "report.html").read_bytes()
    data, blobs = data_of(page), blobs_of(page)
    camera = data["cameras"]["front"]

    def stored(place: str, bits=np.uint16) -> np.ndarray:
        return read_stored(run / place / "front.png", bits, place)

    assert np.array_equal(unpacked(blobs, camera["filled"]), stored("depth_filled"))
    assert np.array_equal(unpacked(blobs, camera["truth"]), stored("scene/truth"))
    for kind, place in (("confidence", "confidence"), ("reason", "scene/reason")):
        assert np.array_equal(unpacked(blobs, camera[kind]), stored(place, np.uint8)), kind
    assert list(camera["others"]) == ["none", "icp"]
    for method, entry in camera["others"].items():
        assert np.array_equal(unpacked(blobs, entry), stored(f"scene/{method}"))
    sources = np.array(camera["sources"])[unpacked(blobs, camera["source"])]
    assert np.array_equal(sources[..., 0], stored("scene/sweep"))
    assert np.array_equal(sources[..., 1], stored("age"))
    assert np.array_equal(sources[..., 2] > 0, stored("depth") > 0)
    sweeps = np.array([s["frame"] for s in data["sweeps"]])
    assert set(sweeps[sources[..., 0][stored("depth") > 0] - 1]) <= {1, 2, 3, 4, 5}
    assert data["missing"] == []
    assert data["cloud"]["num_all"] == len(read_cloud(run / "cloud.laz").points)


def test_paths_lead_through_the_key(run: Path) -> None:
    """The car comes nearer at 4 m/s, and its way through the window is 0.4 s long."""
    mover = data_of((run / "report.html").read_bytes())["movers"][0]
    steps_m = np.diff([p["position_m"] for p in mover["path"]], axis=0)
    speed = np.linalg.norm(mover["velocity_m_s"])
    assert len(steps_m) == 4 and abs(speed - 8) < 0.3
    assert np.linalg.norm(steps_m, axis=1) == pytest.approx([0.1 * speed] * 4, abs=0.06)


def test_a_comparison_has_all_methods(tmp_path: Path) -> None:
    config = as_mapping(resolve(POSES_GIVEN))
    write_comparison(results(), tmp_path, config=config, data="tiny street")
    (page,) = write_report(tmp_path)
    assert page == tmp_path / FOLDER / "compare.html"
    data = data_of(page.read_bytes())
    assert list(data["methods"]) == ["none", "icp", "flow"] and data["method"] == "flow"
    assert list(data["cameras"]["front"]["others"]) == ["none", "icp"]
    assert data["cloud"]["displaced"] and data["about"]["stages"]


EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\u2028<!--&"


def test_nothing_runs_but_this_script() -> None:
    text = page_file(EVIL, {"title": EVIL}, Blobs()).decode()
    assert text.count("<script") == 2 and "<img" not in text and "onerror=alert(2)>" not in text
    assert "&lt;/script&gt;" in re.search("<title>(.*)</title>", text)[1]
    assert data_of(text.encode())["title"] == EVIL
    policy = re.search('Content-Security-Policy" content="(.*?)"', text)[1]
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data: blob:"
    for rule, tag in (("script-src", "script"), ("style-src", "style")):
        content = re.search(f"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    assert not re.search("https?://", text)


def test_what_cannot_be_a_run(run: Path, tmp_path: Path, capsys) -> None:
    assert "no such folder" in refused(capsys, 2, "report", tmp_path / "nothing")
    assert "holds none of these" in refused(capsys, 2, "report", tmp_path)
    (tmp_path / "run.yaml").write_bytes(b"a: [")
    assert "not YAML" in refused(capsys, 2, "report", tmp_path)
    (tmp_path / "run.yaml").write_bytes((run / "run.yaml").read_bytes())
    assert "no depth map and no cloud" in refused(capsys, 2, "report", tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_a_map_of_another_size_is_left_out(tmp_path: Path) -> None:
    folder = write_run(tmp_path, report=False)
    (folder / "confidence" / "front.png").write_bytes(encode_png(np.zeros((3, 3), np.uint8)))
    (folder / "age" / "front.png").write_bytes(b"no image")
    (folder / "metrics.json").write_bytes(b"{")
    (page,) = write_report(folder)
    missing = data_of(page.read_bytes())["missing"]
    assert "confidence/front.png: not as large as the others; left out" in missing
    assert any(line.startswith("age/front.png: not a complete image") for line in missing)
    assert any("metrics.json" in line for line in missing) and len(missing) == 3
    assert str(tmp_path) not in " ".join(missing)


# --- in a real Chromium, without a network and with software for a GPU ----------------------------


NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OPTIONS = (
    *("--no-sandbox", "--ignore-gpu-blocklist", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-dev-shm-usage"),
)


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of playwright; the test is skipped where there is none."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed (Debian: apt-get install chromium)")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield browser
        browser.close()


class Opened:
    """A page from disk. told: what it said on the console. asked: what it requested."""

    def __init__(self, browser: Any, path: Path, width: int = 1200) -> None:
        self.told: list[str] = []
        self.asked: list[str] = []
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.page.on("console", lambda message: self.told.append(message.text))
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.told.append("dialog"), dialog.dismiss()))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("html[data-ready=yes]", state="attached", timeout=60_000)

    def value(self, code: str) -> Any:
        """Of an expression in the page."""
        return self.page.evaluate(code)

    def set(self, name: str, value: object) -> None:
        """A control, as a person would move it, and the next two frames."""
        self.value(
            f"""(() => {{ const c = document.getElementById({name!r}); c.value = {str(value)!r};
            for (const kind of ["input", "change"]) c.dispatchEvent(new Event(kind)); }})()"""
        )
        self.settle()

    def settle(self) -> None:
        frames = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.value(frames)

    def picture(self, selector: str) -> bytes:
        """PNG of what is seen of an element."""
        return self.page.locator(selector).screenshot()

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()

    def problems(self) -> list[str]:
        return self.page.locator("#problems p").all_inner_texts()

    def foreign(self) -> list[str]:
        """Requests for anything but itself and what it has in itself."""
        return [u for u in self.asked[1:] if not u.startswith(("data:", "blob:"))]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as program:
        yield program


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


def test_it_begins_with_rigid_accumulation_from_red_to_blue(opened: Opened) -> None:
    chosen = [opened.value(f"$('{name}').value") for name in ("left", "right", "palette")]
    assert chosen == ["icp", "measured", "turbo"]


def test_few_pixels_no_warnings_and_a_narrow_screen(browser: Any, run: Path, tmp_path: Path):
    folder = shutil.copytree(run, tmp_path / FOLDER)
    metrics = json.loads((folder / "metrics.json").read_text())
    moving = metrics["depth"]["front"]["measured"]["moving"]
    moving |= {"num_compared": 199, "outliers": 0.4321}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    about = yaml.safe_load((folder / "run.yaml").read_text()) | {"warnings": []}
    (folder / "run.yaml").write_text(yaml.safe_dump(about))
    page = Opened(browser, write_report(folder, overwrite=True)[0], width=400)
    scores = page.text("#score-tables")
    assert "43.21" not in scores and "–: fewer than 200 pixels to judge." in scores
    assert page.text("#warnings") == "There are no warnings."
    assert page.value("document.documentElement.scrollWidth") <= 400
    heights_px = "[...document.querySelectorAll('#scores th, #cost th')].map((t) => t.offsetHeight)"
    assert max(page.value(heights_px)) < 100  # at most four lines
    page.page.close()


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
    opened.set("palette", "viridis")
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


EVIL_NAME = '</script><img src=x onerror="alert(1)"><b id=evil>'


def test_texts_of_others_stay_texts(browser: Any, tmp_path: Path) -> None:
    folder = write_run(tmp_path, report=False)
    about = yaml.safe_load((folder / "run.yaml").read_text())
    about |= {
        "data": EVIL_NAME,
        "warnings": [EVIL_NAME],
        "versions": {EVIL_NAME: EVIL_NAME},
        "method": EVIL_NAME,
    }
    about["config"][EVIL_NAME] = {EVIL_NAME: EVIL_NAME}
    about["stages"] = [{"name": EVIL_NAME, "seconds": EVIL_NAME, "peak_memory_mb": None}]
    (folder / "run.yaml").write_text(yaml.safe_dump(about))
    scene = json.loads((folder / "scene" / "scene.json").read_text())
    scene["views"] |= {EVIL_NAME: {"T_cam_key": EVIL_NAME, "K": 3}}
    (folder / "scene" / "scene.json").write_text(json.dumps(scene))
    (folder / "movers.json").write_text(json.dumps({"objects": [{"instance": EVIL_NAME}]}))
    for kind in ("depth", "depth_filled", "confidence", "age"):
        (folder / kind / "front.png").rename(folder / kind / "<b id=evil>.png")
    page = Opened(browser, write_report(folder)[0])
    assert page.page.locator("#evil").count() == 0 and page.told == [] and page.foreign() == []
    assert EVIL_NAME in page.text("#warnings")
    assert page.value("document.getElementById('camera').value") == "<b id=evil>"
    page.page.close()
