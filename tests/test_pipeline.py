# SPDX-License-Identifier: MIT
"""The whole pipeline on a tiny street: windows, methods, what comes out, and one real drive."""

from __future__ import annotations

import json
import logging
from dataclasses import fields, replace

import numpy as np
import pytest

import densify
from densify import poses
from densify.config import RegisterSettings
from densify.errors import ComputationError, InputError
from densify.pipeline import METHODS, compare, run
from densify.range_image import RangeImage
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from densify.scores import ghosts
from densify.types import Cloud, Result
from tests.scenes import (
    CAMERA,
    SWEEP_S,
    Arc,
    Box,
    Scanner,
    Scene,
    TinySequence,
    World,
    car,
    stamp_ns,
    street,
)

KEY, WINDOW = 8, 3
EGO = Arc(0, -1.5, 0, 8.0, 0.08)
MOVERS = (
    car(6, 1.8, 9, 1),
    car(45, 1.8, 8, 2, yaw=np.pi),
    car(16, 3.6, 1.5, 3, yaw=-np.pi / 2, size_m=(0.5, 0.5, 1.7)),
)
POSES_GIVEN = {"register": {"source": "dataset"}}


def tiny(movers=(), late_s=0.0, ego=EGO, **options) -> TinySequence:
    scene = Scene(World((*street(), *movers)), ego, Scanner(num_azimuths=1200, sigma_m=0.01))
    return TinySequence(scene, range(14), late_s, **options)


@pytest.fixture(scope="module")
def moving() -> dict[str, Result]:
    return compare(tiny(MOVERS), KEY, WINDOW)


@pytest.fixture(scope="module")
def static() -> dict[str, Result]:
    return compare(tiny(), KEY, WINDOW)


# --- the window -----------------------------------------------------------------------------------


class Frames:
    """A sequence that only knows its frames."""

    name = "rec"

    def __init__(self, frames):
        self.frames = frames


def test_window_and_lead_in():
    assert window_frames(Frames(range(20)), 10, 2, 3) == ([8, 9, 10, 11, 12], [5, 6, 7])
    assert window_frames(Frames(range(100, 120)), 110, 0, 0) == ([110], [])


def test_lead_in_is_what_lies_directly_before(caplog):
    with caplog.at_level(logging.WARNING, "densify"):
        assert window_frames(Frames(range(20)), 4, 3, 5) == ([1, 2, 3, 4, 5, 6, 7], [0])
        broken = [0, 1, 2, 5, 6, 7, 8, 9]
        assert window_frames(Frames(broken), 8, 1, 5) == ([7, 8, 9], [5, 6])
    assert not caplog.records


@pytest.mark.parametrize(
    ("key", "frames", "words"), [(1, [0, 1, 2, 3, 4], "0-4"), (19, [16, 17, 18, 19], "16-19")]
)
def test_a_cut_window_warns_with_its_frames(caplog, key, frames, words):
    with caplog.at_level(logging.WARNING, "densify"):
        assert window_frames(Frames(range(20)), key, 3, 0)[0] == frames
    (record,) = caplog.records
    assert f"key {key}" in record.getMessage() and words in record.getMessage()


@pytest.mark.parametrize("key", [-1, 20, 999])
def test_a_key_out_of_range_is_named_with_what_there_is(key):
    with pytest.raises(InputError, match=rf"--key {key}: no such frame in rec; it has 0-19"):
        window_frames(Frames(range(20)), key, 2, 0)


def test_a_frame_missing_in_the_window_is_named():
    there = [f for f in range(20) if f not in (8, 9)]
    with pytest.raises(InputError, match=r"no sweep for frame 8-9; it has 0-7, 10-19"):
        window_frames(Frames(there), 10, 3, 0)
    with pytest.raises(InputError, match=r"--key 9: no such frame"):
        window_frames(Frames(there), 9, 3, 0)
    assert window_frames(Frames(there), 13, 3, 5)[0] == list(range(10, 17))


def test_a_negative_window_is_refused():
    with pytest.raises(InputError, match="--window -1"):
        window_frames(Frames(range(20)), 10, -1, 0)


def test_cameras_by_name():
    sequence = tiny(cameras=(CAMERA, replace(CAMERA, name="rear")))
    assert [c.name for c in choose_cameras(sequence, None)] == ["front", "rear"]
    assert [c.name for c in choose_cameras(sequence, ["rear"])] == ["rear"]
    assert choose_cameras(sequence, []) == []
    with pytest.raises(InputError, match=r"--camera left: no such camera in tiny; .* front, rear"):
        choose_cameras(sequence, ["front", "left"])


def test_near_and_far_returns_are_left_out():
    sequence = tiny()
    (sweep,) = read_sweeps(sequence, [3], RegisterSettings(min_range_m=5.0, max_range_m=30.0))
    range_m = np.linalg.norm(sweep.points, axis=1)
    whole = sequence[3]
    assert 5 <= range_m.min() < range_m.max() <= 30 and len(sweep) < len(whole)
    assert np.array_equal(whole.points[sweep.row], sweep.points)


def test_recorded_poses_are_handed_on():
    sequence = tiny()
    sweeps = [sequence[f] for f in (2, 3, 4)]
    trajectory = recorded_trajectory(sequence, sweeps)
    assert trajectory.frames == (2, 3, 4)
    assert trajectory.stamp_ns.tolist() == [stamp_ns(f) for f in (2, 3, 4)]
    assert np.array_equal(trajectory.T_world_lidar[1], sequence.T_world_lidar(3))


# --- what comes out -------------------------------------------------------------------------------


def test_the_three_methods_are_each_others_baselines(moving):
    assert tuple(moving) == METHODS == ("none", "icp", "flow")
    for i, (name, result) in enumerate(moving.items()):
        assert result.method == name and result.key == KEY
        assert tuple(result.baselines) == METHODS[:i]
    assert moving["flow"].frames == moving["icp"].frames == tuple(range(5, 12))
    assert moving["none"].frames == (KEY,)


def test_shapes_and_types_as_documented(moving):
    kinds = {
        "points": (np.float64, (3,)),
        "rigid_points": (np.float64, (3,)),
        "frame": (np.int32, ()),
        "row": (np.int64, ()),
        "moving": (np.bool_, ()),
        "instance": (np.int32, ()),
        "confidence": (np.float32, ()),
        "intensity": (np.float32, ()),
        "displaced": (np.float32, ()),
        "rgb": (np.uint8, (3,)),
    }
    shape = (CAMERA.height_px, CAMERA.width_px)
    for result in moving.values():
        for name, (kind, tail) in kinds.items():
            column = getattr(result.cloud, name)
            assert column.dtype == kind and column.shape == (len(result.cloud), *tail), name
        assert np.isfinite(result.cloud.points).all()
        assert set(np.unique(result.cloud.frame)) == set(result.frames)
        (depth,) = result.depth.values()
        assert depth.camera == "front"
        for name in ("depth_m", "filled_m", "confidence"):
            image = getattr(depth, name)
            assert image.shape == shape and image.dtype == np.float32 and np.isfinite(image).all()
        assert depth.frame.shape == shape and depth.frame.dtype == np.int32
        assert np.array_equal(depth.frame >= 0, depth.depth_m > 0)
        assert np.isin(depth.frame[depth.frame >= 0], result.frames).all()
        assert ((depth.confidence > 0) == (depth.filled_m > 0)).all()
        assert (depth.filled_m[depth.depth_m > 0] > 0).all()


def test_metrics_are_plain_numbers(moving):
    for result in moving.values():
        metrics = json.loads(json.dumps(result.metrics, allow_nan=False))
        assert metrics["num_points"] == len(result.cloud)
        assert metrics["num_moving"] == result.cloud.moving.sum()
        assert set(metrics["depth"]) == set(metrics["density"]) == {"front"}
    assert moving["none"].metrics["num_moving"] == moving["icp"].metrics["num_moving"] == 0


def test_more_sweeps_give_more_depth(moving):
    density = {m: r.metrics["density"]["front"]["measured"] for m, r in moving.items()}
    # a coarse image, and what is not certain at edges is left out
    assert density["icp"] > 1.02 * density["none"]
    assert density["flow"] > 1.02 * density["none"]


_LAST_STAGES = ("accumulate", "patches", "project", "colour", "score")


def test_costs_of_every_stage(moving):
    costs = {c.name: c for c in moving["flow"].costs}
    stages = ["read", "images", "register", "deskew", "ground", "flow"]
    assert list(costs) == [*stages, *_LAST_STAGES]
    for cost in costs.values():
        assert cost.seconds >= 0 and cost.peak_memory_mb > 10
    peaks = [costs[s].peak_memory_mb for s in stages]
    assert peaks == sorted(peaks)  # of the process, so far


def test_methods_share_one_registration(moving):
    icp, flow = moving["icp"].cloud, moving["flow"].cloud
    assert set(zip(flow.frame.tolist(), flow.row.tolist(), strict=True)) <= set(
        zip(icp.frame.tolist(), icp.row.tolist(), strict=True)
    )
    own = icp.frame == KEY
    assert icp.points[own].tobytes() == moving["none"].cloud.points.tobytes()


def test_progress_names_every_stage():
    seen: list[tuple[str, int, int]] = []
    run(tiny(), KEY, 1, "icp", config=POSES_GIVEN, progress=lambda *step: seen.append(step))
    names = list(dict.fromkeys(name for name, _, _ in seen))
    assert names == ["read", "images", "register", "deskew", *_LAST_STAGES]
    assert all(0 <= done <= total for _, done, total in seen)
    for name in names:
        steps = [(done, total) for n, done, total in seen if n == name]
        assert steps[0][0] == 0 and steps[-1][0] == steps[-1][1]


def test_only_the_frames_needed_are_read():
    sequence = tiny()
    run(sequence, KEY, 1, "icp", config={"register": {"source": "dataset", "num_lead_in": 2}})
    assert set(sequence.read) == {5, 6, 7, 8, 9}
    assert len(sequence.read) == 5


# --- truth ----------------------------------------------------------------------------------------


def same_points(a: Cloud, b: Cloud) -> bool:
    return all(getattr(a, f.name).tobytes() == getattr(b, f.name).tobytes() for f in fields(Cloud))


def test_nothing_moves_flow_is_icp_to_the_last_bit(static):
    icp, flow = static["icp"], static["flow"]
    assert same_points(icp.cloud, flow.cloud)
    for name in ("depth_m", "filled_m", "confidence", "frame"):
        a, b = (getattr(r.depth["front"], name) for r in (icp, flow))
        assert a.tobytes() == b.tobytes(), name
    assert flow.metrics == icp.metrics


def test_what_stands_still_among_movers_is_icp_to_the_last_bit(moving):
    icp, flow = moving["icp"].cloud, moving["flow"].cloud
    assert flow.rigid_points[~flow.moving].tobytes() == flow.points[~flow.moving].tobytes()
    place = {key: i for i, key in enumerate(zip(icp.frame.tolist(), icp.row.tolist(), strict=True))}
    rows = [place[key] for key in zip(flow.frame.tolist(), flow.row.tolist(), strict=True)]
    assert flow.rigid_points.tobytes() == icp.points[rows].tobytes()


def test_ghosts_are_halved(moving):
    icp, flow = (moving[m].metrics["ghosts"]["all"] for m in ("icp", "flow"))
    assert icp > 0.001
    assert flow < 0.5 * icp


def test_movers_are_moved_to_the_key(moving):
    """Their points from all sweeps lie on the car as it stood at the key's moment."""
    cloud, scene = moving["flow"].cloud, tiny(MOVERS).scene
    T = scene.T_world_lidar(KEY * SWEEP_S)
    for box in MOVERS[:2]:
        x, y, yaw = box.path.at(KEY * SWEEP_S)
        p = poses.transform(T, cloud.points[cloud.moving]) - [x, y, 0]
        along = np.abs(np.cos(yaw) * p[:, 0] + np.sin(yaw) * p[:, 1])
        aside = np.abs(np.cos(yaw) * p[:, 1] - np.sin(yaw) * p[:, 0])
        inside = (along < box.size_m[0] / 2 + 0.3) & (aside < box.size_m[1] / 2 + 0.3)
        assert inside.sum() > 300
        assert cloud.displaced[cloud.moving][inside].max() > 1.5
    strays = cloud.moving & (cloud.displaced == 0) & (cloud.frame != KEY)
    assert strays.sum() < 0.02 * cloud.moving.sum()


def test_depth_of_movers_is_right(moving):
    """KITTI's outliers on what moves, against the analytic image."""
    outliers = {
        m: r.metrics["depth"]["front"]["measured"]["moving"]["outliers"] for m, r in moving.items()
    }
    assert outliers["flow"] <= 0.5 * outliers["icp"]
    assert outliers["flow"] < 0.1


def test_depth_of_the_static_street_is_the_analytic_one(static):
    for method in METHODS:
        errors = static[method].metrics["depth"]["front"]["measured"]["all"]
        assert errors["outliers"] < 0.03
        assert errors["num_compared"] > 500


@pytest.mark.parametrize("late_s", [-0.04, 0.0, 0.05])
def test_an_image_of_another_moment_sees_from_where_the_camera_was(late_s):
    """At 20 m/s a shutter 50 ms late is 1 m nearer to the wall ahead."""
    boxes = (Box((1.0, 60.0, 30.0), Arc(45, 0)), *street())
    scene = Scene(World(boxes), Arc(-10, -1.5, 0, 20.0), Scanner(num_azimuths=1800))
    sequence = TinySequence(scene, range(9), late_s)
    result = run(sequence, 4, 1, "icp", config=POSES_GIVEN)
    truth = sequence.truth.depth_m("front", 4)
    found = result.depth["front"].depth_m
    wall_m = 44.5 - float(scene.ego.at(4 * SWEEP_S + late_s)[0]) - 0.2  # the lens is 0.2 m ahead
    on_wall = (np.abs(truth - wall_m) < 0.02) & (found > 0)
    assert on_wall.sum() > 300
    assert abs(np.median(found[on_wall]) - wall_m) < 0.05
    maps = result.depth["front"]
    since_s = (maps.frame[found > 0] - 4) * SWEEP_S
    np.testing.assert_allclose(maps.age_s[found > 0], np.abs(since_s - late_s), atol=1e-6)
    assert len(np.unique(since_s)) == 3
    np.testing.assert_array_equal(np.isnan(maps.age_s), maps.filled_m == 0)


def test_the_camera_moves_on_though_the_sweeps_are_not_deskewed():
    sequence = TinySequence(tiny().scene, range(14), late_s=0.05)
    given = {"register": {"source": "dataset", "deskew": False}}
    late = run(sequence, KEY, 1, "icp", config=given).depth["front"].depth_m
    at_once = TinySequence(tiny().scene, range(14), late_s=0.0)
    early = run(at_once, KEY, 1, "icp", config=given).depth["front"].depth_m
    assert not np.array_equal(late, early)


def test_a_mover_is_shown_where_it_was_at_the_exposure():
    """Oncoming at 20 m/s it is 1 m nearer after 50 ms."""
    scene = Scene(
        World((*street(), car(40, 0.5, 20, 1, yaw=np.pi))),
        Arc(0, -1.5),
        Scanner(num_azimuths=1800, sigma_m=0.01),
    )
    sequence = TinySequence(scene, range(13), late_s=0.05)
    found = run(sequence, 6, 4, config=POSES_GIVEN).depth["front"].depth_m
    truth = sequence.truth.depth_m("front", 6)
    on = sequence.truth.moving_mask("front", 6) & (found > 0)
    assert on.sum() > 50
    assert abs(np.median(found[on] - truth[on])) < 0.3


def test_points_have_the_colour_of_their_pixel_or_none(moving):
    for result in moving.values():
        rgb = result.cloud.rgb
        assert np.isin(rgb, [0, 128]).all() and (np.ptp(rgb, axis=1) == 0).all()
        in_front = result.cloud.points[:, 0] > 0
        assert not rgb[~in_front].any() and rgb[in_front].any()


def test_the_cameras_pose_turns_with_the_vehicle():
    """Turning by 30 deg/s, an image 50 ms late looks 1.5 deg further."""
    scene = Scene(World(street()), Arc(0, -1.5, 0, 4.0, 0.5), Scanner(num_azimuths=1800))
    sequence = TinySequence(scene, range(9), late_s=0.05)
    metrics = run(sequence, 4, 1, "icp", config=POSES_GIVEN).metrics
    assert metrics["depth"]["front"]["measured"]["all"]["outliers"] < 0.03
    wrong = (
        run(TinySequence(scene, range(9), late_s=0.0), 4, 1, "icp", config=POSES_GIVEN)
        .depth["front"]
        .depth_m
    )
    truth = sequence.truth.depth_m("front", 4)
    both = (wrong > 0) & (truth > 0)
    assert (np.abs(wrong - truth) > 1)[both].mean() > 0.05


# --- repeatable, configurable ---------------------------------------------------------------------


def test_same_bytes_every_time(moving):
    again = compare(tiny(MOVERS), KEY, WINDOW)
    for method in METHODS:
        assert same_points(moving[method].cloud, again[method].cloud)
        for name in ("depth_m", "filled_m", "confidence", "frame", "age_s"):
            a, b = (getattr(r[method].depth["front"], name) for r in (moving, again))
            assert a.tobytes() == b.tobytes(), name
        assert moving[method].metrics == again[method].metrics


def test_run_is_compare_up_to_its_method(moving):
    result = run(tiny(MOVERS), KEY, WINDOW, "icp")
    assert result.method == "icp" and tuple(result.baselines) == ("none",)
    assert same_points(result.cloud, moving["icp"].cloud)
    assert [c.name for c in result.costs][:4] == ["read", "images", "register", "deskew"]
    assert "flow" not in [c.name for c in result.costs]


def test_the_data_sets_poses_are_taken_as_they_are():
    sequence = tiny()
    result = run(sequence, KEY, 1, "icp", config=POSES_GIVEN)
    T = poses.inverse(sequence.T_world_lidar(KEY)) @ sequence.T_world_lidar(KEY + 1)
    mine = result.cloud.frame == KEY + 1
    true = poses.transform(
        poses.inverse(sequence.T_world_lidar(KEY)), sequence.scene.scan(KEY + 1).world
    )
    near = np.linalg.norm(sequence[KEY + 1].points, axis=1) >= 2.8
    np.testing.assert_allclose(
        result.cloud.points[mine], true[near][result.cloud.row[mine]], atol=0.02
    )
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.8, abs=0.01)


def test_poses_of_the_data_set_are_checked_too():
    class Jumping(TinySequence):
        def T_world_lidar(self, frame):
            T = super().T_world_lidar(frame)
            T[0, 3] += 30.0 * (frame > KEY)
            return T

    good = tiny()
    with pytest.raises(ComputationError, match=f"frame {KEY} to {KEY + 1}"):
        run(Jumping(good.scene, good.frames), KEY, 2, "icp", config=POSES_GIVEN)


def test_without_a_camera_there_is_a_cloud_and_no_depth():
    result = run(tiny(), KEY, 1, "icp", cameras=[], config=POSES_GIVEN)
    assert len(result.cloud) and not result.depth and not result.metrics["density"]


def test_without_truth_there_are_no_errors_of_depth():
    result = run(tiny(with_truth=False), KEY, 1, "icp", config=POSES_GIVEN)
    assert "depth" not in result.metrics and result.metrics["ghosts"]["num_points"] > 0


def test_a_window_of_the_key_alone():
    results = compare(tiny(), KEY, 0, config=POSES_GIVEN)
    assert same_points(results["none"].cloud, results["icp"].cloud)
    assert same_points(results["none"].cloud, results["flow"].cloud)


def test_at_the_start_of_the_recording(caplog):
    with caplog.at_level(logging.WARNING, "densify"):
        result = run(tiny(MOVERS), 0, 2, "flow", config=POSES_GIVEN)
    assert result.frames == (0, 1, 2)
    assert "0-2" in caplog.text


def test_a_sweep_without_times_is_not_deskewed():
    class Timeless(TinySequence):
        def __getitem__(self, frame):
            return replace(super().__getitem__(frame), offset_ns=None)

    good = tiny(MOVERS)
    sequence = Timeless(good.scene, good.frames)
    result = run(sequence, KEY, 1, "flow", config=POSES_GIVEN)
    own = result.cloud.frame == KEY
    (kept,) = read_sweeps(sequence, [KEY], RegisterSettings())
    np.testing.assert_allclose(result.cloud.points[own], kept.points, atol=1e-9)


def test_deskewing_can_be_switched_off():
    """For recordings that were compensated before."""
    sequence = tiny()
    config = {"register": {"source": "dataset", "deskew": False}}
    result = run(sequence, KEY, 1, "icp", config=config)
    (kept,) = read_sweeps(sequence, [KEY], RegisterSettings())
    own = result.cloud.frame == KEY
    np.testing.assert_allclose(result.cloud.points[own], kept.points, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"key": 99}, "--key 99"),
        ({"method": "magic"}, "--method magic: expected one of none, icp, flow"),
        ({"window": -2}, "--window -2"),
        ({"cameras": ["back"]}, "--camera back.*front"),
        ({"config": {"flow": {"alhpa": 1}}}, "alpha"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_read(arguments, message):
    sequence = tiny()
    with pytest.raises(InputError, match=message) as caught:
        run(sequence, **{"key": KEY, "window": 1, **arguments})
    assert "\n" not in str(caught.value)
    assert not sequence.read


class Sparse(TinySequence):
    """One sweep has next to no returns."""

    sparse, num_points = KEY, 0

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        few = np.arange(len(sweep)) < self.num_points
        return sweep.select(few) if frame == self.sparse else sweep


@pytest.mark.parametrize("num_points", [0, 50])
@pytest.mark.parametrize("sparse", [KEY, KEY + 1])
def test_an_almost_empty_sweep_cannot_be_registered(num_points, sparse):
    sequence = Sparse(tiny().scene, range(14))
    sequence.sparse, sequence.num_points = sparse, num_points
    with pytest.raises(ComputationError, match=rf"sweep {sparse} has {num_points} points"):
        run(sequence, KEY, 1)


@pytest.mark.parametrize("num_points", [0, 50])
@pytest.mark.parametrize("sparse", [KEY, KEY + 1])
def test_an_almost_empty_sweep_of_known_pose_does_no_harm(num_points, sparse):
    sequence = Sparse(tiny(MOVERS).scene, range(14))
    sequence.sparse, sequence.num_points = sparse, num_points
    cloud = run(sequence, KEY, 1, config=POSES_GIVEN).cloud
    assert (cloud.frame == sparse).sum() <= num_points
    assert np.isfinite(cloud.points).all() and not cloud.moving[cloud.frame == sparse].any()


def test_the_published_engine_runs_too():
    scene = Scene(World(street()), Arc(0, -1.5, 0, 5.0), Scanner(32, 300, (-15.0, 5.0)))
    sequence = TinySequence(scene, range(9))
    config = {
        "register": {"source": "dataset"},
        "flow": {"engine": "paper", "num_neighbors": 10, "min_height_m": 0.5},
    }
    result = run(sequence, 4, 2, "flow", config=config)
    assert result.cloud.moving.any() and not result.cloud.moving.all()
    assert (result.cloud.instance == -1).all()
    still = ~result.cloud.moving
    assert result.cloud.points[still].tobytes() == result.cloud.rigid_points[still].tobytes()


# --- a real drive ---------------------------------------------------------------------------------


def test_a_real_drive(test_data):
    drive = test_data / "kitti" / "2011_09_26" / "2011_09_26_drive_0013_sync"
    if not drive.is_dir():
        pytest.skip(f"no drive 0013 in {test_data}")
    results = compare(densify.open_sequence(drive), 120, 5, ["image_02"])
    icp, flow = results["icp"], results["flow"]
    assert flow.frames == tuple(range(115, 126))
    assert flow.metrics["ghosts"]["all"] <= 0.5 * icp.metrics["ghosts"]["all"]
    cloud = flow.cloud
    assert cloud.moving.sum() > 1000
    still = ~cloud.moving
    assert cloud.points[still].tobytes() == cloud.rigid_points[still].tobytes()
    place = np.full((11, cloud.row.max() + 1), -1)
    place[icp.cloud.frame - 115, icp.cloud.row] = np.arange(len(icp.cloud))
    rigid = icp.cloud.points[place[cloud.frame - 115, cloud.row]]
    assert cloud.rigid_points.tobytes() == rigid.tobytes()
    density = {m: r.metrics["density"]["image_02"]["measured"] for m, r in results.items()}
    assert density["flow"] > 2 * density["none"]


def test_the_ghost_score_agrees_with_the_truth(moving):
    """What it calls a ghost among rigid points is truly on something that moves."""
    sequence = tiny(MOVERS)
    icp = moving["icp"].cloud
    found = ghosts(icp, RangeImage.of(sequence.scene.stretch(KEY, 1)[KEY]), KEY)
    assert found.sum() > 50
    true = np.zeros(len(icp), bool)
    for frame in np.unique(icp.frame):
        mine = np.flatnonzero(icp.frame == frame)
        (kept,) = read_sweeps(sequence, [int(frame)], RegisterSettings())
        true[mine] = sequence.scene.scan(int(frame)).instance[kept.row[icp.row[mine]]] >= 0
    assert true[found].mean() > 0.9
