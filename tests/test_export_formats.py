# SPDX-License-Identifier: MIT
"""Exports read back by other tools' own readers, value by value."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from PIL import Image

from densify.config.plugins.exports import EXPORTS
from densify.geometry.types import Cloud
from densify.outputs import export_run, read_cloud, read_depth_png, write_cloud
from densify.outputs.depth_png import stored_age, stored_confidence
from tests.command import exit_code
from tests.test_export import CAMERAS, KEY_NS, STAMPS_NS, map_of, refused, stored, tree, written

NUM_POINTS = 400
COLUMNS = {
    **dict.fromkeys(("x", "y", "z", "intensity", "confidence", "displaced"), np.float32),
    **dict.fromkeys(("displaced_x", "displaced_y", "displaced_z"), np.float32),
    **dict.fromkeys(("frame", "instance"), np.int32),
    **dict.fromkeys(("red", "green", "blue", "moving", "far"), np.uint8),
    "gps_time": np.float64,
}


def cloud_of(num_points: int = NUM_POINTS) -> Cloud:
    rng = np.random.default_rng(3)
    points = rng.uniform(-120, 120, (num_points, 3))
    moving = rng.random(num_points) < 0.4
    frame = rng.choice([*STAMPS_NS], num_points).astype(np.int32)
    since_key_ns = np.array([STAMPS_NS[f] - KEY_NS for f in frame.tolist()], np.int64)
    return Cloud(
        points=points,
        rigid_points=points - rng.normal(0, 2, (num_points, 3)) * moving[:, None],
        frame=frame,
        since_key_ns=since_key_ns,
        row=np.arange(num_points),
        lidar=np.zeros(num_points, np.uint8),
        moving=moving,
        instance=np.where(moving, rng.integers(0, 9, num_points), -1).astype(np.int32),
        velocity_m_s=np.zeros((num_points, 3), np.float32),
        confidence=rng.random(num_points, dtype=np.float32),
        intensity=rng.random(num_points, dtype=np.float32),
        rgb=rng.integers(0, 256, (num_points, 3), np.uint8),
        far=rng.random(num_points) < 0.3,
    )


@pytest.fixture
def run(tmp_path):
    folder = written(tmp_path, {name: map_of(name, i) for i, name in enumerate(CAMERAS)})
    write_cloud(folder / "cloud.laz", cloud_of(), KEY_NS)
    return folder


def expected(run):
    """Every column as cloud.laz has it, in the types of the export."""
    cloud = read_cloud(run / "cloud.laz")
    values = {n: getattr(cloud, n) for n in COLUMNS if hasattr(cloud, n)}
    values |= dict(zip("xyz", cloud.points.T, strict=True))
    values |= dict(zip(("red", "green", "blue"), cloud.rgb.T, strict=True))
    displacement = cloud.displacement
    assert displacement is not None
    values |= {f"displaced_{axis}": displacement[:, i] for i, axis in enumerate("xyz")}
    return {name: values[name].astype(kind) for name, kind in COLUMNS.items()}


# --- clouds ---------------------------------------------------------------------------------------


def test_ply_by_plyfile(run):
    from plyfile import PlyData

    exported = export_run(run, to="ply")
    assert exported.paths[0] == run / "export" / "ply" / "cloud.ply"
    ply = PlyData.read(exported.paths[0])
    assert not ply.text and ply.byte_order == "<" and [e.name for e in ply.elements] == ["vertex"]
    vertex = ply["vertex"].data
    assert set(vertex.dtype.names) == set(COLUMNS) and len(vertex) == NUM_POINTS
    for name, values in expected(run).items():
        assert vertex[name].dtype.base == np.dtype(COLUMNS[name]), name
        np.testing.assert_array_equal(vertex[name], values, err_msg=name)
    places_m = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    assert np.abs(places_m - cloud_of().points).max() < 0.00051  # cloud.laz rounds to 1 mm


def test_ply_by_trimesh(run):
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(export_run(run, to="ply").paths[0])
    values = expected(run)
    np.testing.assert_array_equal(loaded.vertices, np.stack([values[a] for a in "xyz"], axis=1))
    rgb = np.stack([values[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(loaded.colors[:, :3], rgb)


def test_ply_by_open3d(run):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.io.read_point_cloud(str(export_run(run, to="ply").paths[0]))
    values = expected(run)
    np.testing.assert_array_equal(cloud.points, np.stack([values[a] for a in "xyz"], axis=1))
    rgb = np.stack([values[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(np.rint(255 * np.asarray(cloud.colors)), rgb)


def test_pcd_by_pypcd4(run):
    from pypcd4 import Encoding, PointCloud

    path = export_run(run, to="pcd").paths[0]
    assert path == run / "export" / "pcd" / "cloud.pcd"
    cloud, values = PointCloud.from_path(path), expected(run)
    assert cloud.metadata.data == Encoding.BINARY and cloud.points == NUM_POINTS
    rgb = [values.pop(name) for name in ("red", "green", "blue")]
    assert set(cloud.fields) == {*values, "rgb"}
    for name, column in values.items():
        stored_column = cloud.pc_data[name]
        assert stored_column.dtype == column.dtype, name
        np.testing.assert_array_equal(stored_column, column, err_msg=name)
    packed = cloud.pc_data["rgb"].view(np.uint32)  # as the Point Cloud Library packs it
    for column, bits in zip(rgb, (16, 8, 0), strict=True):
        np.testing.assert_array_equal(packed >> bits & 255, column)


@pytest.mark.parametrize("to", ["ply", "pcd"])
def test_a_cloud_of_no_points(run, to):
    write_cloud(run / "cloud.laz", cloud_of(0), KEY_NS)
    exported = export_run(run, to=to)
    assert exported.num_points is not None and exported.num_points.before == 0
    if to == "ply":
        from plyfile import PlyData

        assert len(PlyData.read(exported.paths[0])["vertex"].data) == 0


@pytest.mark.parametrize(("confidence", "age_ms"), [(0.5, None), (0.0, 95), (0.3, 0.0)])
def test_thresholds_leave_points_of_the_cloud(run, confidence, age_ms):
    from plyfile import PlyData

    exported = export_run(run, confidence, age_ms, to="ply")
    cloud = read_cloud(run / "cloud.laz")
    keep = stored_confidence(cloud.confidence) >= stored_confidence(confidence)
    if age_ms is not None:
        late_ns = np.array([abs(STAMPS_NS[f] - KEY_NS) for f in cloud.frame.tolist()])
        keep &= late_ns <= age_ms * 1e6
    assert 0 < keep.sum() < NUM_POINTS
    vertex = PlyData.read(exported.paths[0])["vertex"].data
    np.testing.assert_array_equal(vertex["confidence"], cloud.confidence[keep])
    assert exported.num_points is not None
    assert (exported.num_points.before, exported.num_points.after) == (NUM_POINTS, keep.sum())
    record = yaml.safe_load((run / "export" / "ply" / "export.yaml").read_text())
    assert record["num_points"] == {"before": NUM_POINTS, "after": int(keep.sum())}
    assert record["to"] == "ply" and "density" not in record


def test_ages_need_a_point_of_the_key(run):
    cloud = cloud_of()
    write_cloud(run / "cloud.laz", cloud.select(cloud.frame != 120), KEY_NS)
    refused("no point of the key sweep 120", run=run, max_age_ms=50, to="ply")
    (run / "run.yaml").write_text("key: one\n")
    refused("run.yaml: key: got 'one'", run=run, max_age_ms=50, to="ply")


def test_a_damaged_or_missing_cloud(run):
    whole = (run / "cloud.laz").read_bytes()
    (run / "cloud.laz").write_bytes(whole[: len(whole) // 2])
    refused("cloud.laz: not a readable .laz file", run=run, to="pcd")
    (run / "cloud.laz").unlink()
    refused("cloud.laz", run=run, to="pcd")


# --- maps -----------------------------------------------------------------------------------------


def read_npy(path):
    return np.load(path, allow_pickle=False)


def read_tiff(path):
    with Image.open(path) as image:
        assert image.mode == "F"
        return np.array(image)


def read_exr(path):
    library = pytest.importorskip("OpenEXR")
    channels = library.File(str(path)).channels()
    assert set(channels) == {"Y" if "confidence" in path.parts else "Z"}
    return next(iter(channels.values())).pixels


READ = {"npy": read_npy, "tiff": read_tiff, "exr": read_exr}


@pytest.mark.parametrize("to", READ)
def test_maps_of_floats(run, to):
    if to == "exr":
        pytest.importorskip("OpenEXR")
    exported = export_run(run, to=to)
    folder = run / "export" / to
    products = ("depth", "depth_filled", "confidence")
    named = [folder / product / f"{name}.{to}" for product in products for name in CAMERAS]
    assert exported.paths == [*named, folder / "export.yaml"]
    for path in named:
        product, camera = path.parent.name, path.stem
        values = READ[to](path)
        assert values.dtype == np.float32
        if product == "confidence":
            levels = stored(run, product, camera).astype(np.float32)
            np.testing.assert_array_equal(values, np.maximum(levels - 1, 0) / np.float32(254))
            assert values.max() <= 1
        else:
            depth_m = read_depth_png(run / product / f"{camera}.png")
            np.testing.assert_array_equal(values, depth_m)
            assert depth_m.any()


def test_thresholds_leave_pixels_of_float_maps(run):
    exported = export_run(run, 0.5, 100, to="npy")
    for camera in CAMERAS:
        keep = stored(run, "confidence", camera) >= stored_confidence(0.5)
        keep &= stored(run, "age", camera) <= stored_age(0.1)
        depth_m = read_npy(run / "export" / "npy" / "depth_filled" / f"{camera}.npy")
        whole_m = read_depth_png(run / "depth_filled" / f"{camera}.png")
        np.testing.assert_array_equal(depth_m, np.where(keep, whole_m, 0))
        assert exported.density[camera]["filled"].after == np.mean(depth_m > 0)


# --- every form -----------------------------------------------------------------------------------


@pytest.mark.parametrize("to", [form.name for form in EXPORTS.built_in])
def test_a_form_is_whole_repeatable_and_leaves_the_run_alone(tmp_path, to):
    from tests.exported import write_views

    package = {"exr": "OpenEXR", "rrd": "rerun", "mcap": "foxglove", "copc": "copclib"}
    pytest.importorskip(package.get(to, "numpy"), reason=f"{package.get(to)} is not installed")
    run, _ = write_views(tmp_path, {"image_02": "plain", "image_03": "bent"})
    before = tree(run)
    exported = export_run(run, to=to)
    folder = run / "export" if to == "png" else run / "export" / to
    form = EXPORTS.row(to, "--to")
    assert {p.relative_to(folder).parts[0] for p in exported.paths} <= {*form.owned, "export.yaml"}
    after = tree(run)
    assert {n: d for n, d in after.items() if not n.startswith("export/")} == before
    refused(folder, "--overwrite", run=run, to=to)
    export_run(run, overwrite=True, to=to)
    again = tree(run)
    if to not in ("exr", "rrd", "e57"):  # may hold the moment or the process that wrote it
        assert again == after
    assert set(again) == set(after)


def test_forms_of_other_packages(run, tmp_path, monkeypatch):
    package = tmp_path / "site" / "xyz_export"
    about = tmp_path / "site" / "xyz_export-1.dist-info"
    for folder in (package, about):
        folder.mkdir(parents=True)
    code = """
OWNED = ("cloud.xyz",)
name = "cloud.xyz"


def write_export(run, folder):
    lines = [f"{x} {y} {z}" for x, y, z in run.cloud().points.tolist()]
    (folder / name).write_text("\\n".join(lines))
"""
    (package / "__init__.py").write_text(code)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: xyz-export\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[densify.exports]\nxyz = xyz_export\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    (path, _) = export_run(run, to="xyz").paths
    points = read_cloud(run / "cloud.laz").points
    np.testing.assert_array_equal(np.loadtxt(path), points)
    monkeypatch.setattr("xyz_export.name", "points.xyz")
    refused("wrote points.xyz, expected nothing but cloud.xyz", run=run, to="xyz", overwrite=True)


def test_the_command(run, capsys):
    command = ["export", run, "--to", "ply", "--min-confidence", "0.5"]
    assert exit_code(*command) == 0
    line, *paths = capsys.readouterr().out.splitlines()
    kept = (read_cloud(run / "cloud.laz").confidence >= 0.499).sum()
    assert abs(int(line.split()[1]) - kept) <= 2 and line.endswith(f"of {NUM_POINTS} points")
    folder = run / "export" / "ply"
    assert paths == [str(folder / "cloud.ply"), str(folder / "export.yaml")]
    assert exit_code(*command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert exit_code("export", run, "--to", "obj") == 2
    assert "expected one of png, npy" in capsys.readouterr().err
    assert exit_code("export", run, "--to", "npy", "--camera", "image_03") == 0
    named = [line for line in capsys.readouterr().out.splitlines() if line.endswith(".npy")]
    assert len(named) == 3 and all("image_03" in name for name in named)


def test_a_form_that_is_none(run):
    refused("--to", "'obj'", "png, npy", run=run, to="obj")
