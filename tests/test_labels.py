# SPDX-License-Identifier: MIT
"""Scene flow from boxes: by hand, and on a street that writes its boxes against its exact flow."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from writers import write_street
from writers.pandaset import put_frame

from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from densify.geometry.types import Boxes, BoxView, Camera, RegisteredSweep, Sweep
from densify.learning.labels import BoxMargins, flow_of_boxes, label_sweeps
from densify.readers import open_sequence
from densify.readers.kitti_files import Calibration
from densify.readers.nuscenes import Annotations
from densify.readers.street import Street
from densify.readers.waymo import STAMP
from tests.command import refused
from tests.test_reader_damage import cut, remove, swap

pyarrow = pytest.importorskip("pyarrow")
FRAMES = range(60, 63)
GIVEN = resolve(None, ["register.source=dataset"])


def boxes(*placed: tuple[int, float, float, float]) -> Boxes:
    """track, x, y, yaw; 4 x 2 x 1.5 m."""
    T = []
    for _, x, y, yaw in placed:
        c, s = np.cos(yaw), np.sin(yaw)
        T.append([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])
    return Boxes(
        np.array([str(p[0]) for p in placed]),
        np.reshape(np.array(T, float), (-1, 4, 4)),
        np.tile([4.0, 2.0, 1.5], (len(placed), 1)),
    )


def sweep(
    points: np.ndarray, T_world_lidar: np.ndarray | None = None, late_s: float = 0.0, **columns
) -> RegisteredSweep:
    """At 10 m/s ahead."""
    num = len(points)
    zeros = np.zeros(num)
    measured = Sweep(
        frame=0,
        stamp_ns=round(late_s * 1e9),
        points=points,
        intensity=zeros.astype(np.float32),
        offset_ns=None,
        lidar=columns.get("lidar", zeros).astype(np.uint8),
        row=np.arange(num),
    )
    twist = np.array([0, 0, 0, 10.0, 0, 0])
    return RegisteredSweep(
        measured, np.eye(4) if T_world_lidar is None else T_world_lidar, *2 * [twist]
    )


def flow(points, here, there, T_here_next=None, margins=None, **columns):
    """To a sweep 0.1 s later."""
    source = sweep(points, **columns)
    target = sweep(np.zeros((0, 3)), T_here_next, late_s=0.1)
    return flow_of_boxes(source, target, here, there, margins)


def test_points_in_a_box_turn_with_it() -> None:
    points = np.array([[11.0, 0, 0], [9, 0.5, 0], [20, 0, 0]])
    field, sure = flow(points, boxes((7, 10, 0, 0)), boxes((7, 11, 0, np.pi / 2)))
    np.testing.assert_allclose(field.displacement, [[0, 1, 0], [1.5, -1.5, 0], [0, 0, 0]])
    assert field.moving.tolist() == [True, True, False] and sure.all()
    assert field.instance.tolist() == [0, 0, -1]


def test_the_vehicles_own_motion_is_taken_out() -> None:
    """The vehicle drives 2 m ahead; a parked car is 2 m nearer afterwards, and stands."""
    T_here_next = np.eye(4)
    T_here_next[0, 3] = 2.0
    points = np.array([[10.0, 0, 0]])
    field, _ = flow(points, boxes((1, 10, 0, 0)), boxes((1, 8, 0, 0)), T_here_next)
    assert not field.moving.any() and not field.displacement.any()
    field, _ = flow(points, boxes((1, 10, 0, 0)), boxes((1, 9, 0, 0)), T_here_next)
    np.testing.assert_allclose(field.displacement, [[1, 0, 0]])


def test_what_is_unsure_does_not_count() -> None:
    """In two boxes, just outside one, in one that vanishes."""
    here = boxes((1, 0, 0, 0), (2, 3, 0, 0), (3, 30, 0, 0))
    there = boxes((1, 1, 0, 0), (2, 3, 0, 0))
    points = np.array([[1.5, 0, 0], [-2.25, 0, 0], [-2.05, 0, 0], [30, 0, 0], [-9, 0, 0]])
    field, sure = flow(points, here, there, margins=BoxMargins(0.1, 0.3))
    assert sure.tolist() == [False, False, True, False, True]
    assert field.moving.tolist() == [False, False, True, False, False]


@pytest.mark.parametrize(("shift_m", "sure_below"), [(1, False), (0, True)])
def test_the_road_below_what_moves_is_unsure(shift_m, sure_below) -> None:
    """A box 1.5 m high: within 0.1 m of its bottom, unless it stands. Without a track: all."""
    points = np.array([[0.0, 0, -0.8], [0, 0, -0.7], [0, 0, -0.6]])
    here, there = boxes((1, 0, 0, 0)), boxes((1, shift_m, 0, 0))
    assert flow(points, here, there)[1].tolist() == [sure_below, sure_below, True]
    untracked = (replace(box, track=np.array([""])) for box in (here, there))
    field, sure = flow(points[2:], *untracked)
    assert not sure.any() and not field.moving.any() and not field.displacement.any()


def test_a_box_of_one_scanner_holds_its_points_alone() -> None:
    """As where two scanners meet the same car at different times."""
    here = replace(boxes((1, 0, 0, 0), (2, 1, 0, 0)), lidar=np.array([0, 1]))
    there = boxes((1, 1, 0, 0), (2, 3, 0, 0))
    field, sure = flow(np.zeros((3, 3)), here, there, lidar=np.array([0, 1, 2]))
    assert sure.all() and field.instance.tolist() == [0, 1, -1]
    np.testing.assert_allclose(field.displacement[:, 0], [1, 2, 0])


def test_boxes_of_another_time_are_carried_as_points_are() -> None:
    """At 10 m/s what was met 20 ms before the reference time is 0.2 m nearer at it."""
    here = replace(boxes((1, 10.2, 0, 0)), offset_ns=np.array([-20_000_000]))
    points = np.array([[12.05, 0.0, 0.0], [12.15, 0.0, 0.0], [7.95, 0.0, 0.0]])
    field, sure = flow(points, here, boxes((1, 11, 0, 0)), margins=BoxMargins(0.1, 0.0))
    assert field.instance.tolist() == [0, -1, 0] and sure.all()
    np.testing.assert_allclose(field.displacement, [[1, 0, 0], [0, 0, 0], [1, 0, 0]], atol=1e-12)


def test_where_nobody_drew_boxes_is_unsure() -> None:
    """Beside the image of a camera that looks ahead, and in a rectangle of it."""
    K = np.array([[100.0, 0, 49.5], [0, 100, 49.5], [0, 0, 1]])
    T_cam_lidar = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    camera = Camera("cam", 100, 100, K, T_cam_lidar)
    view = BoxView(camera, np.array([[0.0, 0, 20, 99]]))
    points = np.array([[10.0, 0, 0], [10, 4, 0], [10, 6, 0], [-10, 0, 0], [10, -4, 0]])
    _, sure = flow(points, replace(boxes(), view=view), boxes())
    assert sure.tolist() == [True, False, False, False, True]


class Written(NamedTuple):
    """A street in a format, and the share of the points of which its boxes tell the flow."""

    street: Street
    frames: Sequence[int] = FRAMES
    least_valid: float = 0.98
    most_valid: float = 1.0


_CROSSING = Street("crossing", 5, "vlp16", cameras=())
WRITTEN = {
    "argoverse2": Written(_CROSSING, frames=(60, 61)),
    "waymo": Written(_CROSSING),
    "pandaset": Written(Street("crossing", 5, "pandaset", cameras=()), frames=(60, 61)),
    # the first and the last sweep are key frames
    "nuscenes": Written(
        Street("crossing", 5, "hdl32", hz=20, cameras=()), frames=(120, 124, 125, 130)
    ),
    "kitti-tracking": Written(_CROSSING, least_valid=0.15, most_valid=0.25),  # one camera's view
}


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> Callable[[str], Path]:
    """Where a street is written in a format."""

    @cache
    def place(format: str) -> Path:
        street, frames, *_ = WRITTEN[format]
        return write_street(format, street, tmp_path_factory.mktemp(format), frames)

    return place


@pytest.mark.parametrize("format", WRITTEN)
def test_labels_of_a_street_are_its_exact_flow(format, places, tmp_path: Path, capsys) -> None:
    out, place, written = tmp_path / "labels", places(format), WRITTEN[format]
    num = len(written.frames) - 1
    assert main(["labels", "--data", str(place), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{num} sweep" in said
    files = [f"{i:06d}_{i + 1:06d}.npz" for i in range(num)]
    assert sorted(path.name for path in out.iterdir()) == files
    sequence = open_sequence(str(place))
    found, true_m, step_s = [], [], []
    for i in range(num):
        with np.load(out / files[i]) as file:
            found.append(dict(file))
        step_ns = sequence.stamp_ns(i + 1) - sequence.stamp_ns(i)
        step_s.append(np.full(len(found[i]["row"]), step_ns * 1e-9))
        true_m.append(sequence.truth.displacement(i, i + 1)[found[i]["row"]])
    flow, moving, valid = (
        np.concatenate([f[name] for f in found]) for name in ("residual_flow", "moving", "valid")
    )
    true = np.concatenate(true_m)
    way_m, error_m = np.linalg.norm(true, axis=1), np.linalg.norm(flow - true, axis=1)
    fast = way_m >= 1.0 * np.concatenate(step_s)
    moves, stands = valid & fast, valid & ~fast
    assert moves.sum() > 100 and way_m[moves].mean() > 0.3
    assert np.median(error_m[moves]) < 0.05 and error_m[moves].mean() < 0.1 * way_m[moves].mean()
    assert moving[moves].mean() > 0.95
    # what stands in a box that moves
    assert (error_m[stands] > 0.05).sum() < 0.002 * len(valid)
    assert written.least_valid <= valid.mean() <= written.most_valid


def test_a_recording_without_boxes_is_refused(tmp_path: Path, capsys) -> None:
    assert main(["labels", "--data", "street", "--out", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert "no tracked boxes; expected one of annotations.feather (argoverse2)" in said
    assert not (tmp_path / "x").exists()


# Waymo


def test_a_waymo_frame_without_boxes_has_no_label(places, tmp_path: Path) -> None:
    """Whether nobody looked or nothing was there is not told."""
    from pyarrow import parquet

    copy = shutil.copytree(places("waymo"), tmp_path / "street")
    path = copy / "lidar_box" / "street.parquet"
    table = parquet.read_table(path)
    stamps = table[STAMP].to_numpy()
    parquet.write_table(table.filter(stamps < stamps.max()), path)
    labels = label_sweeps(open_sequence(str(copy)), range(3), GIVEN)
    assert [frame for frame, _ in labels] == [0]


# Damage


def of_first_record(change):
    """Change the first of nuScenes' annotations; "other" stands for the second one's object."""

    def harm(path):
        first, *records = json.loads(path.read_text())
        other = {"instance_token": records[0]["instance_token"]}
        path.write_text(json.dumps([first | (change or other), *records]))

    return harm


def of_first_line(change):
    """Change the words of the first of KITTI's labels."""
    return lambda path: path.write_text(change(path.read_text().split("\n", 1)[0]))


ANNOTATIONS, LABELS = "v1.0-mini/sample_annotation.json", "label_02/0000.txt"
DAMAGE = [  # format, file, what happens to it, what is said
    ("nuscenes", ANNOTATIONS, of_first_record({"size": [0, 4, 1.5]}), "a box has no size"),
    ("nuscenes", ANNOTATIONS, of_first_record({"rotation": [1, 1, 0, 0]}), "a unit quaternion"),
    ("nuscenes", ANNOTATIONS, of_first_record(None), "a second box of the instance"),
    ("nuscenes", ANNOTATIONS, cut(-99), "not a whole JSON table"),
    ("nuscenes", ANNOTATIONS, remove, "v1.0-*/sample_annotation.json (nuscenes)"),
    ("kitti-tracking", LABELS, of_first_line(lambda t: " ".join(t.split()[:16])), "got 15 values"),
    ("kitti-tracking", LABELS, swap(r"(\S+ ){10}\S+", "0 1 Car" + 8 * " 0"), "a box has no size"),
    ("kitti-tracking", LABELS, of_first_line(lambda text: f"{text}\n{text}"), "is there twice"),
    ("kitti-tracking", LABELS, remove, "label_02/0000.txt (kitti-tracking)"),
]


@pytest.mark.parametrize(("format", "file", "harm", "says"), DAMAGE, ids=range(len(DAMAGE)))
def test_damaged_boxes_are_refused_in_a_line(
    format, file, harm, says, places, tmp_path: Path, capsys
) -> None:
    copy = shutil.copytree(places(format), tmp_path / "training")
    harm(copy / file)
    said = refused(capsys, 2, "labels", "--data", copy, "--out", tmp_path / "out")
    assert says in said and Path(file).name in said
    assert not (tmp_path / "out").exists()


# PandaSet


def test_what_moves_before_two_scanners_has_two_boxes(places) -> None:
    sequence = open_sequence(str(places("pandaset")))
    boxes, sweep = sequence.boxes(0), sequence[0]
    assert set(boxes.lidar.tolist()) == {-1, 0, 1}
    assert len(set(boxes.track.tolist())) == len(boxes.track)
    places_m = {lidar: boxes.T_lidar_box[boxes.lidar == lidar, :3, 3] for lidar in (0, 1)}
    apart_m = np.linalg.norm(places_m[0] - places_m[1], axis=1)
    assert len(apart_m) > 0 and 0.05 < apart_m.max() < 2  # two moments of the same objects
    assert sweep.lidar.max() == 1


def test_pandaset_boxes_stand_as_the_devkit_has_them(places, tmp_path: Path) -> None:
    """Yaw 0 looks along the world's y, a quarter turn on against its x."""
    copy = shutil.copytree(places("pandaset"), tmp_path / "002")
    cuboids = copy / "annotations/cuboids/00.pkl.gz"
    values = dict(zip("xyz", (10.0, 20.0, 1.0), strict=True))
    sizes_m = dict(zip("xyz", (2.0, 4.0, 1.5), strict=True))
    put_frame(
        cuboids,
        {
            "uuid": np.array(["a", "b"], object),
            "yaw": np.array([0.0, np.pi / 2]),
            **{f"position.{axis}": np.full(2, value) for axis, value in values.items()},
            **{f"dimensions.{axis}": np.full(2, value) for axis, value in sizes_m.items()},
            "stationary": np.zeros(2, bool),
            "cuboids.sensor_id": np.full(2, -1),
        },
    )
    sequence = open_sequence(str(copy))
    boxes = sequence.boxes(0)
    T_world_box = sequence.T_world_lidar(0) @ boxes.T_lidar_box
    assert boxes.track.tolist() == ["a", "b"] and boxes.lidar.tolist() == [-1, -1]
    np.testing.assert_allclose(T_world_box[:, :3, 3], 2 * [[10, 20, 1]])
    np.testing.assert_allclose(T_world_box[:, :3, 0], [[0, 1, 0], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(boxes.size_m, 2 * [[4.0, 2.0, 1.5]])
    cuboids.unlink()
    assert sequence.boxes(0) is None and sequence.boxes(1) is not None
    with pytest.raises(InputError, match="no sweep of frame 9"):
        sequence.boxes(9)


# nuScenes


def key_box(token: str, x: float, yaw: float = 0.0) -> dict:
    """4 m long, 2 m wide, 1.5 m high."""
    return {
        "instance_token": token,
        "translation": [x, 5.0, 1.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)],
    }


def annotated(folder: Path, *keys: list[dict]) -> Annotations | None:
    """Tables of a scene with a key frame every half a second and their boxes."""
    scene = {"scene_token": "here"}
    samples = [{"token": f"s{k}", "timestamp": k * 500_000, **scene} for k in range(len(keys))]
    boxes = [(f"s{k}", box) for k, key in enumerate(keys) for box in key]
    annotations = [
        {"token": f"a{i}", "sample_token": sample, "attribute_tokens": [], **box}
        for i, (sample, box) in enumerate(boxes)
    ]
    (folder / "sample.json").write_text(json.dumps(samples))
    (folder / "sample_annotation.json").write_text(json.dumps(annotations))
    return Annotations.read(folder, "here")


def test_boxes_between_key_frames_go_straight_and_turn_evenly(tmp_path: Path) -> None:
    """``a`` is in all of them, ``b`` comes, ``c`` goes, ``d`` is in one."""
    found = annotated(
        tmp_path,
        [key_box("a", 0), key_box("c", 3)],
        [key_box("a", 2), key_box("b", 10), key_box("c", 4), key_box("d", 50)],
        [key_box("a", 6, np.pi / 2), key_box("b", 15)],
    )
    first, second, key = (found.at(ns, np.eye(4)) for ns in (125_000_000, 750_000_000, 500_000_000))
    assert first.track.tolist() == ["a", "c", "", ""]
    np.testing.assert_allclose(first.T_lidar_box[:, 0, 3], [0.5, 3.25, 6.25, 50])
    assert second.track.tolist() == ["a", "b", "", ""]
    np.testing.assert_allclose(second.T_lidar_box[:, 0, 3], [4, 12.5, 4.5, 50])
    np.testing.assert_allclose(second.T_lidar_box[0, :2, 0], 2 * [np.sqrt(0.5)])
    assert key.track.tolist() == ["a", "b", "c", "d"]
    np.testing.assert_allclose(key.T_lidar_box[:, 0, 3], [2, 10, 4, 50])
    for boxes_then in (first, second, key):
        np.testing.assert_array_equal(boxes_then.size_m, 4 * [[4.0, 2.0, 1.5]])
    assert found.at(-1, np.eye(4)) is None and found.at(1_000_000_001, np.eye(4)) is None
    assert annotated(tmp_path, [], []) is None


# KITTI tracking


def test_kitti_boxes_stand_as_the_devkit_has_them(places, tmp_path: Path) -> None:
    """8 m ahead of the camera and 1.6 m below it, a car that faces it, and one that drives to the
    right; the middle of a box's bottom is given."""
    copy = shutil.copytree(places("kitti-tracking"), tmp_path / "training")
    lines = [
        "1 7 Car 0 0 0 0 0 9 9 1.5 1.6 4.0 0 1.6 8 1.5707963267948966",
        "1 8 Van 0 0 0 0 0 9 9 1.5 1.6 4.0 2 1.6 8 0 0.9",
        "1 -1 DontCare -1 -1 -10 100 120 300 220 -1000 -1000 -1000 -10 -1 -1 -1",
    ]
    (copy / LABELS).write_text("\n".join(lines))
    sequence = open_sequence(str(copy))
    boxes = sequence.boxes(1)
    assert boxes.track.tolist() == ["7", "8"] and not len(sequence.boxes(0).track)
    np.testing.assert_array_equal(boxes.size_m, 2 * [[4.0, 1.6, 1.5]])
    calibration = Calibration.read(copy / "calib" / "0000.txt")
    T_cam_box = calibration.motion("Tr_velo_cam") @ boxes.T_lidar_box
    np.testing.assert_allclose(T_cam_box[:, :3, 3], [[0, 0.85, 8], [2, 0.85, 8]], atol=1e-9)
    np.testing.assert_allclose(T_cam_box[:, :3, 0], [[0, 0, -1], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(T_cam_box[:, :3, 2], 2 * [[0, -1, 0]], atol=1e-9)
    np.testing.assert_array_equal(boxes.view.left_out_px, [[100, 120, 300, 220]])
    assert (boxes.view.camera.width_px, boxes.view.camera.height_px) == (1224, 370)
