# SPDX-License-Identifier: MIT
"""What moves does not depend on where the world's origin lies and where its x axis points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.free_space.ground import ground
from densify.geometry.types import Stretch
from tests.dataset_scenes import COARSE
from tests.found_motion import motion_in
from tests.scenes import Arc, Scene, World, car, street

SHIFT_M = (1234.567, -987.321, -8.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """On a scanner so coarse that a few points decide whether a car is followed."""
    cars = car(9, 1.8, 8, 1), car(18, -4.0, 6, 2, np.pi / 2)
    scanner = replace(COARSE, sigma_m=0.01)
    return Scene(World((*street(50.0), *cars)), Arc(0, -1.5, 0, 4.0), scanner)


@pytest.fixture(scope="module")
def stretch(scene: Scene) -> Stretch:
    return scene.stretch(5, 4)


def seen_from(stretch: Stretch, shift_m=(0.0, 0.0, 0.0), yaw_deg: float = 0.0) -> Stretch:
    """The same sweeps in another world."""
    T_new_old = np.eye(4)
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    T_new_old[:2, :2] = [[c, -s], [s, c]]
    T_new_old[:3, 3] = shift_m
    sweeps = [replace(s, T_world_lidar=T_new_old @ s.T_world_lidar) for s in stretch.sweeps]
    return Stretch(tuple(sweeps))


def moving(stretch: Stretch) -> np.ndarray:
    motion = motion_in(stretch, ground(stretch))
    return np.concatenate([instance >= 0 for instance in motion.track_of_point])


@pytest.fixture(scope="module")
def here(stretch: Stretch) -> np.ndarray:
    return moving(stretch)


@pytest.mark.parametrize(("shift_m", "yaw_deg"), [(SHIFT_M, 0.0), ((0.0, 0.0, 0.0), 45.0)])
def test_movers_wherever_the_world_lies(shift_m, yaw_deg, scene, stretch, here) -> None:
    there = moving(seen_from(stretch, shift_m, yaw_deg))
    instance = np.concatenate([scene.scan(f).instance for f in stretch.frames])
    assert here[instance == 1].mean() > 0.8 and here[instance == 2].mean() > 0.9
    for number in (1, 2):
        assert there[instance == number].mean() > here[instance == number].mean() - 0.1
    if not yaw_deg:
        assert (there != here).sum() <= 0.02 * here.sum()
    assert not there[instance < 0].any()
