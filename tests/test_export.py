# SPDX-License-Identifier: MIT
"""Exports of a finished run: what thresholds leave, read back by other libraries."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from plyfile import PlyData

import densify
from densify.config.plugins import EXPORTS
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import (
    read_depth_png,
    stored_age,
    stored_confidence,
    write_depth_png,
)
from densify.outputs.finished_run import FinishedRun, Thresholds, export_run
from densify.readers.depth_trees import pair_depth_files
from tests.command import exit_code
from tests.command import refused as refused_command
from tests.exported import (
    CAMERAS,
    KEY_NS,
    NUM_POINTS,
    STAMPS_NS,
    H,
    W,
    refused,
    result_of,
    tree,
    write_views,
)

COLUMNS = {
    **dict.fromkeys(("x", "y", "z", "intensity", "confidence", "displaced"), np.float32),
    **dict.fromkeys(("displaced_x", "displaced_y", "displaced_z"), np.float32),
    **dict.fromkeys(("frame", "instance"), np.int32),
    **dict.fromkeys(("red", "green", "blue", "moving", "far"), np.uint8),
    "gps_time": np.float64,
}
PACKAGES = {"exr": "OpenEXR", "wai": "OpenEXR", "rrd": "rerun", "mcap": "foxglove"}

EXTRAS = {"rrd": "rerun", "wai": "exr"}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_views(tmp_path / "run", {"image_02": "plain", "image_03": "plain"})[0]


def stored(folder: Path, product: str, camera: str = "image_02") -> np.ndarray:
    return cv2.imread(str(folder / product / f"{camera}.png"), cv2.IMREAD_UNCHANGED)


def expected_columns(run: Path) -> dict[str, np.ndarray]:
    cloud = read_cloud(run / "cloud.laz")
    values = {n: getattr(cloud, n) for n in COLUMNS if hasattr(cloud, n)}
    values |= dict(zip("xyz", cloud.points.T, strict=True))
    values |= dict(zip(("red", "green", "blue"), cloud.rgb.T, strict=True))
    values |= {f"displaced_{axis}": cloud.displacement[:, i] for i, axis in enumerate("xyz")}
    return {name: values[name].astype(kind) for name, kind in COLUMNS.items()}


# --- every form -----------------------------------------------------------------------------------


@pytest.mark.parametrize("to", EXPORTS)
def test_a_form_is_whole_repeatable_and_leaves_the_run_alone(to: str, run: Path) -> None:
    pytest.importorskip(PACKAGES.get(to, "numpy"), reason=f"{PACKAGES.get(to)} is not installed")
    before = tree(run)
    exported = export_run(run, to)
    folder, form = run / "export" / to, EXPORTS[to]
    assert {p.relative_to(folder).parts[0] for p in exported.paths} <= {*form.owned, "export.yaml"}
    after = tree(run)
    assert {n: d for n, d in after.items() if not n.startswith("export/")} == before
    refused(folder, "--overwrite", run=run, to=to)
    (folder / "notes.txt").write_text("mine")
    export_run(run, to, overwrite=True)
    again = tree(run)
    assert again.pop(f"export/{to}/notes.txt") == b"mine"
    assert set(again) == set(after)
    if to not in ("exr", "rrd", "wai"):  # may hold the moment or the process that wrote it
        assert again == after


@pytest.mark.parametrize("to", PACKAGES)
def test_a_package_that_is_not_installed_is_named(to: str, run: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, PACKAGES[to], None)
    refused(f"pip install '.[{EXTRAS.get(to, to)}]'", run=run, to=to)


def test_the_command_and_the_record(run: Path, capsys) -> None:
    assert "expected one of npy" in refused_command(capsys, 2, "export", run, "--to", "obj")
    options = ["--camera", "image_03", "--min-confidence", "0.5", "--max-age-ms", "100"]
    assert exit_code("export", run, "--to", "npy", *options) == 0
    named = [line for line in capsys.readouterr().out.splitlines() if line.endswith(".npy")]
    assert len(named) == 3 and all("image_03" in name for name in named)
    record = yaml.safe_load((run / "export" / "npy" / "export.yaml").read_text())
    density = record.pop("density")
    assert [*density] == ["image_03"]
    assert all(0 < p["after"] < p["before"] < 1 for p in density["image_03"].values())
    asked = {"to": "npy", "min_confidence": 0.5, "max_age_ms": 100.0}
    assert record == {"run": str(run), **asked, "version": densify.__version__}


# --- maps -----------------------------------------------------------------------------------------


def test_exr_holds_the_values_of_npy(run: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    paths, twins = export_run(run, "npy").paths, export_run(run, "exr").paths
    for path, twin in zip(paths[:-1], twins[:-1], strict=True):  # without the record
        ((channel, pixels),) = exr.File(str(twin)).channels().items()
        assert channel == ("Y" if "confidence" in twin.parts else "Z")
        np.testing.assert_array_equal(pixels.pixels, np.load(path))


@pytest.mark.parametrize(("confidence", "age_ms"), [(0, None), (0.5, None), (0.3, 100.0)])
def test_thresholds_leave_exactly_these_pixels(run: Path, confidence: float, age_ms) -> None:
    exported = export_run(run, "npy", min_confidence=confidence, max_age_ms=age_ms)
    for camera in CAMERAS:
        keep = stored(run, "confidence", camera) >= stored_confidence(confidence)
        if age_ms is not None:
            keep &= stored(run, "age", camera) <= stored_age(age_ms / 1000)
        for name, product in (("depth", "measured"), ("depth_filled", "filled")):
            whole_m = read_depth_png(run / name / f"{camera}.png")
            left_m = np.load(run / "export" / "npy" / name / f"{camera}.npy")
            assert left_m.dtype == np.float32
            np.testing.assert_array_equal(left_m, np.where(keep, whole_m, 0))
            kept = exported.density[camera][product]
            assert kept == (np.mean(whole_m > 0), np.mean(left_m > 0))
        certain = np.maximum(stored(run, "confidence", camera).astype(np.float32) - 1, 0) * keep
        left = np.load(run / "export" / "npy" / "confidence" / f"{camera}.npy")
        np.testing.assert_array_equal(left, certain / np.float32(254))


def test_a_prior_does_not_bring_back_what_a_threshold_leaves_out(run: Path) -> None:
    whole_m = read_depth_png(run / "depth_filled" / "image_02.png")
    (run / "depth_full").mkdir()
    completed_m = np.where(whole_m > 0, whole_m, np.float32(7))
    write_depth_png(run / "depth_full" / "image_02.png", completed_m)
    keep = stored(run, "confidence", "image_02") >= stored_confidence(0.5)
    expected_m = np.where(whole_m > 0, np.where(keep, whole_m, 0), 7)
    full_m = FinishedRun(run, Thresholds(min_confidence=0.5)).full_m("image_02")
    np.testing.assert_array_equal(full_m, expected_m)
    assert (full_m == 0).any() and (full_m == 7).any()


def test_kitti_is_what_readers_of_the_benchmark_expect(tmp_path: Path) -> None:
    """files.txt as Depth-Anything V2 (metric_depth/dataset/kitti.py), UniDepth and Marigold (with
    the filled map third) split it; annotations.json as Metric3D (mono/utils/custom_data.py)."""
    lenses = {"image_02": "plain", "image_03/0000000241": "bent"}
    single = {"none": result_of("none", 7, cameras=(*lenses,))}
    run, result = write_views(tmp_path, lenses, baselines=single)
    name = "2011_09_26_drive_0013_sync"
    record = run / "run.yaml"
    record.write_text(record.read_text().replace("data: street", f"data: /some/where/{name}/"))
    export_run(run, "kitti", tmp_path / "a")
    out = tmp_path / "a"
    pairs = pair_depth_files(run, out, None, filled=False)
    assert len(pairs.pairs) == 2
    assert [len(pairs.without_truth), len(pairs.without_prediction)] == [0, 0]
    lines = (out / "files.txt").read_text().splitlines()
    entries = json.loads((out / "annotations.json").read_text())["files"]
    views = (("image_02", "0000000120"), ("image_03/0000000241", "0000000241"))
    for (view, file), line, entry in zip(views, lines, entries, strict=True):
        camera, known = view.partition("/")[0], result.views[view].camera
        image, depth, filled = line.split(" ")
        assert image == f"val/{name}/{camera}/data/{file}.png" == entry["rgb"]
        assert entry["depth"] == depth and entry["cam_in"] == [17.25, 18.5, 9.125, 5.75]
        for path, product in ((depth, "depth"), (filled, "depth_filled")):
            steps = cv2.imread(str(out / path), cv2.IMREAD_UNCHANGED).astype("float32")
            depth_m = read_depth_png(run / product / f"{view}.png")
            np.testing.assert_array_equal(steps / entry["depth_scale"], depth_m)
        raw = out / f"val/{name}/proj_depth/velodyne_raw/{camera}/{file}.png"
        assert raw.read_bytes() == (run / f"scene/none/{view}.png").read_bytes()
        shown = cv2.imread(str(run / f"scene/image/{view}.jpg"))
        np.testing.assert_array_equal(cv2.imread(str(out / image)), shown)
        K = np.loadtxt(out / f"val/{name}/intrinsics/{camera}/{file}.txt").reshape(3, 3)
        np.testing.assert_allclose(K, known.K, atol=1e-6)


# --- clouds ---------------------------------------------------------------------------------------


def test_ply_by_plyfile_and_trimesh(run: Path) -> None:
    path = export_run(run, "ply").paths[0]
    vertex = PlyData.read(path)["vertex"].data
    assert set(vertex.dtype.names) == set(COLUMNS)
    for name, values in expected_columns(run).items():
        assert vertex[name].dtype.base == np.dtype(COLUMNS[name]), name
        np.testing.assert_array_equal(vertex[name], values, err_msg=name)
    loaded = pytest.importorskip("trimesh").load(path)
    np.testing.assert_array_equal(loaded.vertices, np.stack([vertex[a] for a in "xyz"], axis=1))
    np.testing.assert_array_equal(loaded.colors[:, 1], vertex["green"])


def test_pcd_by_pypcd4(run: Path) -> None:
    from pypcd4 import Encoding, PointCloud

    cloud = PointCloud.from_path(export_run(run, "pcd").paths[0])
    expected = expected_columns(run)
    assert cloud.metadata.data == Encoding.BINARY and cloud.points == NUM_POINTS
    rgb = [expected.pop(name) for name in ("red", "green", "blue")]
    assert set(cloud.fields) == {*expected, "rgb"}
    for name, column in expected.items():
        assert cloud.pc_data[name].dtype == column.dtype, name
        np.testing.assert_array_equal(cloud.pc_data[name], column, err_msg=name)
    packed = cloud.pc_data["rgb"].view(np.uint32)  # as the Point Cloud Library packs it
    for column, bits in zip(rgb, (16, 8, 0), strict=True):
        np.testing.assert_array_equal(packed >> bits & 255, column)


@pytest.mark.parametrize(("confidence", "age_ms"), [(0.5, None), (0.3, 95)])
def test_thresholds_leave_exactly_these_points(run: Path, confidence: float, age_ms) -> None:
    exported = export_run(run, "ply", min_confidence=confidence, max_age_ms=age_ms)
    cloud = read_cloud(run / "cloud.laz")
    keep = stored_confidence(cloud.confidence) >= stored_confidence(confidence)
    if age_ms is not None:
        age_ns = np.array([abs(STAMPS_NS[f] - KEY_NS) for f in cloud.frame.tolist()])
        keep &= age_ns <= age_ms * 1e6
    vertex = PlyData.read(exported.paths[0])["vertex"].data
    np.testing.assert_array_equal(vertex["confidence"], cloud.confidence[keep])
    assert exported.num_points == (NUM_POINTS, keep.sum()) and 0 < keep.sum() < NUM_POINTS


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"min_confidence": 1.01}, "--min-confidence 1.01"),
        ({"min_confidence": float("nan")}, "--min-confidence nan"),
        ({"max_age_ms": -1}, "--max-age-ms -1"),
        ({"max_age_ms": float("inf")}, "--max-age-ms inf"),
        ({"cameras": ["image_09"]}, "camera image_09: expected one of image_02, image_03"),
        ({"run": Path("absent")}, "no run.yaml"),
        ({"out": Path("."), "overwrite": True}, "holds a run and is kept"),
        ({"out": Path("run.yaml/x")}, "not a folder"),
    ],
)
def test_arguments_out_of_range(arguments, words: str, run: Path, monkeypatch) -> None:
    monkeypatch.chdir(run)
    refused(words, **{"run": run, "to": "npy", **arguments})


@pytest.mark.parametrize("product", ["depth", "confidence"])
def test_maps_that_are_damaged_or_missing_or_of_another_run(product: str, run: Path) -> None:
    path = run / product / "image_03.png"
    values, data = stored(run, product, "image_03"), path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    refused(path, "not a complete image", run=run, to="npy")
    cv2.imwrite(str(path), values[:, :-1])
    refused("does not belong to the others", run=run, to="npy")
    cv2.imwrite(str(path), values.astype(np.uint16 if product == "confidence" else np.uint8))
    refused(path, f"expected a map of {product}", run=run, to="npy")
    if product == "confidence":
        cv2.imwrite(str(path), np.where(values > 0, 0, values))
        refused(path, "does not belong to the others", run=run, to="npy")
        path.unlink()
        refused(path, run=run, to="npy")


def test_a_video_has_a_frame_for_each_map_and_a_growing_bar(tmp_path: Path) -> None:
    folder, _ = write_views(tmp_path, {f"image_02/{n}": "plain" for n in range(3)})
    export_run(folder, "mp4", tmp_path / "out")
    video = cv2.VideoCapture(str(tmp_path / "out" / "video" / "image_02.mp4"))
    frames = [frame for read, frame in iter(video.read, (False, None)) if read]
    assert len(frames) == 3 and frames[0].shape == (2 * H + 6, W, 3)
    white_px = [(frame[-3] > 128).all(axis=-1).sum() for frame in frames]
    assert white_px == sorted(white_px) and white_px[-1] > white_px[0]


def test_a_finished_run_gives_back_its_arrays(tmp_path: Path) -> None:
    folder, result = write_views(tmp_path, {"image_02": "plain"})
    loaded, expected = densify.load_result(folder), result.depth["image_02"]
    maps = loaded.depth["image_02"]
    for depth_m, expected_m in (
        (maps.depth_m, expected.depth_m),
        (maps.filled_m, expected.filled_m),
    ):
        storable_m = np.where(expected_m < 255.9, expected_m, 0)
        np.testing.assert_allclose(depth_m, storable_m, atol=1 / 256)
    seen = maps.filled_m > 0
    np.testing.assert_allclose(maps.confidence[seen], expected.confidence[seen], atol=1 / 254)
    assert not maps.confidence[~seen].any() and not maps.age_s[~seen].any()
    np.testing.assert_allclose(loaded.cloud.points, result.cloud.points, atol=5e-4)
    assert "key 120" in repr(loaded) and "key 120" in repr(result)
