# SPDX-License-Identifier: MIT
"""Moving boxes before a wall: what lidar does not see of a closed one, and through an open one."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from densify.depth import moving_bodies as stage
from densify.depth import rays as hulls
from densify.depth.exposure import Exposure
from densify.depth.rays import Rays, find_moving_bodies, without_sweep
from densify.geometry.types import Cloud, Stretch
from tests.depth_scenes import (
    KEY,
    T_CAM_LIDAR,
    depth_map,
    make_camera,
    make_cloud,
    patches_of,
    pixel_rays,
    registered,
    scanner_rays,
)

CAMERA = make_camera(width=420, height=160, focal=400.0)
EXPOSURE = Exposure(CAMERA, T_CAM_LIDAR)
WALL_M, STEP_M = 20.0, 0.7  # the box moves to the left by so much from sweep to sweep
LOW, HIGH = np.array([10.0, -2.0, -0.8]), np.array([11.8, 2.0, 0.8])  # of the box, in the key sweep
PANE = ((-1.2, 1.2), (0.2, 0.6))  # across and up, metres
DOOR = ((-1.9, -0.6), (-0.6, 0.1))
HOLE = ((-1.2, 1.2), (-0.9, 0.4))  # between two legs and a beam


def within(y, z, part):
    return (y > part[0][0]) & (y < part[0][1]) & (z > part[1][0]) & (z < part[1][1])


def enters(start, ray, low, high):
    """(K,) t at which rays enter a box and leave it."""
    with np.errstate(divide="ignore"):
        one, other = (low - start) / ray, (high - start) / ray
    return np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)


def scanned(dark, passes):
    """What eleven sweeps of a scanner that stands see of the box, which moves, and of the wall.

    dark, passes: (y, z of the front) -> bool, no return, and a return from the wall.
    """
    rng = np.random.default_rng(7)
    parts, sweeps = [], []
    for frame in range(KEY - 5, KEY + 6):
        moved = np.array([0, STEP_M * (frame - KEY), 0])
        ray = scanner_rays(np.arange(-29, 29, 0.2) + rng.uniform(0, 0.2), np.arange(-11, 11, 0.4))
        enter, leave = enters(np.zeros(3), ray, LOW + moved, HIGH + moved)
        meets = enter < leave
        at = ray * np.where(meets, enter, WALL_M)[:, None]
        y, z = (at - moved)[:, 1:].T
        through = meets & passes(y, z)
        at[through] = ray[through] * WALL_M
        known = ~(meets & dark(y, z))
        own = (meets & ~through)[known]
        at = at[known] + rng.normal(0, 0.01, (known.sum(), 3))
        sweeps.append(registered(frame, at, np.eye(4), np.zeros(6)))
        cloud = make_cloud(at, frame)
        cloud.moving[:], cloud.instance[:] = own, np.where(own, 0, -1)
        cloud.velocity_m_s[own] = [0, STEP_M / 0.1, 0]
        parts.append(replace(cloud, points=at - own[:, None] * moved))
    return reduce(Cloud.joined, parts), Rays(Stretch(tuple(sweeps)), KEY)


def maps(dark, passes):
    """The map without and with bodies, true depth of the box (0 none), y and z of its front."""
    cloud, rays = scanned(dark, passes)
    surface = patches_of(cloud)
    ray = pixel_rays(CAMERA)
    enter, leave = enters(np.zeros(3), ray.reshape(-1, 3), LOW, HIGH)
    true_m = np.where(enter < leave, enter, 0).reshape(ray.shape[:2])
    before = depth_map(cloud, EXPOSURE, surface, rays=rays)
    bodies = find_moving_bodies(cloud, rays, [EXPOSURE])
    assert bodies.keys() == {0}
    after = depth_map(cloud, EXPOSURE, surface, rays=rays, bodies=bodies)
    return before, after, true_m, *(ray * LOW[0])[..., 1:].transpose(2, 0, 1)


def test_nothing_shines_through_a_closed_box():
    """Without a return from its door and with returns from behind its pane."""
    pane = np.random.default_rng(1)

    def passes(y, z):
        return within(y, z, PANE) & (pane.random(len(y)) < 0.4)

    before, after, true_m, y, z = maps(lambda y, z: within(y, z, DOOR), passes)
    box, beside = true_m > 0, stage._erode(true_m == 0, 4)
    assert not ((after.filled_m > 1.2 * true_m) & stage._erode(box, 2)).any()
    known = box & (after.filled_m > 0)
    assert known.sum() > 0.95 * box.sum() and (before.filled_m > 0)[box].mean() < 0.5
    assert np.abs(after.filled_m / np.where(box, true_m, 1) - 1)[known].max() < 0.05
    assert (known & within(y, z, DOOR)).sum() > 0.99 * within(y, z, DOOR).sum()
    same = after.filled_m[beside] == before.filled_m[beside]
    assert same.mean() > 0.999
    measured = box & (after.depth_m > 0)
    assert not (measured & stage._erode(within(y, z, DOOR), 3)).any()  # filled, not measured
    assert (after.frame[measured] >= 0).all()


def test_an_open_frame_stays_open():
    _, after, true_m, y, z = maps(
        lambda y, z: np.zeros(len(y), bool), lambda y, z: within(y, z, HOLE)
    )
    hole, frame = within(y, z, HOLE), (true_m > 0) & ~within(y, z, HOLE)
    open_m = after.filled_m[stage._erode(hole, 9)]
    assert (np.abs(open_m - WALL_M) < 0.5).mean() > 0.95
    shown = after.filled_m[stage._erode(frame, 3)]
    assert (np.abs(shown / 10 - 1) < 0.2).mean() > 0.95


def test_lines_cross_a_hull_where_sampling_finds_them():
    rng = np.random.default_rng(4)
    corners = rng.normal(size=(30, 3))
    start, way = rng.normal(size=(200, 3)) * 3, rng.normal(size=(200, 3)) * 3
    enter, leave = hulls.find_crossing(hulls.half_spaces(corners), start, way)
    assert not (hulls.passes_near(corners, start, way) < (enter < leave)).any()
    t, inside = np.linspace(-3, 3, 6001), Delaunay(corners[ConvexHull(corners).vertices])
    for i in range(len(start)):
        on = t[inside.find_simplex(start[i] + t[:, None] * way[i]) >= 0]
        if len(on):
            np.testing.assert_allclose(
                [on[0], on[-1]], np.clip([enter[i], leave[i]], -3, 3), atol=2e-3
            )
        else:
            assert max(enter[i], -3) > min(leave[i], 3) - 2e-3


def test_a_body_is_in_view_has_a_front_and_loses_the_rays_of_a_sweep():
    cloud, rays = scanned(lambda y, z: within(y, z, DOOR), lambda y, z: np.zeros(len(y), bool))
    backwards = Exposure(CAMERA, T_CAM_LIDAR @ np.diag([-1.0, -1, 1, 1]))
    assert find_moving_bodies(cloud, rays, [backwards]) == {}
    body = find_moving_bodies(cloud, rays, [backwards, EXPOSURE])[0]
    shape, middle = (CAMERA.height_px, CAMERA.width_px), (CAMERA.height_px // 2, 210)
    for depth_m, inside in ((10.1, False), (11.0, True)):  # seats are far behind the front
        far = stage.find_far_inside([body], EXPOSURE, np.full(shape, depth_m, np.float32))
        assert far[middle] == inside and not far[0].any()
    other_sweeps = cloud.select(cloud.frame != KEY)
    reduced = without_sweep({0: body}, other_sweeps, KEY)[0]
    assert set(reduced.frame) == set(body.frame) - {KEY}
    assert len(reduced.entries) == len(reduced.ends) == len(reduced.frame)
    assert set(map(tuple, reduced.corners)) <= set(map(tuple, other_sweeps.points))


@pytest.mark.parametrize("num", [3, 40])
def test_flat_and_tiny_objects_have_no_body(num):
    points = np.random.default_rng(2).uniform(size=(num, 3)) * [0, 0.4, 0.4] + [9, 0, 0]
    cloud = make_cloud(points)
    cloud.moving[:], cloud.instance[:] = True, 0
    sweep = registered(KEY, points, np.eye(4), np.zeros(6))
    assert find_moving_bodies(cloud, Rays(Stretch((sweep,)), KEY), [EXPOSURE]) == {}
