# SPDX-License-Identifier: MIT
"""What a run writes: exact formats, whole or not at all, the same bytes every time."""

from __future__ import annotations

import datetime
import json
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from densify.outputs.cloud_files import read_cloud, write_cloud
from densify.outputs.depth_png import (
    read_depth_png,
    write_age_png,
    write_confidence_png,
    write_depth_png,
)
from densify.outputs.key_outputs import check_writable, write_comparison, write_result
from tests.exported import CAMERAS, KEY_NS, H, W, cloud_of, refusal, result_of, tree

CONFIG = {"objective": {"alpha": 10.0, "radius_m": None}, "register": {"source": "kiss-icp"}}
MAPS = [f"{k}/{c}.png" for k in ("depth", "depth_filled", "confidence", "age") for c in CAMERAS]
RUN_FILES = [*MAPS, "cloud.laz", "metrics.json", "figure.png", "run.yaml"]


@pytest.fixture
def put(tmp_path):
    """Write a result under tmp_path/out."""
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 256, (H, W, 3), np.uint8) for name in CAMERAS}

    def write(result=None, **options):
        result = result or result_of()
        options = {"config": CONFIG, "data": "street", **options}
        return write_result(replace(result, images=images), tmp_path / "out", **options)

    return write


def stored(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


# --- maps -----------------------------------------------------------------------------------------


@given(values=arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_every_16_bit_value_is_a_depth_and_comes_back(values, tmp_path_factory):
    path = tmp_path_factory.mktemp("png") / "a.png"
    write_depth_png(path, values.astype(np.float32) / 256)
    np.testing.assert_array_equal(stored(path), values)
    depth = read_depth_png(path)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth * 256, values)


@pytest.mark.parametrize(
    ("write", "depth_m", "values", "expected"),
    [
        (write_depth_png, [255.99, 65535 / 256, 256, 400, 1 / 513, 1 / 511, 0], None,
         [65533, 65535, 0, 0, 0, 1, 0]),
        (write_confidence_png, [0, 5, 5, 5, 300, 1e-4], [1, 0, 0.5, 1, 1, 1],
         [0, 1, 128, 255, 0, 0]),
        (write_age_png, [0, 5, 5, 5, 5, 5, 300, 5],
         [np.nan, 0, 0.0004, 0.0006, 0.3, 65.533, 1, 1e6], [0, 1, 1, 2, 301, 65534, 0, 65535]),
    ],
)  # fmt: skip
def test_limits_of_the_formats(write, depth_m, values, expected, tmp_path):
    given = [np.array([v], np.float32) for v in (values, depth_m) if v is not None]
    write(tmp_path / "a.png", *given)
    steps = stored(tmp_path / "a.png")
    assert steps.dtype == (np.uint8 if write == write_confidence_png else np.uint16)
    np.testing.assert_array_equal(steps, [expected])


def test_values_that_are_no_depth(tmp_path):
    for bad in (np.nan, np.inf, -1.0):
        with pytest.raises(ValueError, match="finite depths, 0 or more"):
            write_depth_png(tmp_path / "a.png", np.array([[1, bad]], np.float32))
    assert not list(tmp_path.iterdir())


def test_the_official_depth_map_reencodes_to_the_same_pixels(tmp_path, test_data):
    path = test_data / "kitti/depth_annotated_sample/groundtruth_0000000050.png"
    depth = read_depth_png(path)
    assert 1 < depth[depth > 0].min() < depth.max() < 120
    write_depth_png(tmp_path / "a.png", depth)
    np.testing.assert_array_equal(stored(tmp_path / "a.png"), stored(path))
    # The header too: 16 bit, one gray channel, not interlaced.
    header = slice(16, 29)
    assert (tmp_path / "a.png").read_bytes()[header] == path.read_bytes()[header]


# --- cloud ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_points", [0, 1, 1000])
def test_cloud_comes_back(tmp_path, num_points):
    cloud = cloud_of(num_points)
    write_cloud(tmp_path / "cloud.laz", cloud, KEY_NS)
    back = read_cloud(tmp_path / "cloud.laz")
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=0.0005 + 1e-9)
    for name in ("frame", "moving", "instance", "confidence", "displaced", "rgb", "far"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    np.testing.assert_allclose(back.intensity, cloud.intensity, atol=1 / 65535)
    displacement = cloud.points - cloud.rigid_points
    np.testing.assert_array_equal(back.displacement, displacement.astype(np.float32))
    np.testing.assert_array_equal(back.stamp_ns, KEY_NS + cloud.since_key_ns)
    write_cloud(tmp_path / "again.laz", cloud, KEY_NS)
    assert (tmp_path / "again.laz").read_bytes() == (tmp_path / "cloud.laz").read_bytes()


def test_cloud_file_by_laspy(tmp_path):
    cloud = replace(cloud_of(3), intensity=np.array([0, 1, 2], np.float32))
    cloud = replace(cloud, since_key_ns=np.array([-100_000_000, 0, 200_000_000]))
    write_cloud(tmp_path / "cloud.laz", cloud, KEY_NS)
    las = laspy.read(tmp_path / "cloud.laz")
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
    assert list(las.header.scales) == [0.001] * 3
    assert las.header.creation_date == datetime.date(2011, 9, 26)
    np.testing.assert_array_equal(las.intensity, [0, 65535, 65535])
    np.testing.assert_array_equal(las.red, cloud.rgb[:, 0].astype(int) * 257)
    # Adjusted standard GPS time, as LAS 1.4 has it
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    epoch = datetime.datetime(1980, 1, 6) + datetime.timedelta(seconds=10**9)
    times = [epoch + datetime.timedelta(seconds=t) for t in las.gps_time.tolist()]
    said = [t.strftime("%m-%d %H:%M:%S.%f")[:-5] for t in times]
    assert said == ["09-26 14:14:11.0", "09-26 14:14:11.1", "09-26 14:14:11.3"]


def test_what_is_no_cloud_and_no_map(tmp_path):
    path = tmp_path / "cloud.laz"
    for bad in (np.nan, np.inf, 3e6):
        cloud = cloud_of(3)
        cloud.points[1, 2] = bad
        with pytest.raises(ValueError, match="finite points"):
            write_cloud(path, cloud)
    assert not list(tmp_path.iterdir())
    for image in (np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.uint16)):
        cv2.imwrite(str(tmp_path / "a.png"), image)
        with refusal(tmp_path / "a.png", "expected a depth map"):
            read_depth_png(tmp_path / "a.png")
    path.write_bytes(b"hello")
    with refusal(path):
        read_cloud(path)
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=7)).write(path)
    with refusal("confidence, displaced, ", "frame, instance, moving"):
        read_cloud(path)


# --- the folder of a key --------------------------------------------------------------------------


def test_result_is_written_as_the_contract_says(put, tmp_path):
    result = result_of()
    paths = put(result)
    folder = tmp_path / "out" / "000120"
    assert [p.relative_to(folder).as_posix() for p in paths] == RUN_FILES
    assert sorted(tree(tmp_path)) == sorted(f"out/000120/{name}" for name in RUN_FILES)
    for name, depth in result.depth.items():
        measured = read_depth_png(folder / "depth" / f"{name}.png")
        filled = read_depth_png(folder / "depth_filled" / f"{name}.png")
        near = depth.depth_m < 255  # farther is none in this format
        np.testing.assert_allclose(measured[near], depth.depth_m[near], atol=1 / 512)
        np.testing.assert_allclose(filled[near], depth.filled_m[near], atol=1 / 512)
        assert ((stored(folder / "confidence" / f"{name}.png") > 0) == (filled > 0)).all()
        age = stored(folder / "age" / f"{name}.png")
        assert ((age > 0) == (filled > 0)).all()
        np.testing.assert_allclose(age[age > 0], 1 + 1000 * depth.age_s[age > 0], atol=0.501)
    assert len(read_cloud(folder / "cloud.laz").points) == len(result.cloud)
    first = tree(tmp_path)
    put(overwrite=True)
    assert tree(tmp_path) == first
    paths = put(result_of(cameras=()), overwrite=True)
    assert [p.name for p in paths] == ["cloud.laz", "metrics.json", "run.yaml"]


def test_tables_are_plain_json_and_yaml(put, tmp_path):
    result = result_of(a=np.float32(0.5), b={"c": np.nan, "d": [np.int64(3), np.inf, (True, None)]})
    result = replace(result, baselines={"none": result_of("none", 1, a=1)})
    put(result, config=CONFIG | {"project": {"size": np.float64(3), "pair": (1, 2)}})
    folder = tmp_path / "out" / "000120"
    assert json.loads((folder / "metrics.json").read_text()) == {
        "schema_version": 1,
        "key": 120,
        "method": "flow",
        "frames": [119, 120, 121],
        "a": 0.5,
        "b": {"c": None, "d": [3, None, [True, None]]},
        "baselines": {"none": {"frames": [119, 120, 121], "a": 1}},
    }
    record = yaml.safe_load((folder / "run.yaml").read_text())
    assert (record["data"], record["method"]) == ("street", "flow")
    assert (record["frames"], record["cameras"]) == ([119, 120, 121], [*CAMERAS])
    assert record["config"] == CONFIG | {"project": {"size": 3.0, "pair": [1, 2]}}
    assert record["stages"][0] == {"name": "register", "seconds": 1.235, "peak_memory_mb": 512.3}
    assert record["versions"]["numpy"] == np.__version__


def test_existing_result_is_kept_or_replaced_with_the_rest_kept(put, tmp_path):
    put()
    before, folder = tree(tmp_path), tmp_path / "out" / "000120"
    with refusal(folder, "kept", "--overwrite", "cloud.laz"):
        put(result_of(seed=9))
    assert tree(tmp_path) == before
    with refusal("kept"):
        check_writable(tmp_path / "out", 120)
    check_writable(tmp_path / "out", 120, overwrite=True)
    check_writable(tmp_path / "out", 121)
    check_writable(tmp_path / "out", 120, verb="compare")
    (folder / "notes.txt").write_text("mine")
    put(result_of(seed=9, cameras=("image_02",)), overwrite=True)
    assert (folder / "notes.txt").read_text() == "mine"
    assert [p.name for p in (folder / "depth").iterdir()] == ["image_02.png"]


def test_places_that_cannot_be_written_to(put, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with refusal(f"{tmp_path / 'file'} is not a folder"):
        check_writable(tmp_path / "file" / "deeper", 120)
    put()
    denied: list[Path] = []
    monkeypatch.setattr(
        "densify.outputs.folders.os.access", lambda path, _: Path(path) not in denied
    )
    for place in (tmp_path / "out", tmp_path / "out" / "000120"):
        denied[:] = [place]
        with refusal(f"no permission to write in {place};"):
            check_writable(tmp_path / "out", 120, overwrite=True)


# --- comparison -----------------------------------------------------------------------------------


def compare(out: Path, overwrite: bool = False, seed: int = 0) -> list[Path]:
    results = {
        method: result_of(method, seed + i, ghost_rate=float("nan") if i == 0 else 0.1 * i)
        for i, method in enumerate(("none", "icp", "flow"))
    }
    return write_comparison(results, out, config=CONFIG, data="street", overwrite=overwrite)


def test_comparison_is_written_beside_the_run(put, tmp_path):
    put()
    run = tree(tmp_path)
    paths = compare(tmp_path / "out")
    folder = tmp_path / "out" / "000120"
    names = [p.relative_to(folder).as_posix() for p in paths]
    assert names[:2] == ["compare.json", "compare.png"]
    assert sorted(names[2:]) == sorted(f"compare/{n}" for n in [*MAPS, "cloud.laz"])
    assert {k: v for k, v in tree(tmp_path).items() if "compare" not in k} == run
    table = json.loads(paths[0].read_text())
    assert list(table["methods"]) == ["none", "icp", "flow"]
    assert table["methods"]["none"] == {"frames": [119, 120, 121], "ghost_rate": None}
    assert (table["schema_version"], table["key"], table["config"]) == (1, 120, CONFIG)
    with refusal("compare.json, compare.png, compare already there", "--overwrite"):
        compare(tmp_path / "out")
    before = paths[1].read_bytes()
    compare(tmp_path / "out", overwrite=True, seed=5)
    assert paths[1].read_bytes() != before
    assert (folder / "cloud.laz").is_file()
