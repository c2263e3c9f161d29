# SPDX-License-Identifier: MIT
"""What points stand for: spacing and tangent planes of scanned scenes known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth.patches import find_patches
from densify.free_space.sensor import Sensors
from tests.depth_scenes import KEY, make_cloud, patches_of
from tests.fired import fired
from tests.scenes import Arc, Box, World

GROUND_M = 1.7


def directions(azimuth_deg, beams_deg):
    azimuth, elevation = np.radians(np.meshgrid(np.arange(-90, 90, azimuth_deg), beams_deg))
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)


def scanned(ray, origin=(0.0, 0.0, 0.0), wall_m=30.0):
    """Ground 1.7 m below the origin and a wall across x, met by the rays; and which is which."""
    with np.errstate(divide="ignore"):
        ground = np.where(ray[:, 2] < 0, -GROUND_M / ray[:, 2], np.inf)
        wall = np.where(ray[:, 0] > 0, wall_m / ray[:, 0], np.inf)
    return np.asarray(origin) + ray * np.minimum(ground, wall)[:, None], ground < wall


SENSORS = {
    "64 beams": (0.17, np.concatenate([np.linspace(-24.3, -8.8, 32), np.linspace(-8.3, 2, 32)])),
    "32 beams": (0.17, np.linspace(-30.7, 10.7, 32)),
    "16 beams": (0.2, np.linspace(-15, 15, 16)),
}


@pytest.mark.parametrize("sensor", SENSORS)
def test_spacing_is_the_sensors_own(sensor):
    azimuth_deg, beams_deg = SENSORS[sensor]
    origin = np.array([3.0, 1.0, 0.2])
    ray = directions(azimuth_deg, beams_deg)
    ray = ray[ray[:, 0] > 0.2]
    points, _ = scanned(ray, origin)
    cloud = make_cloud(points, KEY + 1)
    found = patches_of(cloud, {KEY + 1: origin[None]})
    range_m = np.linalg.norm(points - origin, axis=1)
    level_m = range_m * np.hypot(ray[:, 0], ray[:, 1])
    across = found.spacing_m[:, 0] / level_m / np.radians(azimuth_deg)
    assert across.min() > 0.9 and across.max() < 1.1
    elevation_deg = np.degrees(np.arcsin(ray[:, 2]))
    step_deg = np.interp(elevation_deg, beams_deg, np.gradient(beams_deg))
    along = found.spacing_m[:, 1] / range_m / np.radians(step_deg)
    inside = np.abs(elevation_deg + 8.5) > 1.0  # where the blocks of 64 beams meet it changes
    assert along[inside].min() > 0.85 and along[inside].max() < 1.15


@pytest.mark.parametrize("sensor", SENSORS)
def test_normals_of_ground_and_wall(sensor):
    ray = directions(*SENSORS[sensor])
    ray = ray[ray[:, 0] > 0.3]
    points, on_ground = scanned(ray)
    normal = patches_of(make_cloud(points)).normal.astype(float)
    np.testing.assert_allclose(np.einsum("ij,ij->i", normal, points), 1, rtol=1e-3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    truth = np.where(on_ground[:, None], [0, 0, -1.0], [1.0, 0, 0])
    right = np.abs(np.einsum("ij,ij->i", normal, truth)) > np.cos(np.radians(5))
    assert right.mean() > 0.9  # all but where ground and wall meet, and at the ends of the view


def test_a_post_before_a_wall_faces_the_scanner():
    ray = directions(*SENSORS["64 beams"])
    ray = ray[(ray[:, 0] > 0.3) & (ray[:, 2] > -0.02)]
    points = ray * (30 / ray[:, :1])
    post = np.abs(ray[:, 1]) < 0.002
    points[post] *= 1 / 3
    normal = patches_of(make_cloud(points)).normal.astype(float)
    assert post.sum() > 10
    towards = np.einsum("ij,ij->i", normal, ray) / np.linalg.norm(normal, axis=1)
    assert towards[post].min() > 0.99


@pytest.mark.parametrize(("name", "share"), [("panda", 0.8), ("rosette", 0.7), ("dual32", 0.7)])
def test_normals_are_told_scanner_by_scanner(name, share):
    # A corner: ground 1.7 m below the scanner, a wall 15 m ahead
    wall = World((Box((1.0, 200.0, 40.0), Arc(15.5, 0.0), base_m=-20.0),))
    registered = fired(name, wall, share_heard=1.0)
    sweep, sensors = registered.sweep, Sensors.of([registered])
    cloud = replace(make_cloud(sweep.points), lidar=sweep.lidar)
    normal = find_patches(cloud, sensors, {KEY: sensors.origins_m}).normal
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    on_wall = (np.abs(sweep.points[:, 0] - 15.0) < 0.01) & (sweep.points[:, 2] > -1.2)
    on_ground = (np.abs(sweep.points[:, 2] + 1.7) < 0.01) & (sweep.points[:, 0] < 13)
    near = np.abs(np.arctan2(sweep.points[:, 1], sweep.points[:, 0])) < np.deg2rad(25)
    for number in np.unique(sweep.lidar):
        mine = (sweep.lidar == number) & near
        for part, truth in ((on_wall, [1.0, 0, 0]), (on_ground, [0, 0, -1.0])):
            right = np.abs(normal[mine & part] @ truth) > np.cos(np.radians(8))
            assert (mine & part).sum() > 100 and right.mean() > share, (number, truth)
