# SPDX-License-Identifier: MIT
"""The street of the pipeline's tests: `scenes` with three movers, from a vehicle that turns."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from densify.geometry.types import Cloud
from tests.scenes import Arc, Scanner, Scene, TinySequence, World, car, street
from tests.small_street import POSES_GIVEN  # noqa: F401  for the tests of this street

KEY, WINDOW = 8, 3
EGO = Arc(0, -1.5, 0, 8.0, 0.08)
MOVERS = (
    car(6, 1.8, 9, 1),
    car(45, 1.8, 8, 2, yaw=np.pi),
    car(16, 3.6, 1.5, 3, yaw=-np.pi / 2, size_m=(0.5, 0.5, 1.7)),
)


def tiny(movers=(), late_s=0.0, ego=EGO, **options) -> TinySequence:
    scene = Scene(World((*street(), *movers)), ego, Scanner(num_azimuths=1200, sigma_m=0.01))
    return TinySequence(scene, range(14), late_s, **options)


def same_points(a: Cloud, b: Cloud) -> bool:
    return all(getattr(a, f.name).tobytes() == getattr(b, f.name).tobytes() for f in fields(Cloud))
