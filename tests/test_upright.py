# SPDX-License-Identifier: MIT
"""Lidars whose mount leans: the world is upright all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.free_space.ground import find_upright, ground
from densify.geometry import poses
from densify.geometry.types import Sweep
from densify.registration.deskew import deskew
from tests.scenes import Arc, Scanner, Scene, World, street

STREET = World(street(60.0))


def leaning(world: World, rotvec_deg, num: int = 2) -> tuple[list[Sweep], np.ndarray]:
    """Sweeps in the axes of a lidar that leans, and (3,3) R_level_lidar."""
    R = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    scene = Scene(world, Arc(0, -1.5, 0, 8.0), Scanner(32, 450, (-25.0, 15.0)))
    sweeps = [scene.scan(f).sweep for f in range(num)]
    return [replace(s, points=s.points @ R) for s in sweeps], R


@pytest.mark.parametrize("rotvec_deg", [(0, 10, 0), (7, 30, 0), (0, 180, 0), (165, 20, 4)], ids=str)
def test_a_lidar_that_leans_or_hangs_is_turned_upright(rotvec_deg):
    sweeps, R = leaning(STREET, rotvec_deg)
    found = find_upright(sweeps)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    up = found @ R.T @ [0, 0, 1]  # what is up, after the turn that was found
    assert np.rad2deg(np.arccos(up[2])) < 1.0  # kerbs


@pytest.mark.parametrize("rotvec_deg", [(0, 0, 0), (0, 4, 0), (-3, 2, 0)], ids=str)
def test_what_leans_little_is_left_alone(rotvec_deg):
    sweeps, _ = leaning(STREET, rotvec_deg)
    assert np.array_equal(find_upright(sweeps), np.eye(3))


def test_the_world_of_a_leaning_lidar_is_level():
    """And with it the map of the ground, which would take a plane of 10 degrees for a slope that
    no ground has."""
    sweeps, R = leaning(STREET, (0, 10, 0), 3)
    scene = Scene(STREET, Arc(0, -1.5, 0, 8.0), Scanner(32, 450, (-25.0, 15.0)))
    trajectory = scene.trajectory([0, 1, 2])
    T_level_lidar = np.eye(4)
    T_level_lidar[:3, :3] = R
    leant = replace(trajectory, T_world_lidar=trajectory.T_world_lidar @ T_level_lidar)
    for R_level_lidar, expected in ((find_upright(sweeps), True), (np.eye(3), False)):
        seen = replace(leant, R_level_lidar=R_level_lidar).part([0, 1, 2], origin=1)
        stretch = deskew(sweeps, seen)
        heights = ground(stretch)
        points = poses.transform(stretch[1].T_world_lidar, stretch[1].sweep.points)
        true_m = scene.height_m(1)
        low = true_m < 0.05
        assert ((np.abs(heights.above(points)[low]) < 0.2).mean() > 0.97) == expected
        tall = (true_m > 0.5) & (true_m < 2)
        assert ((np.abs(heights.above(points) - true_m)[tall] < 0.4).mean() > 0.94) == expected
