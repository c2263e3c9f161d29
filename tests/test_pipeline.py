# SPDX-License-Identifier: MIT
"""The pipeline on a tiny street: methods side by side, what comes out."""

from __future__ import annotations

import numpy as np
import pytest

from densify.geometry import poses
from densify.geometry.types import Reason, Result
from densify.pipeline.key_result import METHODS
from densify.pipeline.process import Watch
from densify.pipeline.run import compare
from tests.scenes import CAMERA, SWEEP_S, Arc, Scanner, Scene, TinySequence, World, street
from tests.tiny_street import KEY, MOVERS, POSES_GIVEN, WINDOW, same_points, tiny

USUAL = ("none", "icp", "flow")
NEAR = {"accumulate": {"far_m": 0.0}}  # test_far looks beyond the window


@pytest.fixture(scope="module")
def moving() -> dict[str, Result]:
    return compare(tiny(MOVERS), KEY, WINDOW, config=NEAR, methods=USUAL)


@pytest.fixture(scope="module")
def static() -> dict[str, Result]:
    return compare(tiny(), KEY, WINDOW, config=NEAR, methods=("none", "icp", "icp-visible", "flow"))


def test_methods_are_each_others_baselines(moving):
    assert tuple(moving) == USUAL and set(USUAL) < set(METHODS)
    for i, (name, result) in enumerate(moving.items()):
        assert result.method == name and result.key == KEY
        assert tuple(result.baselines) == USUAL[:i]
    assert moving["flow"].frames == moving["icp"].frames == tuple(range(5, 12))
    assert moving["none"].frames == (KEY,)


def test_shapes_and_types_as_documented(moving):
    kinds = {
        np.float64: ("points", "rigid_points"),
        np.float32: ("velocity_m_s", "confidence", "intensity", "displaced"),
        np.int32: ("frame", "instance"),
        np.int64: ("row", "since_key_ns"),
        np.uint8: ("rgb", "lidar"),
        np.bool_: ("moving", "far"),
    }
    shape = (CAMERA.height_px, CAMERA.width_px)
    for result in moving.values():
        for kind, names in kinds.items():
            columns = [getattr(result.cloud, name) for name in names]
            assert all(c.dtype == kind and len(c) == len(result.cloud) for c in columns), names
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


def test_a_point_is_as_certain_as_the_pixel_that_confirms_it(moving):
    (depth,) = moving["flow"].depth.values()
    certain = moving["flow"].cloud.confidence
    kept = certain[depth.reason == Reason.KEPT]
    assert (kept > 0).mean() > 0.95 and np.isin(kept[kept > 0], depth.confidence).all()
    assert not certain[depth.reason == Reason.OUTSIDE].any()


def test_maps_keep_the_share_of_outliers_that_is_asked_for(moving):
    shown = moving["flow"].depth["front"].filled_m > 0
    share = moving["flow"].metrics["expected_outliers"]["front"]["filled"] / 3
    config = NEAR | {"project": {"max_outliers": share}}
    result = compare(tiny(MOVERS), KEY, WINDOW, config=config, methods=("flow",))["flow"]
    depth, expected = result.depth["front"], result.metrics["expected_outliers"]["front"]
    dialled = depth.filled_m > 0
    assert expected["filled"] <= share and dialled.sum() < shown.sum()
    assert not (dialled & ~shown).any()
    assert np.array_equal(depth.frame >= 0, depth.depth_m > 0)
    assert np.array_equal(np.isfinite(depth.age_s), dialled)


def test_nothing_moves_flow_is_icp_to_the_last_bit(static):
    icp, flow = static["icp-visible"], static["flow"]
    assert np.array_equal(static["icp"].cloud.points, icp.cloud.points)
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


def test_the_published_engine_runs_too_and_long_stages_count_their_parts():
    scene = Scene(World(street()), Arc(0, -1.5, 0, 5.0), Scanner(32, 300, (-15.0, 5.0)))
    sequence = TinySequence(scene, range(9))
    config = {**POSES_GIVEN, "objective": {"num_neighbors": 10}}
    reports = list[tuple[str, int, int]]()
    results = compare(
        sequence,
        4,
        1,
        config=config,
        methods=("none", "paper", "flow"),
        progress=lambda *report: reports.append(report),
    )
    assert {("flow", 2, 3), ("deskew", 3, 3), ("project", 1, 1)} <= set(reports)
    assert max(done for stage, done, _ in reports if stage == "read") > 1
    assert tuple(results["flow"].baselines) == ("none", "paper")
    assert len(results["flow"].cloud) == len(results["paper"].cloud)
    assert not results["flow"].cloud.moving.any()  # in a street where nothing moves
    result = results["paper"]
    assert result.cloud.moving.any() and not result.cloud.moving.all()
    assert (result.cloud.instance == -1).all()
    still = ~result.cloud.moving
    assert result.cloud.points[still].tobytes() == result.cloud.rigid_points[still].tobytes()


def test_progress_returns_to_the_stage_that_still_runs() -> None:
    reports = list[tuple[str, int, int]]()
    watch = Watch(lambda *report: reports.append(report))
    with watch.stage("flow"), watch.stage("ground"):
        assert [*watch.each("ground", "ab")] == ["a", "b"]
        with watch.stage("read", is_part=True):
            pass
    begun = [("flow", 0, 1), ("ground", 0, 1), ("ground", 1, 2), ("ground", 2, 2)]
    assert reports == [*begun, ("ground", 1, 1), ("flow", 0, 1), ("flow", 1, 1)]
    assert {cost.name for cost in watch.costs()} == {"flow", "ground", "read"}
