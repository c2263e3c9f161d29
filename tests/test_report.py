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

from densify.config.errors import InputError
from densify.dataset.report import write_report
from densify.outputs.cloud_files import StoredCloud, read_cloud, write_cloud
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


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_arrays_come_back(kind) -> None:
    array = np.random.default_rng(3).integers(0, np.iinfo(kind).max, (5, 11), kind, endpoint=True)
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


def stored_cloud(folder: Path, num_points: int) -> StoredCloud:
    write_cloud(folder / "cloud.laz", cloud_of(num_points))
    return read_cloud(folder / "cloud.laz")


def test_points_come_back_to_half_a_step(tmp_path: Path) -> None:
    cloud, blobs = stored_cloud(tmp_path, 3000), Blobs()
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
    expected = [
        number.get(i, 1) if m else 0 for i, m in zip(cloud.instance, cloud.moving, strict=True)
    ]
    assert np.array_equal(unpacked(blobs, entry["mover"]), np.array(expected)[nearest])
    displaced = np.stack([unpacked(blobs, e) for e in entry["displaced"]], axis=1) - 32768.0
    found = entry["displaced_step_m"] * displaced
    off_m = np.abs(found - cloud.displacement[nearest[:num_moving]])
    assert off_m.max() <= 0.51 * entry["displaced_step_m"]
    rgb = np.stack([unpacked(blobs, e) for e in entry["rgb"]], axis=1)
    observed = cloud.rgb.any(axis=1)[nearest]
    assert np.array_equal(rgb[observed], cloud.rgb[nearest][observed] >> 2)
    off = (
        unpacked(blobs, entry["confidence"]) / entry["confidence_steps"] - cloud.confidence[nearest]
    )
    assert np.abs(off).max() <= 0.5001 / entry["confidence_steps"]


class TestPage:
    def test_maps_come_back_as_the_files_have_them(self, run: Path) -> None:
        page = (run / "report.html").read_bytes()
        data, blobs = data_of(page), blobs_of(page)
        camera = data["cameras"]["front"]
        stored = {
            kind: read_stored(run / place / "front.png", bits, kind)
            for kind, place, bits in (
                ("depth", "depth", np.uint16),
                ("filled", "depth_filled", np.uint16),
                ("confidence", "confidence", np.uint8),
                ("age", "age", np.uint16),
                ("truth", "scene/truth", np.uint16),
                ("reason", "scene/reason", np.uint8),
                ("sweep", "scene/sweep", np.uint16),
                ("icp", "scene/icp", np.uint16),
                ("none", "scene/none", np.uint16),
            )
        }
        for kind in ("filled", "confidence", "truth", "reason"):
            assert np.array_equal(unpacked(blobs, camera[kind]), stored[kind]), kind
        assert list(camera["others"]) == ["none", "icp"]
        for method, entry in camera["others"].items():
            assert np.array_equal(unpacked(blobs, entry), stored[method])
        sources = np.array(camera["sources"])[unpacked(blobs, camera["source"])]
        assert np.array_equal(sources[..., 0], stored["sweep"])
        assert np.array_equal(sources[..., 1], stored["age"])
        assert np.array_equal(sources[..., 2] > 0, stored["depth"] > 0)
        sweeps = np.array([s["frame"] for s in data["sweeps"]])
        measured = stored["depth"] > 0
        assert set(sweeps[stored["sweep"][measured] - 1]) <= {1, 2, 3, 4, 5}
        assert data["missing"] == [] and data["cloud"]["num_all"] == len(
            read_cloud(run / "cloud.laz").points
        )

    def test_paths_lead_through_the_key(self, run: Path) -> None:
        """The car comes nearer at 4 m/s, and its way through the window is 0.4 s long."""
        mover = data_of((run / "report.html").read_bytes())["movers"][0]
        way = np.diff([p["position_m"] for p in mover["path"]], axis=0)
        speed = np.linalg.norm(mover["velocity_m_s"])
        assert len(way) == 4 and np.linalg.norm(way, axis=1) == pytest.approx(
            [0.1 * speed] * 4, abs=0.06
        )
        assert abs(speed - 8) < 0.3

    def test_a_comparison_has_all_methods(self, tmp_path: Path) -> None:
        folder = write_compared(tmp_path)
        (page,) = write_report(tmp_path)
        assert page == folder / "compare.html"
        data = data_of(page.read_bytes())
        assert list(data["methods"]) == ["none", "icp", "flow"] and data["method"] == "flow"
        assert list(data["cameras"]["front"]["others"]) == ["none", "icp"]
        assert data["cloud"]["displaced"] and data["about"]["stages"]


class TestNothingRuns:
    EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\u2028<!--&"

    def page(self) -> bytes:
        return page_file(self.EVIL, {"title": self.EVIL}, Blobs())

    def test_texts_cannot_end_their_element(self) -> None:
        text = self.page().decode()
        assert text.count("<script") == 2 and "<img" not in text and "onerror=alert(2)>" not in text
        assert "&lt;/script&gt;" in re.search("<title>(.*)</title>", text)[1]
        assert data_of(text.encode())["title"] == self.EVIL

    def test_the_policy_allows_this_script_and_style_alone(self) -> None:
        text = self.page().decode()
        policy = re.search('Content-Security-Policy" content="(.*?)"', text)[1]
        rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
        assert rules["default-src"] == "'none'" and rules["img-src"] == "data: blob:"
        for rule, part in (
            ("script-src", "<script>(.*?)</script>"),
            ("style-src", "<style>(.*?)</style>"),
        ):
            content = re.search(part, text, re.DOTALL)[1]
            digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
            assert rules[rule] == f"'sha256-{digest}'"
        assert not re.search("https?://", text)


class TestErrors:
    @pytest.mark.parametrize(
        ("name", "content", "words"),
        [
            ("run.yaml", None, "no run.yaml in it|none of these"),
            ("run.yaml", b"a: [", "not YAML"),
        ],
    )
    def test_what_cannot_be_a_run(self, name, content, words, run, tmp_path, capsys) -> None:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        assert re.search(words, refused(capsys, 2, "report", tmp_path))
        assert "no such folder" in refused(capsys, 2, "report", tmp_path / "nothing")

    def test_neither_maps_nor_cloud(self, run: Path, tmp_path: Path) -> None:
        (tmp_path / "run.yaml").write_bytes((run / "run.yaml").read_bytes())
        with pytest.raises(InputError, match="no depth map and no cloud"):
            write_report(tmp_path)
        assert not (tmp_path / "report.html").exists()

    def test_a_map_of_another_size_is_left_out(self, tmp_path: Path) -> None:
        folder = write_run(tmp_path, report=False)
        (folder / "confidence" / "front.png").write_bytes(encode_png(np.zeros((3, 3), np.uint8)))
        (folder / "age" / "front.png").write_bytes(b"no image")
        (folder / "metrics.json").write_bytes(b"{")
        (page,) = write_report(folder)
        told = data_of(page.read_bytes())["missing"]
        assert "confidence/front.png: not as large as the others; left out" in told
        assert any(t.startswith("age/front.png: not a complete image") for t in told)
        assert any("metrics.json" in t for t in told) and len(told) == 3
        assert str(tmp_path) not in " ".join(told)
