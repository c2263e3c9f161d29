# SPDX-License-Identifier: MIT
"""Ground: one height map of a stretch."""

from __future__ import annotations

import numpy as np

from densify import poses
from densify.config import GroundSettings
from densify.height_map import HeightMap
from densify.types import Stretch


def ground(stretch: Stretch, settings: GroundSettings) -> HeightMap:
    """All sweeps together fill a grid in the world, whose z is taken for up."""
    clouds = [poses.transform(s.T_world_lidar, s.sweep.points) for s in stretch.sweeps]
    return HeightMap.of(np.concatenate(clouds), settings)
