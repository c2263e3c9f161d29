# SPDX-License-Identifier: MIT
"""What is written: exact formats, whole or not at all, the same bytes every time."""

import datetime
import errno
import json
import os
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

from densify.config.errors import InputError
from densify.geometry.types import Cloud, DepthMap, Result, StageCost
from densify.outputs import (
    check_writable,
    cloud_laz,
    depth_maps,
    draw_figure,
    figure,
    read_cloud,
    read_depth_png,
    run_yaml,
    write_age_png,
    write_cloud,
    write_comparison,
    write_confidence_png,
    write_depth_png,
    write_result,
)
from densify.outputs.atomic import staged_folder

H, W = 12, 20
CONFIG = {"objective": {"alpha": 10.0, "radius_m": None}, "register": {"source": "kiss-icp"}}
RUN_FILES = [
    *(f"{kind}/{camera}.png" for kind in ("depth", "depth_filled", "confidence", "age")
      for camera in ("image_02", "image_03")),
    *("cloud.laz", "metrics.json", "figure.png", "run.yaml"),
]  # fmt: skip


def cloud_of(num_points, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-90, 90, (num_points, 3))
    moving = rng.random(num_points) < 0.5
    return Cloud(
        points=points,
        rigid_points=points - 0.3 * moving[:, None],
        frame=rng.integers(115, 126, num_points, dtype=np.int32),
        since_key_ns=np.zeros(num_points, np.int64),
        row=np.arange(num_points),
        lidar=np.zeros(num_points, np.uint8),
        moving=moving,
        instance=np.where(moving, 4, -1).astype(np.int32),
        velocity_m_s=np.zeros((num_points, 3), np.float32),
        confidence=rng.random(num_points, dtype=np.float32),
        intensity=rng.random(num_points, dtype=np.float32),
        rgb=rng.integers(0, 256, (num_points, 3), dtype=np.uint8),
        far=rng.random(num_points) < 0.5,
    )


def map_of(camera, seed=0):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((H, W)) < 0.4, rng.uniform(2, 80, (H, W)), 0).astype(np.float32)
    filled = np.where(depth > 0, depth, np.float32(rng.random() * 30))
    filled[0] = depth[0]
    frame = np.where(depth > 0, rng.integers(119, 122, (H, W)), -1).astype(np.int32)
    confidence = rng.random((H, W), dtype=np.float32)
    age_s = np.where(filled > 0, rng.uniform(0, 0.5, (H, W)), np.nan).astype(np.float32)
    return DepthMap(camera, depth, filled, confidence, frame, age_s=age_s)


def result_of(method="flow", seed=0, cameras=("image_02", "image_03"), **metrics):
    return Result(
        method=method,
        key=120,
        frames=(119, 120, 121),
        cloud=cloud_of(50, seed),
        depth={name: map_of(name, seed + i) for i, name in enumerate(cameras)},
        metrics=metrics or {"ghost_rate": 0.01},
        costs=(StageCost("register", 1.23456, 512.34), StageCost("flow", 2.0, 600.0)),
    )


@pytest.fixture
def images():
    rng = np.random.default_rng(1)
    return {name: rng.integers(0, 256, (H, W, 3), np.uint8) for name in ("image_02", "image_03")}


@pytest.fixture
def put(tmp_path, images):
    """Write a result under tmp_path/out."""

    def write(result=None, **options):
        result = result or result_of()
        return write_result(
            result, images, tmp_path / "out", **{"config": CONFIG, "data": "street"} | options
        )

    return write


def tree(folder):
    """Every file below a folder, hidden ones included, with its bytes."""
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def one_line(error, *parts):
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message


# Depth and confidence


@given(values=arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_every_16_bit_value_is_a_depth_and_comes_back(values, tmp_path_factory):
    path = tmp_path_factory.mktemp("png") / "a.png"
    write_depth_png(path, values.astype(np.float32) / 256)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), values)
    depth = read_depth_png(path)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth * 256, values)


@given(
    depth=arrays(np.float32, (3, 5), elements=st.floats(0, 1e6, width=32, allow_subnormal=False))
)
def test_a_depth_comes_back_within_half_a_step_or_not_at_all(depth, tmp_path_factory):
    path = tmp_path_factory.mktemp("png") / "a.png"
    write_depth_png(path, depth)
    back = read_depth_png(path).astype(np.float64)
    fits = (depth <= 65535 / 256) & (depth > 1 / 512)
    assert (abs(back - depth)[fits] <= 1 / 512).all()
    beyond = depth >= 65536 / 256
    assert (back[beyond | (depth < 1 / 512)] == 0).all()  # never wrapped to something near


def test_limits_of_the_depth_format(tmp_path):
    depth = np.array([[255.99, 65535 / 256, 256.0, 256.5, 400, 1 / 513, 1 / 511, 0]], np.float32)
    write_depth_png(tmp_path / "a.png", depth)
    stored = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored, [[65533, 65535, 0, 0, 0, 0, 1, 0]])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_depths_that_are_none_are_not_written(tmp_path, bad):
    with pytest.raises(ValueError, match="finite depths, 0 or more"):
        write_depth_png(tmp_path / "a.png", np.array([[1, bad]], np.float32))
    with pytest.raises(ValueError, match=r"expected \(H,W\)"):
        write_depth_png(tmp_path / "a.png", np.ones((2, 2, 1), np.float32))
    assert not list(tmp_path.iterdir())


def test_confidence_is_0_without_depth_and_255_when_certain(tmp_path):
    depth = np.array([[0, 5, 5, 5, 300, 1e-4]], np.float32)
    confidence = np.array([[1, 0, 0.5, 1, 1, 1]], np.float32)
    write_confidence_png(tmp_path / "c.png", confidence, depth)
    stored = cv2.imread(str(tmp_path / "c.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint8
    np.testing.assert_array_equal(stored, [[0, 1, 128, 255, 0, 0]])


def test_confidence_is_checked(tmp_path):
    depth = np.ones((1, 2), np.float32)
    for bad in (np.nan, -0.1, 1.1):
        with pytest.raises(ValueError, match="0 to 1"):
            write_confidence_png(tmp_path / "c.png", np.array([[0, bad]], np.float32), depth)
    with pytest.raises(ValueError, match="expected"):
        write_confidence_png(tmp_path / "c.png", np.zeros((2, 1), np.float32), depth)


def test_age_is_milliseconds_plus_1_and_0_without_depth(tmp_path):
    depth = np.array([[0, 5, 5, 5, 5, 5, 300, 5]], np.float32)
    age_s = np.array([[np.nan, 0, 0.0004, 0.0006, 0.3, 65.533, 1, 1e6]], np.float32)
    write_age_png(tmp_path / "a.png", age_s, depth)
    stored = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    np.testing.assert_array_equal(stored, [[0, 1, 1, 2, 301, 65534, 0, 65535]])


def test_ages_are_checked(tmp_path):
    depth = np.ones((1, 2), np.float32)
    for bad in (np.nan, np.inf, -0.1):
        with pytest.raises(ValueError, match="0 or more"):
            write_age_png(tmp_path / "a.png", np.array([[0, bad]], np.float32), depth)
    with pytest.raises(ValueError, match="expected"):
        write_age_png(tmp_path / "a.png", np.zeros((2, 1), np.float32), depth)
    result = result_of()
    ageless = {name: replace(depth, age_s=None) for name, depth in result.depth.items()}
    with pytest.raises(ValueError, match="image_02: expected ages"):
        write_result(replace(result, depth=ageless), {}, tmp_path, config={}, data="street")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["absent", "empty", "text", "8 bit", "colour"])
def test_files_that_are_no_depth_map(tmp_path, kind):
    path = tmp_path / "a.png"
    if kind in ("empty", "text"):
        path.write_bytes(b"" if kind == "empty" else b"hello")
    elif kind != "absent":
        shape, dtype = ((4, 4), np.uint8) if kind == "8 bit" else ((4, 4, 3), np.uint16)
        cv2.imwrite(str(path), np.zeros(shape, dtype))
    with pytest.raises(InputError) as error:
        read_depth_png(path)
    one_line(error, path)


def test_the_official_depth_map_reencodes_to_the_same_pixels(tmp_path, test_data):
    path = test_data / "kitti/depth_annotated_sample/groundtruth_0000000050.png"
    depth = read_depth_png(path)
    assert 1 < depth[depth > 0].min() < depth.max() < 120
    write_depth_png(tmp_path / "a.png", depth)
    raw, ours = (cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in (path, tmp_path / "a.png"))
    assert ours.dtype == raw.dtype
    np.testing.assert_array_equal(ours, raw)
    # The header too: 16 bit, one gray channel, not interlaced.
    header = slice(16, 29)
    assert (tmp_path / "a.png").read_bytes()[header] == path.read_bytes()[header]


# Cloud


@pytest.mark.parametrize("num_points", [0, 1, 1000])
def test_cloud_comes_back(tmp_path, num_points):
    cloud = cloud_of(num_points)
    write_cloud(tmp_path / "cloud.laz", cloud)
    back = read_cloud(tmp_path / "cloud.laz")
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=0.0005 + 1e-9)
    for name in ("frame", "moving", "instance", "confidence", "displaced", "rgb", "far"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    np.testing.assert_allclose(back.intensity, cloud.intensity, atol=1 / 65535)
    displacement = cloud.points - cloud.rigid_points
    np.testing.assert_array_equal(back.displacement, displacement.astype(np.float32))


def test_cloud_file_says_what_the_contract_says(tmp_path):
    laspy = pytest.importorskip("laspy")
    cloud = replace(cloud_of(3), intensity=np.array([0, 1, 2], np.float32))
    write_cloud(tmp_path / "cloud.laz", cloud)
    las = laspy.read(tmp_path / "cloud.laz")
    extra = {d.name: d.dtype for d in las.point_format.extra_dimensions}
    assert extra == {
        "frame": np.int32,
        "moving": np.uint8,
        "instance": np.int32,
        "confidence": np.float32,
        "displaced": np.float32,
        "far": np.uint8,
        **{f"displaced_{axis}": np.float32 for axis in "xyz"},
    }
    assert list(las.header.scales) == [0.001] * 3
    np.testing.assert_array_equal(las.intensity, [0, 65535, 65535])
    np.testing.assert_array_equal(las.red, cloud.rgb[:, 0].astype(int) * 257)
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)


def test_cloud_bytes_do_not_depend_on_the_day(tmp_path):
    stamp_ns = 1_317_046_451_000_000_000  # 2011-09-26 14:14:11, day 269
    write_cloud(tmp_path / "a.laz", cloud_of(100), stamp_ns)
    write_cloud(tmp_path / "b.laz", cloud_of(100), stamp_ns)
    data = (tmp_path / "a.laz").read_bytes()
    assert data == (tmp_path / "b.laz").read_bytes()
    day, year = (int.from_bytes(data[i : i + 2], "little") for i in (90, 92))
    assert (day, year) == (269, 2011)


def test_points_have_the_time_of_their_sweep(tmp_path):
    """Adjusted standard GPS time, as LAS 1.4 has it."""
    stamp_ns = 1_317_046_451_000_000_000
    cloud = replace(cloud_of(3), since_key_ns=np.array([-100_000_000, 0, 200_000_000]))
    write_cloud(tmp_path / "cloud.laz", cloud, stamp_ns)
    las = laspy.read(tmp_path / "cloud.laz")
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    epoch = datetime.datetime(1980, 1, 6) + datetime.timedelta(seconds=10**9)
    found = [epoch + datetime.timedelta(seconds=t) for t in np.round(las.gps_time, 6).tolist()]
    assert [str(t)[10:] for t in found] == [" 14:14:10.900000", " 14:14:11", " 14:14:11.200000"]
    assert {t.date() for t in found} == {datetime.date(2011, 9, 26)}


@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e6])
def test_cloud_coordinates_are_checked(tmp_path, bad):
    cloud = cloud_of(3)
    cloud.points[1, 2] = bad
    with pytest.raises(ValueError, match="finite points"):
        write_cloud(tmp_path / "cloud.laz", cloud)
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_cloud(tmp_path):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / "cloud.laz"
    with pytest.raises(InputError) as error:
        read_cloud(path)
    one_line(error, path)
    path.write_bytes(b"hello")
    with pytest.raises(InputError) as error:
        read_cloud(path)
    one_line(error, path)
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=7)).write(path)
    with pytest.raises(InputError) as error:
        read_cloud(path)
    one_line(error, "confidence, displaced, frame, instance, moving")


# Figure


def test_figure_stacks_panels_and_shows_each_return(images):
    image = np.repeat(np.repeat(images["image_02"], 40, 0), 40, 1)
    depth = np.zeros(image.shape[:2], np.float32)
    depth[100, 200], depth[300, 600] = 4, 70
    none = np.zeros_like(depth)
    figure = draw_figure(image, {"a": none, "b": depth})
    only_a = draw_figure(image, {"a": none})
    assert figure.dtype == np.uint8
    assert figure.shape[1] == image.shape[1]
    title = figure.shape[0] - only_a.shape[0] - image.shape[0]
    assert 10 < title < 60
    a = figure[title : title + len(image)]
    b = figure[2 * title + len(image) : 2 * (title + len(image))]
    np.testing.assert_array_equal(a[..., 0], a[..., 1])  # gray where there is no depth
    rows, columns = np.nonzero((a != b).any(axis=2))
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == {
        (r + i, c + j) for r, c in ((100, 200), (300, 600)) for i in (-1, 0, 1) for j in (-1, 0, 1)
    }
    near, far = b[100, 200].astype(int), b[300, 600].astype(int)
    assert near[0] > near[2]  # near is warm
    assert far[2] > far[0]  # far is cold


def test_the_nearer_of_two_neighbours_is_drawn_above(images):
    image = np.zeros((100, 600, 3), np.uint8)
    depth = np.zeros((100, 600), np.float32)
    depth[50, 300], depth[50, 301] = 60, 5
    figure = draw_figure(image, {"a": depth})
    alone = draw_figure(image, {"a": np.where(depth == 5, depth, 0)})
    top = 18 + 50  # half-size title
    row = next(r for r in range(top - 20, top + 20) if (figure[r, 301] != figure[r, 310]).any())
    np.testing.assert_array_equal(figure[row, 300:303], alone[row, 300:303])
    assert (figure[row, 299] != alone[row, 299]).any()  # only the far one reaches there


def test_depths_out_of_the_scale_take_its_ends(images):
    image = np.zeros((100, 600, 3), np.uint8)
    depth = np.zeros((100, 600), np.float32)
    depth[20, 100:400:100] = (1, 3, 0.5)
    depth[40, 100:400:100] = (80, 200, 1e4)
    figure = draw_figure(image, {"a": depth})
    colours = np.unique(figure[19 + 15 : 19 + 45, 50:450].reshape(-1, 3), axis=0)
    assert len(colours) == 3  # background, nearest, farthest


def test_small_images_are_enlarged_and_sizes_checked(images):
    depth = np.ones((H, W), np.float32)
    figure = draw_figure(images["image_02"], {"a": depth})
    assert figure.shape[1] == 480
    with pytest.raises(ValueError, match="panel a"):
        draw_figure(images["image_02"], {"a": depth[1:]})
    with pytest.raises(ValueError, match="image"):
        draw_figure(images["image_02"][..., 0], {"a": depth})


# The folder of a key


def test_result_is_written_as_the_contract_says(put, tmp_path):
    result = result_of()
    paths = put(result)
    folder = tmp_path / "out" / "000120"
    assert sorted(str(p.relative_to(folder)) for p in paths) == sorted(RUN_FILES)
    assert sorted(tree(tmp_path)) == sorted(f"out/000120/{name}" for name in RUN_FILES)
    for name, depth in result.depth.items():
        measured = read_depth_png(folder / "depth" / f"{name}.png")
        filled = read_depth_png(folder / "depth_filled" / f"{name}.png")
        np.testing.assert_allclose(measured, depth.depth_m, atol=1 / 512)
        np.testing.assert_allclose(filled, depth.filled_m, atol=1 / 512)
        confidence = cv2.imread(str(folder / "confidence" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(confidence > 0, filled > 0)
        age = cv2.imread(str(folder / "age" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(age > 0, filled > 0)
        np.testing.assert_allclose(age[age > 0], 1 + 1000 * depth.age_s[age > 0], atol=0.501)
    assert len(read_cloud(folder / "cloud.laz").points) == 50


def test_metrics_are_plain_json(put, tmp_path):
    put(result_of(a=np.float32(0.5), b={"c": np.nan, "d": [np.int64(3), np.inf, (True, None)]}))
    text = (tmp_path / "out" / "000120" / "metrics.json").read_text()

    def refuse(word):
        raise AssertionError(word)

    assert json.loads(text, parse_constant=refuse) == {
        "schema_version": 1,
        "key": 120,
        "method": "flow",
        "frames": [119, 120, 121],
        "a": 0.5,
        "b": {"c": None, "d": [3, None, [True, None]]},
        "baselines": {},
    }


def test_metrics_hold_those_of_the_simpler_methods(tmp_path):
    result = replace(result_of(a=2), baselines={"none": result_of("none", 1, a=1)})
    write_result(result, {}, tmp_path / "out", config=CONFIG, data="street")
    metrics = json.loads((tmp_path / "out" / "000120" / "metrics.json").read_text())
    assert metrics["a"] == 2
    assert metrics["baselines"] == {"none": {"frames": [119, 120, 121], "a": 1}}


def test_run_record(put, tmp_path):
    put(config=CONFIG | {"project": {"size": np.float64(3), "pair": (1, 2)}})
    record = yaml.safe_load((tmp_path / "out" / "000120" / "run.yaml").read_text())
    assert record["data"] == "street"
    assert record["method"] == "flow"
    assert record["frames"] == [119, 120, 121]
    assert record["cameras"] == ["image_02", "image_03"]
    assert record["config"] == CONFIG | {"project": {"size": 3.0, "pair": [1, 2]}}
    assert record["stages"] == [
        {"name": "register", "seconds": 1.235, "peak_memory_mb": 512.3},
        {"name": "flow", "seconds": 2.0, "peak_memory_mb": 600.0},
    ]
    assert record["versions"]["numpy"] == np.__version__
    assert record["versions"]["python"].startswith("3.")


def test_the_same_result_gives_the_same_bytes(put, tmp_path):
    put()
    first = tree(tmp_path / "out")
    put(overwrite=True)
    assert tree(tmp_path / "out") == first


def test_figure_shows_the_baselines_above_the_result(put, tmp_path, monkeypatch):
    drawn = {}

    def draw(image, panels, said):
        drawn.update(panels)
        return draw_figure(image, panels, said)

    monkeypatch.setattr(figure, "draw_figure", draw)
    baselines = {method: result_of(method, i) for i, method in enumerate(("none", "icp"), 1)}
    put(replace(result_of(), baselines=baselines))
    assert list(drawn) == ["sparse", "icp", "flow"]
    for seed, title in ((1, "sparse"), (2, "icp"), (0, "flow")):
        np.testing.assert_array_equal(drawn[title], map_of("image_02", seed).depth_m)


def test_without_cameras_there_is_only_a_cloud(put, tmp_path):
    paths = put(result_of(cameras=()))
    assert [p.name for p in paths] == ["cloud.laz", "metrics.json", "run.yaml"]


def test_a_camera_without_image_is_drawn_on_black(tmp_path):
    write_result(result_of(), {}, tmp_path, config={}, data="street")
    assert (tmp_path / "000120" / "figure.png").is_file()


def test_existing_result_is_kept(put, tmp_path):
    put()
    before = tree(tmp_path)
    with pytest.raises(InputError) as error:
        put(result_of(seed=9))
    one_line(error, tmp_path / "out" / "000120", "kept", "--overwrite", "cloud.laz")
    assert tree(tmp_path) == before
    with pytest.raises(InputError):
        check_writable(tmp_path / "out", 120)
    check_writable(tmp_path / "out", 120, overwrite=True)
    check_writable(tmp_path / "out", 121)
    check_writable(tmp_path / "out", 120, verb="compare")


def test_overwriting_replaces_what_densify_wrote_and_keeps_the_rest(put, tmp_path):
    folder = tmp_path / "out" / "000120"
    put()
    (folder / "notes").mkdir()
    (folder / "notes" / "mine.txt").write_text("keep")
    (folder / "link").symlink_to("notes")
    put(result_of(seed=9, cameras=("image_02",)), overwrite=True)
    assert (folder / "notes" / "mine.txt").read_text() == "keep"
    assert (folder / "link").is_symlink()
    assert [p.name for p in (folder / "depth").iterdir()] == ["image_02.png"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["000120"]
    np.testing.assert_allclose(
        read_depth_png(folder / "depth" / "image_02.png"),
        map_of("image_02", 9).depth_m,
        atol=1 / 512,
    )


@pytest.mark.parametrize(
    ("module", "writer"),
    [
        (depth_maps, "write_depth_png"),
        (cloud_laz, "write_cloud"),
        (figure, "write_picture"),
        (run_yaml, "write_file"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("failure", [KeyboardInterrupt, RuntimeError])
@pytest.mark.parametrize("existing", [False, True])
def test_a_failure_in_the_middle_leaves_nothing(
    put, tmp_path, monkeypatch, module, writer, failure, existing
):
    if existing:
        put()
    before = tree(tmp_path)

    def fail(path, *_):
        path.with_suffix(".half").write_bytes(b"half")
        raise failure

    monkeypatch.setattr(module, writer, fail)
    with pytest.raises(failure):
        put(result_of(seed=9), overwrite=existing)
    assert tree(tmp_path) == before
    assert (tmp_path / "out").exists() == existing


@pytest.mark.parametrize("there", ["", "p", "p/q"])
def test_a_failure_leaves_no_folder_above_the_result(tmp_path, monkeypatch, there):
    (tmp_path / there).mkdir(parents=True, exist_ok=True)
    before = sorted(tmp_path.rglob("*"))

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cloud_laz, "write_cloud", fail)
    with pytest.raises(KeyboardInterrupt):
        write_result(result_of(), {}, tmp_path / "p" / "q" / "r", config={}, data="street")
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError), staged_folder(tmp_path / "file" / "q" / "r", ()):
        pass
    assert sorted(tmp_path.rglob("*")) == sorted([*before, tmp_path / "file"])


def test_a_failure_keeps_what_others_put_into_the_new_folders(tmp_path):
    with pytest.raises(KeyboardInterrupt), staged_folder(tmp_path / "p" / "q" / "r", ()):
        (tmp_path / "p" / "other").write_text("keep")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.rglob("*")] == ["p", "other"]


def test_overwriting_behind_a_link_keeps_the_link(put, tmp_path):
    put()
    link = tmp_path / "out" / "000120"
    (tmp_path / "elsewhere").mkdir()
    real = link.rename(tmp_path / "elsewhere" / "key")
    link.symlink_to(real)
    put(result_of(seed=9), overwrite=True)
    assert link.is_symlink()
    assert sorted(tree(real)) == sorted(RUN_FILES)
    assert [p.name for p in real.parent.iterdir()] == ["key"]
    assert [p.name for p in link.parent.iterdir()] == ["000120"]
    depth = read_depth_png(real / "depth" / "image_02.png")
    np.testing.assert_allclose(depth, map_of("image_02", 9).depth_m, atol=1 / 512)


def test_a_failing_clean_up_is_a_warning(put, tmp_path, monkeypatch, caplog):
    put()
    first = tree(tmp_path / "out" / "000120")

    def fail(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr("densify.outputs.atomic.shutil.rmtree", fail)
        paths = put(result_of(seed=9), overwrite=True)
    assert all(path.is_file() for path in paths)
    assert tree(tmp_path / "out" / "000120") != first
    (left,) = (p for p in (tmp_path / "out").iterdir() if p.name != "000120")
    assert tree(left) == first
    (message,) = (record.getMessage() for record in caplog.records)
    assert str(left) in message and "Permission denied" in message and "\n" not in message


@pytest.mark.parametrize(("existing", "nth"), [(False, 1), (True, 1), (True, 2)])
def test_a_failing_rename_leaves_the_old_result(put, tmp_path, monkeypatch, nth, existing):
    if existing:
        put()
    before = tree(tmp_path)
    rename, calls = os.rename, []

    def fail(source, target):
        calls.append(source)
        if len(calls) == nth:
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr("densify.outputs.atomic.os.rename", fail)
    with pytest.raises(KeyboardInterrupt):
        put(result_of(seed=9), overwrite=existing)
    assert tree(tmp_path) == before


def test_a_full_disk_is_one_line(put, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cloud_laz, "write_cloud", full)
    with pytest.raises(InputError) as error:
        put()
    one_line(error, tmp_path / "out", "No space left on device")
    assert not tree(tmp_path)


def test_what_an_earlier_failure_left_is_not_in_the_way(put, tmp_path):
    with staged_folder(tmp_path / "out" / "000120", ()) as stale:
        pass
    stale.mkdir()
    (stale / "junk").write_text("junk")
    put()
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["000120"]
    assert not (tmp_path / "out" / "000120" / "junk").exists()


def test_places_that_cannot_be_written_to(put, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(InputError) as error:
            check_writable(out, 120)
        one_line(error, f"--out {out}", f"{tmp_path / 'file'} is not a folder")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "000120").write_text("")
    with pytest.raises(InputError) as error:
        put(overwrite=True)
    one_line(error, tmp_path / "out" / "000120", "not a folder")

    monkeypatch.setattr("densify.outputs.store.os.access", lambda *_: False)  # root may write all
    with pytest.raises(InputError) as error:
        check_writable(tmp_path / "new" / "out", 120)
    one_line(error, "no permission", f"write in {tmp_path};")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.parametrize("denied", ["itself", "parent"])
def test_an_existing_result_needs_permission_in_and_above_it(
    put, tmp_path, monkeypatch, linked, denied
):
    put()
    folder = real = tmp_path / "out" / "000120"
    if linked:
        (tmp_path / "elsewhere").mkdir()
        real = folder.rename(tmp_path / "elsewhere" / "key")
        folder.symlink_to(real)
    place = real.parent if denied == "parent" else folder
    monkeypatch.setattr("densify.outputs.store.os.access", lambda path, _: Path(path) != place)
    with pytest.raises(InputError) as error:
        check_writable(tmp_path / "out", 120, overwrite=True)
    one_line(error, f"no permission to write in {place};")


# Comparison


def compare(out, images, overwrite=False, seed=0):
    results = {
        method: result_of(method, seed + i, ghost_rate=float("nan") if i == 0 else 0.1 * i)
        for i, method in enumerate(("none", "icp", "flow"))
    }
    return write_comparison(results, images, out, config=CONFIG, data="street", overwrite=overwrite)


def test_comparison_is_written_beside_the_run(put, images, tmp_path):
    put()
    run = tree(tmp_path)
    paths = compare(tmp_path / "out", images)
    maps = sorted(f"{k}/{c}.png" for k in ("depth", "depth_filled", "confidence", "age")
                  for c in ("image_02", "image_03"))  # fmt: skip
    beside = [p.relative_to(tmp_path / "out/000120/compare").as_posix() for p in paths[2:]]
    assert [p.name for p in paths[:2]] == ["compare.json", "compare.png"]
    assert beside == sorted([*maps, "cloud.laz"])
    after = tree(tmp_path)
    assert {k: v for k, v in after.items() if "compare" not in k} == run
    table = json.loads(paths[0].read_text())
    assert list(table["methods"]) == ["none", "icp", "flow"]
    assert table["methods"]["none"] == {
        "frames": [119, 120, 121],
        "ghost_rate": None,
    }
    assert table["methods"]["icp"]["ghost_rate"] == 0.1
    assert (table["schema_version"], table["key"]) == (1, 120)
    assert table["config"] == CONFIG
    picture = cv2.imread(str(paths[1]))
    assert picture.shape[0] > 3 * H


def test_comparison_is_kept_and_survives_a_new_run(put, images, tmp_path):
    first = compare(tmp_path / "out", images)
    data = [p.read_bytes() for p in first]
    with pytest.raises(InputError) as error:
        compare(tmp_path / "out", images)
    one_line(error, "compare.json, compare.png, compare already there", "--overwrite")
    put()  # no --overwrite needed: nothing of a run is there
    assert [p.read_bytes() for p in first] == data
    compare(tmp_path / "out", images, overwrite=True, seed=5)
    assert first[1].read_bytes() != data[1]
    assert (tmp_path / "out" / "000120" / "cloud.laz").is_file()


def test_a_failing_comparison_leaves_the_run_alone(put, images, tmp_path, monkeypatch):
    put()
    before = tree(tmp_path)

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(figure, "write_picture", fail)
    with pytest.raises(KeyboardInterrupt):
        compare(tmp_path / "out", images)
    assert tree(tmp_path) == before
