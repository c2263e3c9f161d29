# SPDX-License-Identifier: MIT
"""Ground: one height map of a stretch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from densify.config import GroundSettings
from densify.free_space.height_map import HeightMap
from densify.geometry import poses
from densify.geometry.types import Float, Stretch


def ground(stretch: Stretch, settings: GroundSettings) -> HeightMap:
    """All sweeps together fill a grid in the world, whose z is taken for up."""
    return HeightMap.of(_InWorld(stretch), settings)


@dataclass(frozen=True)
class _InWorld:
    """The sweeps' points, one sweep at a time: together they would need as much memory again as the
    stretch."""

    stretch: Stretch

    def __iter__(self) -> Iterator[Float]:
        return (poses.transform(s.T_world_lidar, s.sweep.points) for s in self.stretch.sweeps)
