# SPDX-License-Identifier: MIT
"""Ground: how high every point of the window is above it."""

from __future__ import annotations

import numpy as np

from densify import poses
from densify.config import GroundSettings
from densify.height_map import HeightMap
from densify.types import Float32, Window


def height_above_ground(window: Window, settings: GroundSettings) -> tuple[Float32, ...]:
    """Per sweep (N,) metres above the ground, from one map of all sweeps in the key frame, whose z
    is taken for up."""
    clouds = [poses.transform(s.T_key_lidar, s.sweep.points) for s in window.sweeps]
    ground = HeightMap.of(np.concatenate(clouds), settings)
    return tuple(ground.above(cloud) for cloud in clouds)
