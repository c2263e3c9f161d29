# SPDX-License-Identifier: MIT
"""Recordings for viewers and tracking labels: what their own readers find in them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import read_depth_png
from densify.outputs.finished_run import export_run, finished_runs
from densify.outputs.key_outputs import write_result
from densify.outputs.viewers import timelines
from densify.readers.kitti import KittiTracking, open_recording, read_labels
from tests.exported import drive_results, refused, write_drive, write_views
from tests.scenes import SWEEP_S
from tests.small_street import KEY, one_car


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def street(drive: Path) -> Path:
    return drive / f"{KEY:06d}"


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
    for run in runs:
        run.scene.T_key_lidar.pop(KEY)  # type: ignore[attr-defined]
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
    view = drive_results()[KEY].views["front"]
    ((_, calibration),) = topics["/front/calibration"]
    np.testing.assert_allclose(np.reshape(calibration.K, (3, 3)), view.camera.K)
    (tf,) = [tf for _, tf in topics["/tf"] if tf.child_frame_id == "front"]
    matrix = Rotation.from_quat([getattr(tf.rotation, a) for a in "xyzw"]).as_matrix()
    np.testing.assert_allclose(matrix.T, view.T_cam_key[:3, :3], atol=1e-9)
    origin = [getattr(tf.translation, a) for a in "xyz"]
    np.testing.assert_allclose(-matrix.T @ origin, view.T_cam_key[:3, 3], atol=1e-9)
    assert tf.parent_frame_id == "key" and calibration.distortion_model == "plumb_bob"


def test_mcap_of_a_drive_and_of_all_lenses(drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    export_run(drive, "mcap", tmp_path / "a")
    topics = read_mcap(tmp_path / "a" / "recording.mcap")
    assert len(topics["/cloud"]) == len(topics["/sweep"]) == 2
    worlds = [tf for _, tf in topics["/tf"] if tf.parent_frame_id == "world"]
    _, second = timelines(finished_runs(drive))
    at = worlds[1].translation
    np.testing.assert_allclose([at.x, at.y, at.z], second.T_world_key[:3, 3])
    lenses = {n: n for n in ("plain", "bent", "bent5", "bent8", "fisheye", "prism", "mei")}
    export_run(write_views(tmp_path / "run", lenses)[0], "mcap", tmp_path / "b")
    topics = read_mcap(tmp_path / "b" / "recording.mcap")
    shown = {n: topics[f"/{n}/calibration"][0][1] for n in lenses if topics[f"/{n}/calibration"]}
    assert {n: (lens.distortion_model, len(lens.D)) for n, lens in shown.items()} == {
        **dict.fromkeys(("plain", "bent", "bent5"), ("plumb_bob", 5)),
        "bent8": ("rational_polynomial", 8),
        "fisheye": ("kannala_brandt", 4),
    }


# --- KITTI tracking ------------------------------------------------------------------------------


def write_set(out: Path, **sizes_m: float) -> Path:
    """The folder of both keys; ``k3=2.0`` cuts the car of key 3 to 2 m, its front not seen."""
    for key, result in drive_results().items():
        tracks = []
        for track in result.tracks:
            length_m = sizes_m.get(f"k{key}", track.size_m[0])
            behind_m = (length_m - track.size_m[0]) / 2
            T = track.T_key_object @ poses.exp(np.array([0, 0, 0, behind_m, 0, 0]))
            seen = track.sides_seen if f"k{key}" not in sizes_m else ("rear", "left", "right")
            size_m = np.array([length_m, *track.size_m[1:]])
            tracks.append(replace(track, size_m=size_m, T_key_object=T, sides_seen=seen))
        write_result(replace(result, tracks=tuple(tracks)), out, config={}, data="tiny street")
    return out


def exported(folder: Path) -> KittiTracking:
    export_run(folder, "kitti-tracking")
    return open_recording(folder / "export" / "kitti-tracking", "0000")


def test_the_reader_reads_boxes_sweep_image_and_camera(street: Path) -> None:
    result, recording = drive_results()[KEY], exported(street)
    assert recording.frames == (KEY,) and [*recording.cameras] == ["image_02"]
    (track,), boxes = result.tracks, recording.boxes(KEY)
    assert boxes is not None and len(boxes.track) == 1
    np.testing.assert_allclose(boxes.size_m, track.size_m[None], atol=1e-5)
    # The box is where the sweep measured the car, and so are the points in it.
    T = boxes.T_lidar_box[0]
    at_reference = track.T_key_object[track.frames.index(KEY)]
    late_m = T[:3, 3] - at_reference[:3, 3]
    assert abs(late_m[0]) <= 8 * SWEEP_S / 2 + 0.05 and np.abs(late_m[1:]).max() < 0.05
    np.testing.assert_allclose(T[:2, 0], at_reference[:2, 0], atol=0.02)
    cloud = result.cloud
    mine = (cloud.frame == KEY) & (cloud.instance == track.instance)
    inside = poses.transform(poses.inverse(T), cloud.rigid_points[mine])
    assert (np.abs(inside) <= track.size_m / 2 + 0.05).mean() > 0.95
    assert len(recording[KEY]) == (cloud.frame == KEY).sum()
    numbers, _ = read_labels(street / "export" / "kitti-tracking" / "label_02" / "0000.txt")
    alpha, x, z, turn = numbers[0, [4, 12, 14, 15]]
    assert np.cos(alpha - turn + np.arctan2(x, z)) == pytest.approx(1, abs=1e-6)
    camera, name = recording.cameras["image_02"], next(iter(result.views))
    np.testing.assert_allclose(camera.K, result.views[name].camera.K, rtol=1e-9)
    T_cam_lidar = result.views[name].camera.T_cam_lidar
    np.testing.assert_allclose(camera.T_cam_lidar, T_cam_lidar, atol=1e-9)


def test_a_track_has_one_number_and_one_size_in_all_keys(tmp_path: Path) -> None:
    recording = exported(write_set(tmp_path / "whole"))
    after, before = (recording.boxes(key) for key in (KEY, KEY + 1))
    assert before is not None and after is not None
    assert [*before.track] == [*after.track] and len(before.track) == 1
    np.testing.assert_allclose(before.size_m[0, :2], after.size_m[0, :2])
    cut = exported(write_set(tmp_path / "cut", **{f"k{KEY}": 2.0})).boxes(KEY)
    assert cut is not None
    rear = [(b.T_lidar_box[0] @ [-b.size_m[0, 0] / 2, 0, 0, 1])[0] for b in (cut, after)]
    (other,) = drive_results()[KEY + 1].tracks
    np.testing.assert_allclose(cut.size_m[0, 0], other.size_m[0], atol=1e-5)
    assert rear[0] == pytest.approx(rear[1], abs=0.05)  # the side that was seen keeps its place


def test_images_with_distortion_are_refused(tmp_path: Path) -> None:
    run = write_views(tmp_path / "run", {"image_02": "bent"})[0]
    refused("image_02", "--camera", run=run, to="kitti-tracking")


# --- rerun: 170 MB, and not among what tests install ----------------------------------------------


def test_rrd_of_one_key(street: Path, tmp_path: Path) -> None:
    chunks = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    export_run(street, "rrd", tmp_path)
    found = defaultdict(list)
    for chunk in chunks.RrdReader(str(tmp_path / "recording.rrd")).stream():
        found[chunk.entity_path].append(chunk)

    def values(entity: str, column: str) -> np.ndarray:
        rows: list[Any] = []
        for batch in (chunk.to_record_batch() for chunk in found[entity]):
            (name,) = [n for n in batch.schema.names if n.endswith(column)]
            rows += batch.column(name).to_pylist()
        return np.array([value for row in rows for value in row])

    cloud = read_cloud(street / "cloud.laz")
    for name, keep in (("static", ~cloud.moving), ("moving", cloud.moving)):
        points = values(f"/world/key/cloud/{name}", "positions")
        np.testing.assert_array_equal(points, cloud.points[keep].astype(np.float32))
    (timeline,) = timelines(finished_runs(street))
    assert sum(chunk.num_rows for chunk in found["/world/key/sweep"]) == 3
    centers = values("/world/key/movers/box", "centers")
    np.testing.assert_allclose(centers, timeline.tracks[0].T_key_object[:, :3, 3], atol=1e-5)
    assert "/world/key/front/depth" in found
