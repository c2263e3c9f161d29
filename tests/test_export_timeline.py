# SPDX-License-Identifier: MIT
"""Recordings for viewers: what their own readers find in them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.outputs import export_run, read_cloud, write_result
from densify.outputs.export import open3d_window
from densify.outputs.export.finished_run import finished_runs
from densify.outputs.export.timeline import timelines
from densify.pipeline.run import run_keys
from tests.command import exit_code, refused
from tests.exported import write_street, write_views
from tests.small_street import KEY, POSES_GIVEN, one_car


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two keys of one drive."""
    out = tmp_path_factory.mktemp("drive")
    for _, result in run_keys(one_car(), [KEY, KEY + 1], 1, config=POSES_GIVEN):
        assert not isinstance(result, Exception)
        write_result(result, result.images, out, config={}, data="tiny street")
    return out


def test_sweeps_are_where_they_were_measured(street: Path) -> None:
    (timeline,) = timelines(finished_runs(street))
    assert [s.frame for s in timeline.sweeps] == [KEY - 1, KEY, KEY + 1]
    steps_ns = np.diff([s.stamp_ns for s in timeline.sweeps])
    np.testing.assert_allclose(steps_ns, one_car().stamp_ns(KEY + 1) - one_car().stamp_ns(KEY))
    assert timeline.sweeps[1].stamp_ns == one_car().stamp_ns(KEY)
    cloud = read_cloud(street / "cloud.laz")
    for sweep in timeline.sweeps:
        assert len(sweep.points) == np.count_nonzero((cloud.frame == sweep.frame) & ~cloud.far)
    (track,) = timeline.tracks
    for sweep in timeline.sweeps:  # the box of that sweep is around what moves in it
        T = track.T_key_object[track.frames.index(sweep.frame)]
        inside = (
            np.abs((sweep.points[sweep.moving] - T[:3, 3]) @ T[:3, :3]) < track.size_m / 2 + 0.2
        )
        assert len(inside) > 50 and inside.all(axis=1).mean() > 0.95
    (shot,) = timeline.shots
    stored = cv2.imread(str(street / "depth" / f"{shot.name}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shot.depth_m, stored / np.float32(256))


def test_keys_of_a_drive_lie_in_one_world(drive: Path) -> None:
    first, second = timelines(finished_runs(drive))
    np.testing.assert_array_equal(first.T_world_key, np.eye(4))
    sequence = one_car()
    true = np.linalg.inv(sequence.T_world_lidar(KEY)) @ sequence.T_world_lidar(KEY + 1)
    np.testing.assert_allclose(second.T_world_key, true, atol=1e-6)
    assert [len(t.sweeps) for t in (first, second)] == [1, 1]


def test_keys_that_nothing_ties_together_are_refused(street: Path, tmp_path: Path, capsys) -> None:
    for name in ("000060", "000061"):
        (tmp_path / name).symlink_to(street)
    runs = finished_runs(tmp_path)
    runs[0].scene.T_key_lidar.pop(KEY)  # type: ignore[attr-defined]
    runs[1].scene.T_key_lidar.pop(KEY)  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="nothing says how they lie to each other"):
        list(timelines(runs))
    line = refused(capsys, 2, "export", tmp_path, "--to", "ply")
    assert "no run.yaml in it" in line


class TestMcap:
    """Read by the mcap package."""

    @staticmethod
    def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
        reader = pytest.importorskip("mcap.reader")
        decoder = pytest.importorskip("mcap_protobuf.decoder")
        topics = defaultdict(list)
        with path.open("rb") as file:
            rows = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
            for schema, channel, message, decoded in rows.iter_decoded_messages():
                assert schema.name == f"foxglove.{type(decoded).__name__}"
                topics[channel.topic].append((message.log_time, decoded))
        return topics

    @staticmethod
    def points(cloud: Any) -> dict[str, np.ndarray]:
        kinds = {1: "u1", 5: "<u4", 6: "<i4", 7: "<f4"}
        fields = {f.name: (kinds[f.type], f.offset) for f in cloud.fields}
        kind = np.dtype(
            {
                "names": [*fields],
                "formats": [k for k, _ in fields.values()],
                "offsets": [o for _, o in fields.values()],
                "itemsize": cloud.point_stride,
            }
        )
        table = np.frombuffer(cloud.data, kind)
        return {name: table[name] for name in fields}

    def test_one_key(self, street: Path, tmp_path: Path) -> None:
        pytest.importorskip("foxglove")
        exported = export_run(street, out=tmp_path / "a", to="mcap")
        topics = self.read(tmp_path / "a" / "recording.mcap")
        cloud = read_cloud(street / "cloud.laz")
        ((start_ns, shown),) = topics["/cloud"]
        found = self.points(shown)
        assert exported.num_points is not None and exported.num_points.after == len(cloud.points)
        np.testing.assert_array_equal(found["x"], cloud.points[:, 0].astype(np.float32))
        np.testing.assert_array_equal(found["instance"], cloud.instance)
        np.testing.assert_array_equal(found["frame"], cloud.frame)
        seen = cloud.rgb.any(axis=1)
        np.testing.assert_array_equal(found["red"][seen], cloud.rgb[seen, 0])
        (timeline,) = timelines(finished_runs(street))
        assert start_ns == timeline.sweeps[0].stamp_ns
        assert [ns for ns, _ in topics["/sweep"]] == [s.stamp_ns for s in timeline.sweeps]
        (track,) = timeline.tracks
        for (_, update), frame in zip(topics["/movers"], track.frames, strict=True):
            (cube,) = update.entities[0].cubes
            T = track.T_key_object[track.frames.index(frame)]
            at, turn = cube.pose.position, cube.pose.orientation
            np.testing.assert_allclose([at.x, at.y, at.z], T[:3, 3])
            matrix = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
            np.testing.assert_allclose(matrix, T[:3, :3], atol=1e-9)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], track.size_m)
        (shot,) = timeline.shots
        ((_, image),) = topics[f"/{shot.name}/image"]
        assert image.format == "jpeg" and image.data == shot.jpeg
        ((shot_ns, depth),) = topics[f"/{shot.name}/depth"]
        maps = np.frombuffer(depth.data, "<f4").reshape(depth.height, depth.width)
        np.testing.assert_array_equal(maps, shot.depth_m)
        assert (depth.encoding, shot_ns) == ("32FC1", shot.stamp_ns)

    def test_a_point_lands_on_its_pixel_by_what_the_file_says(
        self, street: Path, tmp_path: Path
    ) -> None:
        pytest.importorskip("foxglove")
        export_run(street, out=tmp_path / "a", to="mcap")
        topics = self.read(tmp_path / "a" / "recording.mcap")
        (timeline,) = timelines(finished_runs(street))
        name = timeline.shots[0].name
        poses = {tf.child_frame_id: tf for _, tf in topics["/tf"]}
        tf, ((_, calibration),) = poses[name], topics[f"/{name}/calibration"]
        assert tf.parent_frame_id == "key" and calibration.distortion_model == "plumb_bob"
        turn = Rotation.from_quat([getattr(tf.rotation, a) for a in "xyzw"])
        origin = [getattr(tf.translation, a) for a in "xyz"]
        ((_, shown),) = topics["/cloud"]
        found = self.points(shown)
        xyz = np.stack([found[a] for a in "xyz"], axis=1).astype(float)
        xyz = turn.inv().apply((xyz - origin)[found["frame"] == KEY])
        uvz = xyz @ np.reshape(calibration.K, (3, 3)).T
        ((_, depth),) = topics[f"/{name}/depth"]
        maps = np.frombuffer(depth.data, "<f4").reshape(depth.height, depth.width)

        def agree(shift_px: int) -> float:
            """Of the pixels with a depth under a point, the share that has the point's."""
            uv = np.rint(uvz[:, :2] / uvz[:, 2:] + shift_px).astype(int)
            inside = (uvz[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < maps.shape[::-1]).all(axis=1)
            at = maps[uv[inside, 1], uv[inside, 0]]
            off = np.abs(at - uvz[inside, 2])[at > 0]
            assert len(off) > 500
            return float((off < 0.05).mean())

        assert agree(0) > 4 * max(agree(2), agree(-2))

    def test_the_same_bytes_again(self, street: Path, tmp_path: Path) -> None:
        pytest.importorskip("foxglove")
        for name in "ab":
            export_run(street, out=tmp_path / name, to="mcap")
        a, b = ((tmp_path / name / "recording.mcap").read_bytes() for name in "ab")
        assert a == b

    def test_a_drive(self, drive: Path, tmp_path: Path) -> None:
        pytest.importorskip("foxglove")
        assert exit_code("export", drive, "--to", "mcap", "--out", tmp_path / "a") == 0
        topics = self.read(tmp_path / "a" / "recording.mcap")
        assert len(topics["/cloud"]) == len(topics["/sweep"]) == 2
        worlds = [tf for _, tf in topics["/tf"] if tf.parent_frame_id == "world"]
        _, second = timelines(finished_runs(drive))
        at = worlds[1].translation
        np.testing.assert_allclose([at.x, at.y, at.z], second.T_world_key[:3, 3])

    def test_lenses(self, tmp_path: Path) -> None:
        pytest.importorskip("foxglove")
        lenses = {n: n for n in ("plain", "bent", "bent5", "bent8", "fisheye", "prism", "mei")}
        run, _ = write_views(tmp_path / "run", lenses)
        export_run(run, out=tmp_path / "a", to="mcap")
        topics = self.read(tmp_path / "a" / "recording.mcap")
        told = {n: topics.get(f"/{n}/calibration") for n in lenses}
        assert told["prism"] is None and told["mei"] is None
        named = {n: (t[0][1].distortion_model, len(t[0][1].D)) for n, t in told.items() if t}
        assert named == {
            "plain": ("plumb_bob", 5),
            "bent": ("plumb_bob", 5),
            "bent5": ("plumb_bob", 5),
            "bent8": ("rational_polynomial", 8),
            "fisheye": ("kannala_brandt", 4),
        }


class TestRerun:
    """Read by rerun's own reader. It is 170 MB, and not among what tests install."""

    @staticmethod
    def read(path: Path) -> dict[str, Any]:
        chunks = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
        found = defaultdict(list)
        for chunk in chunks.RrdReader(str(path)).stream():
            found[chunk.entity_path].append(chunk)
        return found

    @staticmethod
    def values(chunks: list[Any], column: str) -> np.ndarray:
        rows: list[Any] = []
        for chunk in chunks:
            batch = chunk.to_record_batch()
            (name,) = [n for n in batch.schema.names if n.endswith(column)]
            rows += batch.column(name).to_pylist()
        return np.array([value for row in rows for value in row])

    def test_one_key(self, street: Path, tmp_path: Path) -> None:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
        export_run(street, out=tmp_path / "a", to="rrd")
        path = tmp_path / "a" / "recording.rrd"
        found = self.read(path)
        cloud = read_cloud(street / "cloud.laz")
        for name, keep in (("standing", ~cloud.moving), ("moving", cloud.moving)):
            points = self.values(found[f"/world/key/cloud/{name}"], "positions")
            np.testing.assert_array_equal(points, cloud.points[keep].astype(np.float32))
        (timeline,) = timelines(finished_runs(street))
        (shot,) = timeline.shots
        assert sum(chunk.num_rows for chunk in found["/world/key/sweep"]) == 3
        times = {n for chunk in found["/world/key/sweep"] for n in chunk.timeline_names}
        assert times == {"time", "frame"}
        centers = self.values(found["/world/key/movers/box"], "centers")
        (track,) = timeline.tracks
        np.testing.assert_allclose(centers, track.T_key_object[:, :3, 3], atol=1e-5)
        assert f"/world/key/{shot.name}/depth" in found
        done = subprocess.run(["rerun", "rrd", "verify", path], capture_output=True, text=True)
        assert done.returncode == 0 and "without error" in done.stdout + done.stderr

    def test_a_drive(self, drive: Path, tmp_path: Path) -> None:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
        export_run(drive, out=tmp_path / "a", to="rrd")
        found = self.read(tmp_path / "a" / "recording.rrd")
        _, second = timelines(finished_runs(drive))
        moved = self.values(found["/world/key"], "translation")
        np.testing.assert_allclose(moved[1], second.T_world_key[:3, 3], atol=1e-5)

    def test_view_reaches_a_viewer(self, street: Path, tmp_path: Path) -> None:
        """rerun's own server stands for its window and keeps what it is sent."""
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        kept = tmp_path / "kept.rrd"
        server = subprocess.Popen(
            ["rerun", "--port", str(port), "--save", kept],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # the command starts the server itself
        )
        try:
            for _ in range(100):
                with socket.socket() as there:
                    if there.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.2)
            assert exit_code("view", street, "--port", port) == 0
            time.sleep(2.0)
        finally:
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(30)
        found = self.read(kept)
        cloud = read_cloud(street / "cloud.laz")
        points = self.values(found["/world/key/cloud/moving"], "positions")
        np.testing.assert_array_equal(points, cloud.points[cloud.moving].astype(np.float32))


class TestOpen3d:
    """Where it is installed, with a screen: 430 MB, not among what tests install."""

    def test_the_window_follows_its_controls(self, drive: Path) -> None:
        """Two keys of a drive: what is drawn changes with every layer and with the time."""
        reason = "open3d is not installed, or lacks a library of the system"
        o3d = pytest.importorskip("open3d", reason=reason, exc_type=ImportError)
        if "DISPLAY" not in os.environ:
            pytest.skip("no screen")
        application, told = o3d.visualization.gui.Application.instance, []

        def look(viewer: open3d_window.Viewer) -> None:
            def drawn() -> np.ndarray[Any, Any]:
                scene = viewer.layers.widget.scene
                return np.asarray(application.render_to_image(scene, 400, 300)).astype(int)

            def changed(act: Callable[[], None]) -> int:
                before = drawn()
                act()
                return int((np.abs(drawn() - before).max(axis=2) > 20).sum())

            told.append(viewer.num_steps)
            for layer in open3d_window.LAYERS:
                shown = layer != "trails"
                told.append(changed(lambda: viewer.layers.switch(layer, not shown)))  # noqa: B023
                viewer.layers.switch(layer, shown)
            told.append(changed(lambda: viewer.go_to(1)))
            for picture in open3d_window.PICTURES:
                viewer.choose("front", picture)
            viewer.window.close()

        def begun(viewer: open3d_window.Viewer) -> None:
            later = threading.Timer(
                2.0, lambda: application.post_to_main_thread(viewer.window, lambda: look(viewer))
            )
            later.start()

        open3d_window.show(finished_runs(drive), begun)
        num_steps, *changes = told
        assert num_steps == 2 and len(changes) == 7 and min(changes) > 20, changes

    def test_pictures_say_metres(self, street: Path) -> None:
        """The depth's picture is the image's, with a scale below it."""
        (timeline,) = timelines(finished_runs(street))
        (shot,) = timeline.shots
        image, measured, filled = (
            open3d_window._picture(shot, picture) for picture in open3d_window.PICTURES
        )
        assert image.shape == (*shot.depth_m.shape, 3)
        assert measured.shape == filled.shape and measured.shape[0] > image.shape[0]
        assert (measured != filled).any()

    def test_a_library_that_is_missing_is_named(
        self, street: Path, tmp_path: Path, monkeypatch, capsys
    ) -> None:
        """As on machines without libusb."""
        (tmp_path / "open3d.py").write_text("raise ImportError('libusb-1.0.so.0: no such file')")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "open3d", raising=False)
        line = refused(capsys, 2, "view", street, "--with", "open3d")
        assert "open3d, which is installed and cannot be loaded here (libusb-1.0.so.0" in line


@pytest.mark.parametrize(("to", "package"), [("rrd", "rerun"), ("mcap", "foxglove")])
def test_without_the_package_a_line_says_what_to_install(
    to: str, package: str, street: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    line = refused(capsys, 2, "export", street, "--to", to, "--out", tmp_path / "out")
    assert f"pip install 'densify[{'rerun' if to == 'rrd' else 'mcap'}]'" in line
    assert not (tmp_path / "out").exists()


def test_a_viewer_that_is_not_installed_is_named(street: Path, monkeypatch, capsys) -> None:
    for package in ("rerun", "open3d"):
        monkeypatch.setitem(sys.modules, package, None)
        line = refused(capsys, 2, "view", street, "--with", package)
        assert f"pip install 'densify[{package}]'" in line
