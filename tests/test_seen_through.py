# SPDX-License-Identifier: MIT
"""Fences, boards and poles before a wall, seen by a scanner that drives past: analytic truth."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth.exposure import Exposure
from densify.depth.project import find_crossings
from densify.depth.rays import Rays
from densify.geometry.poses import exp, transform
from densify.geometry.types import Stretch
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

FRONT_M, WALL_M = 12.0, 20.0
PICKET_M, STEP_M = 0.09, 0.17
CAMERA = make_camera(width=400, height=60, focal=720.0)


def fence(y, z):
    return np.mod(y, STEP_M) < PICKET_M


def pole(y, z):
    return np.abs(y) < 0.06


def scanned(solid):
    """What eleven sweeps see of what is ``solid`` (y, z -> bool) in the plane x = 12 m before the
    wall in x = 20 m, placed with 2 cm of error; and where the scanner stood."""
    rng = np.random.default_rng(3)
    points, frames, origins, sweeps = [], [], {}, []
    for frame in range(KEY - 5, KEY + 6):
        origin = np.array([0.7 * (frame - KEY), 0.15 * (frame - KEY), 0.0])
        ray = scanner_rays(np.arange(-25, 25, 0.17) + rng.uniform(0, 0.17), np.arange(-4, 4, 0.4))
        at = origin + ray * (FRONT_M - origin[0])
        stops = solid(at[:, 1], at[:, 2])
        at[~stops] = (origin + ray * (WALL_M - origin[0]))[~stops]
        points.append(at + rng.normal(0, 0.02, 3))
        frames.append(np.full(len(at), frame))
        origins[frame], pose = origin[None], np.eye(4)
        pose[:3, 3] = origin
        sweeps.append(registered(frame, at, pose, np.zeros(6)))
    cloud = make_cloud(np.vstack(points), np.concatenate(frames))
    return cloud, origins, Rays(Stretch(tuple(sweeps)), KEY)


def maps(solid, **knobs):
    """The map without and with what rays tell, and (H,W) whether the plane before the wall is solid
    there."""
    cloud, origins, rays = scanned(solid)
    exposure = Exposure(CAMERA, T_CAM_LIDAR, **knobs)
    surface = patches_of(cloud, origins)
    _, y, z = np.moveaxis(pixel_rays(CAMERA) * FRONT_M, -1, 0)
    before = depth_map(cloud, exposure, surface)
    return before, depth_map(cloud, exposure, surface, rays=rays), solid(y, z)


def test_gaps_of_a_fence_are_not_closed():
    before, after, solid = maps(fence, measure="range")
    middle = 0.5 * (FRONT_M + WALL_M)
    closed = [((m.filled_m > 0) & (m.filled_m < middle) & ~solid).sum() for m in (before, after)]
    pickets = [((m.filled_m > 0) & (m.filled_m < middle) & solid).sum() for m in (before, after)]
    assert closed[0] > 0.5 * (~solid).sum()
    assert closed[1] < 0.35 * closed[0]
    assert pickets[1] > 0.7 * pickets[0]
    dropped = (before.filled_m > 0) & (after.filled_m == 0)
    assert np.array_equal(after.filled_m[~dropped], before.filled_m[~dropped])
    assert not after.depth_m[dropped].any()
    assert np.array_equal(after.rejected.depth_m[dropped], before.filled_m[dropped])
    assert np.array_equal(after.frame >= 0, after.depth_m > 0)


def test_a_pole_stays_though_sweeps_saw_what_is_behind_it():
    before, after, there = maps(pole)
    assert (before.depth_m[there] > 0).mean() > 0.1
    lost = (before.filled_m > 0) & (after.filled_m == 0)
    assert lost[there].mean() < 0.001
    assert lost.mean() < 0.002


@pytest.mark.parametrize("measure", ["z", "range"])
def test_rays_cross_a_surface_where_geometry_says(measure):
    rng = np.random.default_rng(1)
    start = rng.uniform(-3, 3, (120, 3)) * [1, 1, 0.2]
    end = rng.uniform([15, -6, -1], [25, 6, 1], (120, 3))
    exposure = Exposure(CAMERA, T_CAM_LIDAR, measure=measure)
    ray = pixel_rays(CAMERA)
    depth_m = FRONT_M * (ray[..., 0] if measure == "z" else np.linalg.norm(ray, axis=-1))
    surface_m = np.where(np.arange(CAMERA.width_px) > 300, 0, depth_m).astype(np.float32)
    share = (FRONT_M - start[:, :1]) / (end[:, :1] - start[:, :1])
    at, num_known, num_found = start + share * (end - start), 0, 0
    for i in range(len(start)):
        uv = CAMERA.K[:2, 2] - 720 * at[i, 1:] / FRONT_M
        found = find_crossings(surface_m, start[i : i + 1], end[i : i + 1], exposure)
        assert len(found) == 0 or np.allclose(found[0], uv, atol=0.05)
        ends = CAMERA.K[:2, 2] - 720 * end[i, 1:] / end[i, 0]
        known = [np.all((p > 0) & (p < [300, CAMERA.height_px - 1])) for p in (uv, ends)]
        num_known += all(known)
        num_found += all(known) and len(found) == 1
    assert num_known > 12 and num_found >= 0.95 * num_known
    before_it = start + 0.99 * share * (end - start)
    assert len(find_crossings(surface_m, start, before_it, exposure)) == 0


def test_rays_start_where_the_scanner_was_when_it_registered():
    rng = np.random.default_rng(2)
    twist, offset_ns = np.array([0.01, 0.02, 0.3, 14.0, 0.5, 0.1]), np.array([-40, 0, 30]) * 10**6
    pose = exp(rng.normal(size=6))
    of_key, other = (
        registered(f, rng.normal(size=(3, 3)), T, twist, offset_ns)
        for f, T in ((KEY, np.eye(4)), (KEY + 1, pose))
    )
    cloud = make_cloud(np.zeros((2, 3)), KEY + 1)
    cloud.row[:] = [2, 0]
    starts = Rays(Stretch((of_key, other)), KEY).origins_of(cloud)
    for start, when in zip(starts, (0.03 * 2 * twist, -0.04 * twist), strict=True):
        assert np.allclose(start, transform(pose @ exp(when), np.zeros((1, 3)))[0])
