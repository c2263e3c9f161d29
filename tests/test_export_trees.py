# SPDX-License-Identifier: MIT
"""Runs as KITTI's and nuScenes' files, as COPC and as E57: what their readers find in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pye57
import pytest
from laspy.copc import CopcReader

from densify.config.errors import InputError
from densify.outputs import export_run, read_cloud, read_depth_png
from densify.outputs.export.copc import _nodes
from densify.outputs.export.finished_run import FinishedRun
from densify.readers.depth_trees import pair_depth_files
from tests.command import exit_code, refused
from tests.exported import write_street, write_views


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"))


@pytest.fixture
def two(tmp_path: Path) -> Path:
    return write_views(tmp_path / "run", {"image_02": "plain", "image_03/0000000241": "bent"})[0]


def test_kitti_is_what_readers_of_the_benchmark_expect(two: Path, tmp_path: Path) -> None:
    yaml = two / "run.yaml"
    name = "2011_09_26_drive_0013_sync"
    yaml.write_text(yaml.read_text().replace("data: street", f"data: /some/where/{name}/"))
    export_run(two, out=tmp_path / "a", to="kitti")
    drive = tmp_path / "a" / "val" / name
    truth = drive / "proj_depth" / "groundtruth"
    found = sorted(p.relative_to(truth).as_posix() for p in truth.rglob("*.png"))
    assert found == ["image_02/0000000120.png", "image_03/0000000241.png"]
    pairs = pair_depth_files(two, tmp_path / "a", None, filled=False)
    assert [len(pairs.without_truth), len(pairs.without_prediction)] == [0, 0]
    for view, file in (("image_02", "0000000120"), ("image_03/0000000241", "0000000241")):
        camera = view.partition("/")[0]
        mine = read_depth_png(two / "depth_filled" / f"{view}.png")
        theirs = drive / "proj_depth" / "groundtruth_filled" / camera / f"{file}.png"
        np.testing.assert_array_equal(read_depth_png(theirs), mine)
        image = cv2.imread(str(drive / camera / "data" / f"{file}.png"))
        np.testing.assert_array_equal(image, cv2.imread(str(two / f"scene/image/{view}.jpg")))
        K = np.loadtxt(drive / "intrinsics" / camera / f"{file}.txt").reshape(3, 3)
        np.testing.assert_allclose(K, FinishedRun(two).scene.views[view].camera.K, atol=1e-6)


def test_kitti_tells_the_key_sweep_apart_and_names_other_recordings(street, tmp_path) -> None:
    export_run(street, out=tmp_path / "a", to="kitti")
    (raw,) = (tmp_path / "a" / "train").glob("*/proj_depth/velodyne_raw/*/*.png")
    assert raw.parts[-5] == "tiny_street" or raw.parts[-5].startswith("tiny")
    (alone,) = (street / "scene" / "none").glob("*.png")
    assert raw.read_bytes() == alone.read_bytes()


def test_nuscenes_is_what_the_devkit_and_depth_supervision_read(street, tmp_path) -> None:
    export_run(street, out=tmp_path / "a", to="nuscenes")
    (sweep,) = (tmp_path / "a" / "samples" / "LIDAR_TOP").iterdir()
    # nuscenes.utils.data_classes.LidarPointCloud.from_file
    points = np.fromfile(sweep, np.float32).reshape(-1, 5)[:, :4]
    cloud = read_cloud(street / "cloud.laz")
    np.testing.assert_array_equal(points[:, :3], cloud.points.astype(np.float32))
    np.testing.assert_allclose(points[:, 3], 255 * cloud.intensity, atol=1e-3)
    for folder, product in (("depth_gt", "depth"), ("depth_gt_filled", "depth_filled")):
        (rows,) = (tmp_path / "a" / folder).iterdir()
        # BEVDepth's LoadDepth: np.fromfile(...).reshape(-1, 3), u v d
        u, v, depth_m = np.fromfile(rows, np.float32).reshape(-1, 3).T
        camera = rows.name.split("__")[1]
        stored = read_depth_png(street / product / f"{camera}.png")
        image = np.zeros_like(stored)
        image[v.astype(int), u.astype(int)] = depth_m
        np.testing.assert_array_equal(image, stored)
        assert (tmp_path / "a" / "samples" / camera / rows.name.removesuffix(".bin")).is_file()


def test_copc_by_laspys_reader(street: Path, tmp_path: Path) -> None:
    for name in "ab":
        assert exit_code("export", street, "--to", "copc", "--out", tmp_path / name) == 0
    path = tmp_path / "a" / "cloud.copc.laz"
    assert path.read_bytes() == (tmp_path / "b" / "cloud.copc.laz").read_bytes()
    cloud = read_cloud(street / "cloud.laz")

    def table(points: Any) -> np.ndarray:
        names = ("x", "y", "z", "red", "user_data", "point_source_id", "gps_time", "intensity")
        columns = np.stack([np.asarray(points[name], float) for name in names], axis=1)
        return columns[np.lexsort(columns.T)]

    mine = np.column_stack(
        [
            *(cloud.points, cloud.rgb[:, 0].astype(float) * 257, cloud.moving),
            *(cloud.instance + 1, cloud.gps_time, np.rint(65535 * cloud.intensity)),
        ]
    )
    mine = mine[np.lexsort(mine.T)]
    with CopcReader.open(str(path)) as reader:
        np.testing.assert_allclose(table(reader.query()), mine, atol=1e-6)
        coarse, fine = (len(reader.query(level=range(n))) for n in (1, 3))
        assert 100 < coarse < fine < len(mine)
    np.testing.assert_allclose(table(laspy.read(path)), mine, atol=1e-6)


def test_nodes_hold_each_point_once_and_only_their_own() -> None:
    unit = np.random.default_rng(0).uniform(0, 1, (120_000, 3)) ** 3
    seen, keys = np.zeros(len(unit), int), set()
    for level, place, rows in _nodes(unit):
        seen[rows] += 1
        assert (level, *place) not in keys
        keys.add((level, *place))
        np.testing.assert_array_equal(np.floor(unit[rows] * 2**level).astype(int) - place, 0)
    assert (seen == 1).all() and max(level for level, *_ in keys) >= 2
    for level, x, y, z in keys:  # COPC: no node without those above it
        assert level == 0 or (level - 1, x // 2, y // 2, z // 2) in keys


def test_e57_by_pye57(street: Path, tmp_path: Path) -> None:
    export_run(street, out=tmp_path / "a", to="e57")
    cloud = read_cloud(street / "cloud.laz")
    file = pye57.E57(str(tmp_path / "a" / "cloud.e57"))
    found = file.read_scan(0, intensity=True, colors=True)
    for axis, name in enumerate(("cartesianX", "cartesianY", "cartesianZ")):
        np.testing.assert_array_equal(found[name], cloud.points[:, axis].astype(np.float32))
    np.testing.assert_array_equal(found["colorGreen"], cloud.rgb[:, 1])
    np.testing.assert_allclose(found["intensity"], cloud.intensity, atol=1e-6)


@pytest.mark.parametrize(("to", "package"), [("copc", "copclib"), ("e57", "pye57")])
def test_packages_that_are_not_there_and_clouds_of_nothing(
    to: str, package: str, two: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    empty = ["export", two, "--to", to, "--out", tmp_path / "out", "--min-confidence", "1"]
    assert "nothing is left of the cloud" in refused(capsys, 2, *empty)
    monkeypatch.setitem(__import__("sys").modules, package, None)
    line = refused(capsys, 2, "export", two, "--to", to, "--out", tmp_path / "out")
    assert f"pip install 'densify[{to}]'" in line
    assert not (tmp_path / "out").exists()


def damaged(change: Callable[[str], str], two: Path) -> None:
    (two / "run.yaml").write_text(change((two / "run.yaml").read_text()))


def test_a_run_that_does_not_say_its_recording(two: Path, tmp_path: Path) -> None:
    damaged(lambda text: text.replace("data: street", "data: 3"), two)
    with pytest.raises(InputError, match=r"run\.yaml: data: got 3, expected the recording's name"):
        export_run(two, out=tmp_path / "a", to="kitti")
