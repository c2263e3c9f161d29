# SPDX-License-Identifier: MIT
"""Recordings for viewers: what their own readers find in them."""

from __future__ import annotations

import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import read_depth_png
from densify.outputs.export import export_run
from densify.outputs.finished_run import finished_runs
from densify.outputs.key_outputs import write_result
from densify.outputs.viewers import timelines
from densify.pipeline.run import run
from tests.exported import street_result, write_street, write_views
from tests.small_street import KEY, POSES_GIVEN, one_car


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two keys of one drive."""
    out = tmp_path_factory.mktemp("drive")
    for result in (street_result(), run(one_car(), KEY + 1, 1, "icp", config=POSES_GIVEN)):
        write_result(result, out, config={}, data="tiny street")
    return out


def test_sweeps_are_where_they_were_measured(street: Path) -> None:
    (timeline,) = timelines(finished_runs(street))
    assert [s.frame for s in timeline.sweeps] == [KEY - 1, KEY, KEY + 1]
    stamps_ns = [one_car().stamp_ns(frame) for frame in (KEY - 1, KEY, KEY + 1)]
    assert [s.stamp_ns for s in timeline.sweeps] == stamps_ns
    cloud = read_cloud(street / "cloud.laz")
    (track,) = timeline.tracks
    for sweep in timeline.sweeps:  # the box of that sweep is around what moves in it
        assert len(sweep.points.frame) == np.count_nonzero(
            (cloud.frame == sweep.frame) & ~cloud.far
        )
        T = track.T_key_object[track.frames.index(sweep.frame)]
        moving = sweep.points.select(sweep.points.moving)
        in_object = (moving.rigid_points - T[:3, 3]) @ T[:3, :3]
        inside = (np.abs(in_object) < track.size_m / 2 + 0.2).all(axis=1)
        assert len(inside) > 50 and inside.mean() > 0.95
    (shot,) = timeline.shots
    stored_m = read_depth_png(street / "depth" / f"{shot.name}.png")
    np.testing.assert_array_equal(shot.maps_m["depth"], stored_m)


def test_keys_of_a_drive_lie_in_one_world(drive: Path) -> None:
    first, second = timelines(finished_runs(drive))
    np.testing.assert_array_equal(first.T_world_key, np.eye(4))
    sequence = one_car()
    true = np.linalg.inv(sequence.T_world_lidar(KEY)) @ sequence.T_world_lidar(KEY + 1)
    np.testing.assert_allclose(second.T_world_key, true, atol=1e-6)
    assert [len(t.sweeps) for t in (first, second)] == [1, 1]


def test_keys_whose_relative_pose_is_unknown_are_refused(street: Path, tmp_path: Path) -> None:
    for name in ("000060", "000061"):
        (tmp_path / name).symlink_to(street)
    runs = finished_runs(tmp_path)
    for one in runs:
        one.scene.T_key_lidar.pop(KEY)  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="their relative pose is unknown"):
        list(timelines(runs))


# --- MCAP -----------------------------------------------------------------------------------------


def read_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    topics = defaultdict(list)
    with path.open("rb") as file:
        rows = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, message, decoded in rows.iter_decoded_messages():
            assert schema.name == f"foxglove.{type(decoded).__name__}"
            topics[channel.topic].append((message.log_time, decoded))
    return topics


def points_of(cloud: Any) -> dict[str, np.ndarray]:
    kinds = {1: "u1", 5: "<u4", 6: "<i4", 7: "<f4"}
    names = [f.name for f in cloud.fields]
    formats, offsets = [kinds[f.type] for f in cloud.fields], [f.offset for f in cloud.fields]
    layout = {"names": names, "formats": formats, "offsets": offsets}
    table = np.frombuffer(cloud.data, np.dtype({**layout, "itemsize": cloud.point_stride}))
    return {name: table[name] for name in names}


@pytest.fixture(scope="module")
def topics(street: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    pytest.importorskip("foxglove")
    out = tmp_path_factory.mktemp("mcap")
    export_run(street, "mcap", out / "a")
    return read_mcap(out / "a" / "recording.mcap")


def test_mcap_of_one_key(topics, street: Path) -> None:
    cloud = read_cloud(street / "cloud.laz")
    ((start_ns, shown),) = topics["/cloud"]
    found = points_of(shown)
    np.testing.assert_array_equal(found["x"], cloud.points[:, 0].astype(np.float32))
    for name in ("instance", "frame", "confidence"):
        np.testing.assert_array_equal(found[name], getattr(cloud, name))
    observed = cloud.rgb.any(axis=1)
    np.testing.assert_array_equal(found["red"][observed], cloud.rgb[observed, 0])
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
    np.testing.assert_array_equal(maps, shot.maps_m["depth"])
    assert (depth.encoding, shot_ns) == ("32FC1", shot.stamp_ns)
    view = street_result().views["front"]
    ((_, calibration),) = topics["/front/calibration"]
    np.testing.assert_allclose(np.reshape(calibration.K, (3, 3)), view.camera.K)
    (tf,) = [tf for _, tf in topics["/tf"] if tf.child_frame_id == "front"]
    matrix = Rotation.from_quat([getattr(tf.rotation, a) for a in "xyzw"]).as_matrix()
    np.testing.assert_allclose(matrix.T, view.T_cam_key[:3, :3], atol=1e-9)
    origin = [getattr(tf.translation, a) for a in "xyz"]
    np.testing.assert_allclose(-matrix.T @ origin, view.T_cam_key[:3, 3], atol=1e-9)
    assert tf.parent_frame_id == "key" and calibration.distortion_model == "plumb_bob"


def test_mcap_of_a_drive(drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    export_run(drive, "mcap", tmp_path / "a")
    found = read_mcap(tmp_path / "a" / "recording.mcap")
    assert len(found["/cloud"]) == len(found["/sweep"]) == 2
    worlds = [tf for _, tf in found["/tf"] if tf.parent_frame_id == "world"]
    _, second = timelines(finished_runs(drive))
    at = worlds[1].translation
    np.testing.assert_allclose([at.x, at.y, at.z], second.T_world_key[:3, 3])


def test_lenses_in_mcap(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    lenses = {n: n for n in ("plain", "bent", "bent5", "bent8", "fisheye", "prism", "mei")}
    export_run(write_views(tmp_path / "run", lenses)[0], "mcap", tmp_path / "a")
    found = read_mcap(tmp_path / "a" / "recording.mcap")
    told = {n: found[f"/{n}/calibration"][0][1] for n in lenses if f"/{n}/calibration" in found}
    assert {n: (told[n].distortion_model, len(told[n].D)) for n in told} == {
        **dict.fromkeys(("plain", "bent", "bent5"), ("plumb_bob", 5)),
        "bent8": ("rational_polynomial", 8),
        "fisheye": ("kannala_brandt", 4),
    }


# --- rerun: 170 MB, and not among what tests install ----------------------------------------------


def read_rrd(path: Path) -> dict[str, Any]:
    chunks = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    found = defaultdict(list)
    for chunk in chunks.RrdReader(str(path)).stream():
        found[chunk.entity_path].append(chunk)
    return found


def values_of(chunks: list[Any], column: str) -> np.ndarray:
    rows: list[Any] = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        (name,) = [n for n in batch.schema.names if n.endswith(column)]
        rows += batch.column(name).to_pylist()
    return np.array([value for row in rows for value in row])


def test_rrd_of_one_key_and_of_a_drive(street: Path, drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    export_run(street, "rrd", tmp_path / "a")
    found, cloud = read_rrd(tmp_path / "a" / "recording.rrd"), read_cloud(street / "cloud.laz")
    for name, keep in (("static", ~cloud.moving), ("moving", cloud.moving)):
        points = values_of(found[f"/world/key/cloud/{name}"], "positions")
        np.testing.assert_array_equal(points, cloud.points[keep].astype(np.float32))
    (timeline,) = timelines(finished_runs(street))
    assert sum(chunk.num_rows for chunk in found["/world/key/sweep"]) == 3
    times = {n for chunk in found["/world/key/sweep"] for n in chunk.timeline_names}
    assert times == {"time", "frame"}
    centers = values_of(found["/world/key/movers/box"], "centers")
    np.testing.assert_allclose(centers, timeline.tracks[0].T_key_object[:, :3, 3], atol=1e-5)
    assert "/world/key/front/depth" in found
    export_run(drive, "rrd", tmp_path / "b")
    _, second = timelines(finished_runs(drive))
    found = read_rrd(tmp_path / "b" / "recording.rrd")
    moved = values_of(found["/world/key"], "translation")
    np.testing.assert_allclose(moved[1], second.T_world_key[:3, 3], atol=1e-5)
    path = tmp_path / "a" / "recording.rrd"
    done = subprocess.run(["rerun", "rrd", "verify", path], capture_output=True, text=True)
    assert done.returncode == 0 and "without error" in done.stdout + done.stderr
