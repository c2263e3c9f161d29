# SPDX-License-Identifier: MIT
"""A short street with one car ahead, exact and small: for tests of many runs."""

from __future__ import annotations

from tests.scenes import Arc, Scanner, Scene, TinySequence, World, car, street

KEY = 3
# Small as they are, their scanners stand for such of many points.
POSES_GIVEN = {
    "register": {"source": "dataset"},
    "accumulate": {"far_m": 0.0},
    "flow": {"look_around_s": 0.0},
}
CAR = car(9, 1.8, 8, 1)


def one_car(movers=(CAR,), late_s: float = 0.0, **options) -> TinySequence:
    """The vehicle at 4 m/s, the car at 8 m/s in the lane to the left."""
    world = World((*street(50.0), *movers))
    scene = Scene(world, Arc(0, -1.5, 0, 4.0), Scanner(48, 720))
    return TinySequence(scene, range(7), late_s, **options)
