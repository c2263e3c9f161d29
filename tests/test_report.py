# SPDX-License-Identifier: MIT
"""Pages as files: what they carry comes back, they stay small, and nothing in them can run."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from densify.dataset.report import write_report
from densify.outputs.cloud_files import read_cloud, write_cloud
from densify.outputs.depth_png import encode_png, read_stored
from densify.outputs.report_page import Blobs, packed_cloud, page_file, thinned
from tests.command import refused
from tests.exported import cloud_of
from tests.report_runs import write_compared, write_run

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
    assert len(thinned(points, moving, 40_000)) == 40_000
    rows = thinned(points, moving, 5000)
    assert len(rows) == 5000 and (np.diff(rows) > 0).all()
    assert moving[rows].sum() > 400
    assert np.array_equal(rows, thinned(points, moving, 5000))
    left = np.linalg.norm(points[rows], axis=1) > 40
    all_far = np.linalg.norm(points, axis=1) > 40
    assert left.mean() > 1.5 * all_far.mean()


def test_points_come_back_to_half_a_step(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.laz", cloud_of(3000))
    cloud, blobs = read_cloud(tmp_path / "cloud.laz"), Blobs()
    num_moving = int(cloud.moving.sum())
    entry = packed_cloud(blobs, cloud, [119, 120, 121], [2, 0])
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
    folder = write_compared(tmp_path)
    (page,) = write_report(tmp_path)
    assert page == folder / "compare.html"
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
