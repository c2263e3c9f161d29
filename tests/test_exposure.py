# SPDX-License-Identifier: MIT
"""A depth map shows the moment it is asked for, and optical flow leads to the next exposure.

Against the analytic street, and as KITTI's PNG.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from densify.depth.exposure import Exposure
from densify.depth.views import optical_flow
from densify.geometry import poses
from densify.geometry.types import Camera, DepthMap, Reason
from densify.outputs.depth_png import write_flow_png
from densify.pipeline.run import run
from tests.depth_scenes import at_pixel, make_cloud
from tests.scenes import (
    CAMERA,
    SWEEP_S,
    Arc,
    Box,
    Scanner,
    Scene,
    TinySequence,
    World,
    by_flow,
    street,
)
from tests.small_street import CAR, KEY, POSES_GIVEN, one_car

SMALL = Camera("cam", 8, 6, np.array([[10.0, 0, 3.5], [0, 11.0, 2.5], [0, 0, 1]]), np.eye(4))


def test_flow_is_unknown_without_a_measured_point_and_behind_the_other_camera():
    cloud = make_cloud(at_pixel(SMALL, [2, 5], [2, 3], 4.0))
    depth_m = np.zeros((6, 8), np.float32)
    depth_m[2, 2] = 4.0
    reason = np.array([Reason.KEPT, Reason.HIDDEN], np.uint8)
    number = np.zeros(depth_m.shape, np.int32)
    depth = DepthMap("cam", depth_m, depth_m, depth_m, number, reason=reason)
    nothing = replace(depth, reason=reason[:0])
    here, aside, ahead = (
        Exposure(SMALL, poses.exp(np.array([0, 0, 0, x, 0, z])))
        for x, z in ((0, 0), (1, 0), (0, -9))
    )
    known = np.zeros(depth_m.shape, bool)
    known[2, 2] = True
    flow = optical_flow(cloud, depth, here, aside)
    np.testing.assert_allclose(flow[known], [[10.0 / 4, 0]], atol=1e-6)
    assert np.isnan(flow[~known]).all()
    assert np.isnan(optical_flow(cloud, depth, here, ahead)).all()
    assert np.isnan(optical_flow(cloud.select(np.zeros(2, bool)), nothing, here, aside)).all()


def true_flow(sequence, other: int) -> tuple[np.ndarray, np.ndarray]:
    """(H,W,2) of what each pixel's centre shows, and where that moves."""
    depth = sequence.truth.depth_m("front", KEY).astype(float)
    moving = sequence.truth.moving_mask("front", KEY)
    v, u = np.indices(depth.shape)
    ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA.K).T
    T_cam_world = [
        CAMERA.T_cam_lidar
        @ poses.inverse(sequence.scene.T_world_lidar(f * SWEEP_S + sequence.late_s))
        for f in (KEY, other)
    ]
    world = poses.transform(poses.inverse(T_cam_world[0]), (ray * depth[..., None]).reshape(-1, 3))
    world[moving.ravel(), 0] += CAR.path.speed_m_s * (other - KEY) * SWEEP_S
    there = poses.transform(T_cam_world[1], world) @ CAMERA.K.T
    there = (there[:, :2] / there[:, 2:]).reshape(*depth.shape, 2)
    return there - np.stack([u, v], -1), moving


def test_flow_to_both_neighbours_is_that_of_the_street():
    late_s = 0.04
    sequence = one_car(late_s=late_s)
    result = by_flow(sequence, KEY, 1, config=POSES_GIVEN | {"output": {"optical_flow": True}})
    assert set(result.optical_flow["front"]) == {"previous", "next"}
    for name, other in (("previous", KEY - 1), ("next", KEY + 1)):
        found = result.optical_flow["front"][name]
        known = np.isfinite(found).all(axis=2)
        measured = result.depth["front"].depth_m > 0
        assert not (known & ~measured).any() and known.sum() == measured.sum()
        true, moving = true_flow(sequence, other)
        off_px = np.linalg.norm(found - true, axis=2)
        for part in (moving, ~moving):
            assert (known & part).sum() > 200
            assert np.median(off_px[known & part]) < 0.1
            assert (off_px[known & part] < 1).mean() > 0.95
        # neither is trivial: the street flows by, and the car goes its own way
        assert np.median(np.linalg.norm(true, axis=2)[known & ~moving]) > 0.5
        alone = true_flow(one_car((), late_s), other)[0]
        still = np.linalg.norm(true - alone, axis=2)[known & moving]
        assert np.median(still) > 0.5


def test_at_the_end_of_the_window_one_neighbour_is_missing():
    sequence = one_car()
    config = POSES_GIVEN | {"output": {"optical_flow": True}}
    assert set(run(sequence, 0, 1, "icp", config=config).optical_flow["front"]) == {"next"}
    assert run(sequence, KEY, 0, "icp", config=config).optical_flow == {"front": {}}
    assert run(sequence, KEY, 0, "icp", config=POSES_GIVEN).optical_flow == {}


def test_flow_png_is_kittis(tmp_path):
    rng = np.random.default_rng(0)
    flow = rng.uniform(-500, 500, (20, 30, 2)).astype(np.float32)
    flow[3, :5] = np.nan
    flow[4, 0, 1] = np.nan
    write_flow_png(tmp_path / "f.png", flow)
    # KITTI: flow_u = (I(:,:,1) - 2^15) / 64, flow_v of the second channel, valid the third
    raw = cv2.imread(str(tmp_path / "f.png"), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16 and raw.shape == (20, 30, 3)
    read, valid = (raw[..., :0:-1].astype(float) - 2**15) / 64, raw[..., 0]
    known = np.isfinite(flow).all(axis=2)
    assert known.sum() == 594 and np.array_equal(valid, known)
    assert np.abs(read - flow)[known].max() <= 1 / 128
    assert not raw[~known].any()


@pytest.mark.parametrize("late_s", [-0.04, 0.05])
def test_an_image_of_another_moment_sees_from_where_the_camera_was(late_s):
    """At 20 m/s a shutter 50 ms late is 1 m nearer to the wall ahead."""
    boxes = (Box((1.0, 60.0, 30.0), Arc(45, 0)), *street())
    scene = Scene(World(boxes), Arc(-10, -1.5, 0, 20.0), Scanner(num_azimuths=900))
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


def test_at_the_sweeps_time_the_shutter_does_not_matter():
    def depth(late_s: float, at: str) -> np.ndarray:
        config = POSES_GIVEN | {"project": {"at": at}}
        return by_flow(one_car(late_s=late_s), KEY, 1, config=config).depth["front"].depth_m

    at_sweep, at_camera = depth(0.05, "sweep"), depth(0.05, "camera")
    assert at_sweep.tobytes() == depth(0.0, "camera").tobytes()
    moving = one_car().truth.moving_mask("front", KEY)
    moving &= one_car(late_s=0.05).truth.moving_mask("front", KEY)
    both = moving & (at_sweep > 0) & (at_camera > 0)
    assert both.sum() > 200
    farther_m = np.median((at_camera - at_sweep)[both])
    assert abs(farther_m - (8 - 4) * 0.05) < 0.05  # the car pulls away
