# SPDX-License-Identifier: MIT
"""Exports of what moves: tables, KITTI's label lines, and clouds of objects by themselves."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.types import ObjectTrack
from densify.outputs import export_run, read_cloud, write_cloud
from tests.exported import street_result, write_street, write_views
from tests.small_street import KEY
from tests.test_export import KEY_NS, H, W, refused
from tests.test_export_formats import cloud_of


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("street"))


@pytest.fixture
def bare(tmp_path):
    return write_views(tmp_path, {"image_02": "plain", "image_03": "fisheye"})[0]


def put_tracks(run, *tracks: ObjectTrack):
    """As movers.json of the run, and as the run's poses: a vehicle that drives 1 m a sweep."""
    objects = [
        {
            "instance": track.instance,
            "size_m": track.size_m.tolist(),
            "poses": [
                {
                    "frame": frame,
                    "stamp_ns": int(track.stamp_ns[i]),
                    "num_points": int(track.num_points[i]),
                    "T_key_object": track.T_key_object[i].tolist(),
                    "velocity_m_s": track.velocity_m_s[i].tolist(),
                }
                for i, frame in enumerate(track.frames)
            ],
        }
        for track in tracks
    ]
    (run / "movers.json").write_text(json.dumps({"objects": objects}))
    path = run / "scene" / "scene.json"
    scene = json.loads(path.read_text())
    for sweep in scene["sweeps"]:
        T = np.eye(4)
        T[0, 3] = sweep["frame"] - 120
        sweep["T_key_lidar"] = T.tolist()
    path.write_text(json.dumps(scene))


def track_of(instance=7, x_m=12.0, y_m=1.0, heading=0.3) -> ObjectTrack:
    T = poses.exp(np.array([0, 0, heading, x_m, y_m, -0.8]))
    ahead = T.copy()
    ahead[:3, 3] += [0.5, 0.25, 0.0]
    return ObjectTrack(
        instance=instance,
        size_m=np.array([4.0, 1.75, 1.5]),
        frames=(120, 121),
        stamp_ns=np.array([KEY_NS, KEY_NS + 100_000_001]),
        T_key_object=np.stack([T, ahead]),
        velocity_m_s=np.array([[5.0, 2.5, 0.0]] * 2),
        num_points=np.array([33, 20]),
    )


# --- tables ---------------------------------------------------------------------------------------


def test_tables_hold_every_number(bare):
    tracks = (track_of(), track_of(9, heading=-3.0))
    put_tracks(bare, *tracks)
    export_run(bare, to="tracks")
    folder = bare / "export" / "tracks"
    with (folder / "tracks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    named = json.loads((folder / "tracks.json").read_text())
    assert named["key"] == 120
    assert [{k: str(v) for k, v in row.items()} for row in named["tracks"]] == rows
    assert len(rows) == 4
    for row, (track, i) in zip(rows, [(t, i) for t in tracks for i in (0, 1)], strict=True):
        assert int(row["object"]) == track.instance and int(row["frame"]) == track.frames[i]
        assert int(row["stamp_ns"]) == track.stamp_ns[i]  # to the nanosecond
        assert int(row["num_points"]) == track.num_points[i]
        place = [float(row[n]) for n in ("x_m", "y_m", "z_m")]
        np.testing.assert_array_equal(place, track.T_key_object[i, :3, 3])
        turn = Rotation.from_quat([float(row[n]) for n in ("qx", "qy", "qz", "qw")])
        np.testing.assert_allclose(turn.as_matrix(), track.T_key_object[i, :3, :3], atol=1e-12)
        size = [float(row[n]) for n in ("length_m", "width_m", "height_m")]
        np.testing.assert_array_equal(size, track.size_m)
        speed = [float(row[n]) for n in ("vx_m_s", "vy_m_s", "vz_m_s")]
        np.testing.assert_array_equal(speed, track.velocity_m_s[i])


def test_a_run_writes_what_was_found(street):
    tracks = street_result().tracks
    table = json.loads((street / "movers.json").read_text())
    assert table["schema_version"] == 1 and table["key"] == KEY
    assert [entry["instance"] for entry in table["objects"]] == [t.instance for t in tracks]
    for entry, track in zip(table["objects"], tracks, strict=True):
        np.testing.assert_array_equal(entry["size_m"], track.size_m)
        for name in ("T_key_object", "velocity_m_s", "stamp_ns", "num_points"):
            values = [pose[name] for pose in entry["poses"]]
            np.testing.assert_array_equal(values, getattr(track, name))
    export_run(street, to="tracks")
    rows = (street / "export" / "tracks" / "tracks.csv").read_text().splitlines()
    assert len(rows) == 1 + sum(len(track.frames) for track in tracks) > 3


def test_nothing_moves(bare):
    put_tracks(bare)
    for to in ("tracks", "kitti-tracking"):
        export_run(bare, to=to)
    assert len((bare / "export" / "tracks" / "tracks.csv").read_text().splitlines()) == 1
    assert (bare / "export" / "kitti-tracking" / "label" / "image_02.txt").read_text() == ""


# --- KITTI ----------------------------------------------------------------------------------------


def labels(run, camera="image_02"):
    """By the development kit's description: 17 columns."""
    rows = []
    text = (run / "export" / "kitti-tracking" / "label" / f"{camera}.txt").read_text()
    for line in text.splitlines():
        frame, instance, kind, truncated, occluded, *numbers = line.split()
        assert len(numbers) == 12 and kind == "Misc" and occluded == "3"
        values = list(map(float, numbers))
        rows.append((int(frame), int(instance), int(truncated), values))
    return rows


def test_label_lines_are_boxes_in_the_camera_frame(bare):
    tracks = (track_of(), track_of(9, y_m=-1.0, heading=-3.0), track_of(11, x_m=-20))
    put_tracks(bare, *tracks)
    export_run(bare, to="kitti-tracking")
    rows = labels(bare)
    assert [(frame, instance) for frame, instance, *_ in rows] == [
        (120, 7),
        (120, 9),
        (121, 7),
        (121, 9),
    ]
    scene = json.loads((bare / "scene" / "scene.json").read_text())
    camera = scene["views"]["image_02"]
    K, T_cam_lidar = np.array(camera["K"]), np.array(camera["T_cam_lidar"])
    for frame, instance, truncated, values in rows:
        track = next(t for t in tracks if t.instance == instance)
        i = track.frames.index(frame)
        alpha, left, top, right, bottom, height, width, length, x, y, z, ry = values
        np.testing.assert_allclose([length, width, height], track.size_m, atol=1e-6)
        # KITTI's own corners: computeBox3D.m of the development kit
        R = [[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]]
        xs = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
        ys = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
        zs = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
        corners = (np.array(R) @ [xs, ys, zs]).T + [x, y, z]
        T_lidar_key = np.eye(4)
        T_lidar_key[0, 3] = -(frame - 120)
        ours = [[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)]
        T = T_cam_lidar @ T_lidar_key @ track.T_key_object[i]
        true = np.array(ours) * track.size_m @ T[:3, :3].T + T[:3, 3]
        off = np.linalg.norm(corners[:, None] - true[None], axis=2).min(axis=1)
        assert off.max() < 1e-5
        uv = (K @ (true / true[:, 2:]).T)[:2]
        box = np.clip([*uv.min(axis=1), *uv.max(axis=1)], 0, [W - 1, H - 1] * 2)
        np.testing.assert_allclose([left, top, right, bottom], box, atol=1e-5)
        np.testing.assert_allclose(np.cos(alpha - ry + np.arctan2(x, z)), 1, atol=1e-9)
        assert -np.pi <= alpha <= np.pi
        whole = (uv.min(axis=1) >= 0).all() and (uv.max(axis=1) <= [W - 1, H - 1]).all()
        assert (truncated == 0) == whole
    assert labels(bare, "image_03")  # a lens is no obstacle


def test_the_street_car_is_on_its_image(street):
    export_run(street, to="kitti-tracking")
    rows = labels(street, "front")
    assert {frame for frame, *_ in rows} == {KEY - 1, KEY, KEY + 1}
    result = street_result()
    moving = result.cloud.select(result.cloud.moving & (result.cloud.frame == KEY))
    view = result.views["front"]
    at = poses.transform(view.T_cam_key, moving.points)
    uv = (view.camera.K @ (at / at[:, 2:]).T)[:2].T
    instance = np.bincount(moving.instance).argmax()
    (values,) = [v for frame, number, _, v in rows if (frame, number) == (KEY, instance)]
    left, top, right, bottom = values[1:5]
    inside = (uv >= [left - 2, top - 2]).all(axis=1) & (uv <= [right + 2, bottom + 2]).all(axis=1)
    assert inside.mean() > 0.95


# --- splats ---------------------------------------------------------------------------------------


def test_splats_keep_movers_apart_in_their_own_frames(bare):
    tracks = (track_of(3), track_of(5, heading=2.0))
    put_tracks(bare, *tracks)
    export_run(bare, to="splats")
    folder, cloud = bare / "export" / "splats", read_cloud(bare / "cloud.laz")
    standing = PlyData.read(folder / "sparse" / "0" / "points3D.ply")["vertex"].data
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    assert standing.dtype.names == names
    assert len(standing) == (~cloud.moving & cloud.rgb.any(axis=1)).sum() > 0
    seen = []
    for track in tracks:
        own = PlyData.read(folder / "movers" / f"{track.instance:04d}.ply")["vertex"].data
        points = poses.transform(
            track.T_key_object[0], np.stack([own[a] for a in "xyz"], axis=1).astype(float)
        )
        mine = cloud.instance == track.instance
        np.testing.assert_allclose(points, cloud.points[mine], atol=1e-4)
        np.testing.assert_array_equal(own["green"], cloud.rgb[mine, 1])
        seen.append(mine)
    others = PlyData.read(folder / "movers" / "others.ply")["vertex"].data
    rest = cloud.moving & ~np.any(seen, axis=0)
    np.testing.assert_array_equal(others["x"], cloud.points[rest, 0].astype(np.float32))
    table = json.loads((folder / "tracks.json").read_text())
    assert [entry["instance"] for entry in table["objects"]] == [3, 5]
    assert table["objects"] == json.loads((bare / "movers.json").read_text())["objects"]


def test_splats_by_colmaps_own_reader(bare):
    pycolmap = pytest.importorskip("pycolmap")
    put_tracks(bare)
    export_run(bare, to="splats")
    model = pycolmap.Reconstruction(str(bare / "export" / "splats" / "sparse" / "0"))
    assert len(model.images) == 2 and len(model.points3D) > 0


def test_movers_that_the_run_has_apart_are_there(bare):
    put_tracks(bare, track_of(3))
    cloud = cloud_of()
    write_cloud(bare / "cloud.laz", cloud.select(~cloud.moving), KEY_NS)
    for instance in (3, 4):
        (bare / "movers" / f"{instance:04d}").mkdir(parents=True)
        mine = cloud.select(cloud.instance == instance)
        write_cloud(bare / "movers" / f"{instance:04d}" / "cloud.laz", mine, KEY_NS)
    exported = export_run(bare, 0.5, to="splats")
    folder = bare / "export" / "splats" / "movers"
    kept = [int(((cloud.instance == i) & (cloud.confidence >= 0.499)).sum()) for i in (3, 4)]
    found = [len(PlyData.read(folder / n)["vertex"].data) for n in ("0003.ply", "others.ply")]
    assert found == kept and min(kept) > 2
    assert exported.num_points is not None
    moving = int(np.isin(cloud.instance, (3, 4)).sum())
    assert exported.num_points.before == moving + int((~cloud.moving).sum())


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", ["tracks", "kitti-tracking"])
def test_thresholds_say_nothing_of_objects(bare, to):
    put_tracks(bare, track_of())
    refused(f"--to {to}", "--min-confidence", run=bare, to=to, min_confidence=0.5)
    refused(f"--to {to}", "--max-age-ms", run=bare, to=to, max_age_ms=0)


DAMAGE = {
    "objects": {},
    "objects[0].instance": -1,
    "objects[0].size_m": [1, 2],
    "objects[0].poses": [],
    "objects[0].poses[0].stamp_ns": 1.5,
    "objects[0].poses[0].T_key_object": [[0, 0, 0, None]] * 4,
    "objects[0].poses[1].T_key_object": np.zeros((4, 4)).tolist(),
    "objects[0].poses[0].velocity_m_s": "fast",
    "objects[0].poses[0].frame": "x",
}


@pytest.mark.parametrize("place", DAMAGE)
def test_damaged_tracks_are_named(bare, place):
    put_tracks(bare, track_of())
    path = bare / "movers.json"
    table = json.loads(path.read_text())
    *way, last = place.replace("[", ".").replace("]", "").split(".")
    inner = table
    for name in way:
        inner = inner[int(name) if name.isdigit() else name]
    inner[last] = DAMAGE[place]
    path.write_text(json.dumps(table))
    refused(path, place, "expected", run=bare, to="tracks")


def test_runs_without_tracks(bare):
    put_tracks(bare, track_of())
    table = json.loads((bare / "movers.json").read_text())
    del table["objects"][0]["poses"][0]
    (bare / "movers.json").write_text(json.dumps(table))
    refused("object 7 has no pose at key 120", run=bare, to="tracks")
    (bare / "movers.json").unlink()
    refused("movers.json: not there", "densify the key again", run=bare, to="splats")
