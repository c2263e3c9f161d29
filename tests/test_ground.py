# SPDX-License-Identifier: MIT
"""Ground on a slope with kerbs, against the true heights; lidars whose mount leans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.free_space.ground import HeightMap, find_upright, ground
from densify.geometry import poses
from densify.geometry.types import Stretch, Sweep
from densify.registration.deskew import deskew
from tests.scenes import GROUND, KERB_Y_M, Arc, Box, Scanner, Scene, World, street

TRAILER = Box((9.0, 2.5, 1.2), Arc(14.0, 1.0, 0.2))  # lower than the scanner: its roof is seen


def in_world(stretch: Stretch, frame: int) -> np.ndarray:
    return poses.transform(stretch[frame].T_world_lidar, stretch[frame].sweep.points)


@pytest.fixture(scope="module", params=[0.0, -0.05], ids="slope {}".format)
def heights(request):
    """(estimated, true, box) of all points within 35 m, over 5 sweeps."""
    world = World((TRAILER, *street()), request.param)
    scene = Scene(world, Arc(0, -1.5, 0.0, 8.0, 0.1), Scanner(sigma_m=0.01))
    stretch = scene.stretch(4, 2)
    found = [ground(stretch).above(in_world(stretch, f)) for f in stretch.frames]
    near = [np.linalg.norm(s.sweep.points, axis=1) < 35 for s in stretch.sweeps]
    columns = [
        (h[n], scene.height_m(f)[n], scene.scan(f).box[n], scene.scan(f).world[n])
        for h, f, n in zip(found, stretch.frames, near, strict=True)
    ]
    return tuple(np.concatenate(c) for c in zip(*columns, strict=True))


def test_ground_is_at_zero(heights):
    found, _, box, world = heights
    road = box == GROUND
    assert abs(np.median(found[road])) < 0.04
    clear_of_kerb = road & (np.abs(np.abs(world[:, 1]) - KERB_Y_M) > 1.5)
    assert np.quantile(np.abs(found[clear_of_kerb]), 0.98) < 0.1


def test_a_roof_is_not_ground(heights):
    found, true, box, world = heights
    roof = (box == 0) & (world[:, 2] > world[box == 0, 2].max() - 0.1)
    assert roof.sum() > 50
    assert found[roof].min() > 0.7
    # how the grid's cells happen to lie on its edges counts for centimetres
    assert np.median(np.abs(found - true)[roof]) < 0.15


def test_returns_from_below_the_road_are_not_the_ground_but_below_it():
    """One in a hundred returns of every sweep is a mirror image: many in a cell over all sweeps."""
    scene = Scene(World(street()), Arc(0, -1.5, 0.0, 8.0), Scanner(sigma_m=0.01))
    stretch, rng = scene.stretch(4, 2), np.random.default_rng(0)
    clouds = [in_world(stretch, f) for f in stretch.frames]
    dirty, ghosts = [], []
    for points in clouds:
        near = np.flatnonzero(np.hypot(*points[:, :2].T) < 20)
        rows = rng.choice(near, len(near) // 100, replace=False)
        ghosts.append(points[rows] - [0, 0, 1] * rng.uniform(1.5, 4.0, (len(rows), 1)))
        dirty.append(np.concatenate([points, ghosts[-1]]))
    clean, found = HeightMap.of(clouds), HeightMap.of(dirty)
    for points, images, pose in zip(clouds, ghosts, stretch.sweeps, strict=True):
        near = points[np.hypot(*points[:, :2].T) < 20]
        assert np.quantile(np.abs(found.above(near) - clean.above(near)), 0.99) < 0.1
        T_lidar_world = poses.inverse(pose.T_world_lidar)
        both = poses.transform(T_lidar_world, np.concatenate([near, images]))
        deep = found.below(both, pose.T_world_lidar)
        assert deep[: len(near)].mean() < 0.001 and deep[len(near) :].mean() > 0.9


def test_under_follows_a_plane_and_stays_at_the_edge_beyond_it():
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (40000, 3))
    points[:, 2] = 2 + 0.1 * points[:, 0] - 0.05 * points[:, 1]
    heights = HeightMap.of([points])
    inside = rng.uniform(-18, 18, (500, 2))
    plane_m = 2 + 0.1 * inside[:, 0] - 0.05 * inside[:, 1]
    off_m = np.abs(heights.under(inside) - plane_m)
    assert np.median(off_m) < 0.005 and off_m.max() < 0.035
    standing = np.column_stack([inside, heights.under(inside) + 1.5])
    np.testing.assert_allclose(heights.above(standing), 1.5, atol=1e-6)
    assert heights.under(np.array([[500.0, 0.0]])) == heights.under(np.array([[20.0, 0.0]]))
    with_stray = HeightMap.of([np.concatenate([points, [[50_000.0, 400.0, 5.0]]])])
    assert with_stray.heights_m.shape == heights.heights_m.shape
    np.testing.assert_allclose(with_stray.heights_m, heights.heights_m, atol=0.05)


def test_many_and_few_returns_find_the_same_ground():
    """The lowest of many is lower than that of few: who drives from near to far would climb."""
    rng = np.random.default_rng(1)
    xy = rng.uniform([-15, -10], [15, 10], (60000, 2))
    many = xy[:, 0] < 0
    kept = many | (rng.random(len(xy)) < 0.04)  # 100 returns in a cell, or 4
    points = np.column_stack([xy, rng.normal(0, 0.03, len(xy))])[kept]
    heights = HeightMap.of([points])
    x, y = np.meshgrid(np.arange(-13, 13.5, 0.5), np.arange(-8, 8.5, 0.5), indexing="ij")
    found = heights.under(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
    near_m, far_m = found[x[:, 0] < -1], found[x[:, 0] > 1]
    assert abs(near_m.mean()) < 0.005 and abs(far_m.mean()) < 0.01
    assert abs(near_m.mean() - far_m.mean()) < 0.01


def test_under_a_vehicle_that_never_left_its_place_is_the_ground_around_it():
    """Nothing was measured below it and close beside it: its sides begin half a metre above a
    slope, and are the lowest that was seen there."""
    rng = np.random.default_rng(3)
    road = rng.uniform(-15, 15, (60000, 2))
    along, across = road @ [np.cos(0.6), np.sin(0.6)], road @ [-np.sin(0.6), np.cos(0.6)]
    vehicle = (np.abs(along) < 3.2) & (np.abs(across) < 1.2)
    seen = vehicle | (np.abs(along) > 5.2) | (np.abs(across) > 3.2)
    points = np.column_stack([road, np.where(vehicle, rng.uniform(0.5, 1.5, len(road)), 0.0)])
    points[:, 2] += 0.1 * points[:, 0]
    heights = HeightMap.of([points[seen]])
    off_m = heights.under(road[vehicle]) - 0.1 * road[vehicle, 0]
    assert np.abs(off_m).max() < 0.2 and np.abs(np.median(off_m)) < 0.1


def test_kerbs_islands_and_banks_are_ground():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-22, 22, (2, 200000))
    step_m = np.where(y > 5, 0.15, 0.0) + np.where(np.abs(y) < 1.5, 0.15, 0.0)  # kerb, island
    step_m += np.clip(0.12 * (x - 2), 0, 1.2)  # up a bank that stays up
    heights = HeightMap.of([np.column_stack([x, y, step_m])])
    away = (np.abs(np.abs(y) - 1.5) > 1.2) & (np.abs(y - 5) > 1.2)  # from cells with a step
    assert np.abs(heights.under(np.stack([x, y], 1)[away]) - step_m[away]).max() < 0.08


LEVEL = Scene(World(street(60.0)), Arc(0, -1.5, 0, 8.0), Scanner(32, 450, (-25.0, 15.0)))


def leaning(rotvec_deg, num: int = 2) -> tuple[list[Sweep], np.ndarray]:
    """Sweeps in the axes of a lidar that leans, and (3,3) R_level_lidar."""
    R = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    sweeps = [LEVEL.scan(f).sweep for f in range(num)]
    return [replace(s, points=s.points @ R) for s in sweeps], R


@pytest.mark.parametrize("rotvec_deg", [(0, 10, 0), (7, 30, 0), (0, 180, 0), (165, 20, 4)], ids=str)
def test_a_lidar_that_leans_or_hangs_is_turned_upright(rotvec_deg):
    sweeps, R = leaning(rotvec_deg)
    found = find_upright(sweeps)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    up = found @ R.T @ [0, 0, 1]  # what is up, after the turn that was found
    assert np.rad2deg(np.arccos(up[2])) < 1.0  # kerbs


@pytest.mark.parametrize("rotvec_deg", [(0, 0, 0), (0, 4, 0), (-3, 2, 0)], ids=str)
def test_what_leans_little_is_left_alone(rotvec_deg):
    assert np.array_equal(find_upright(leaning(rotvec_deg)[0]), np.eye(3))


def test_the_world_of_a_leaning_lidar_is_level():
    """And with it the map of the ground, which would take a plane of 10 degrees for a slope that
    no ground has."""
    sweeps, R = leaning((0, 10, 0), 3)
    trajectory = LEVEL.trajectory([0, 1, 2])
    T_level_lidar = np.eye(4)
    T_level_lidar[:3, :3] = R
    leant = replace(trajectory, T_world_lidar=trajectory.T_world_lidar @ T_level_lidar)
    true_m = LEVEL.height_m(1)
    low, tall = true_m < 0.05, (true_m > 0.5) & (true_m < 2)
    for R_level_lidar, expected in ((find_upright(sweeps), True), (np.eye(3), False)):
        seen = replace(leant, R_level_lidar=R_level_lidar).part([0, 1, 2], origin=1)
        stretch = deskew(sweeps, seen)
        height_m = ground(stretch).above(in_world(stretch, 1))
        assert ((np.abs(height_m[low]) < 0.2).mean() > 0.97) == expected
        assert ((np.abs(height_m - true_m)[tall] < 0.4).mean() > 0.94) == expected
