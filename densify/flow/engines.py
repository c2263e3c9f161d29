# SPDX-License-Identifier: MIT
"""How everything in a stretch moves: the engines behind one call."""

from __future__ import annotations

from densify.config import FlowSettings
from densify.flow.chained import ChainedMotion
from densify.geometry import poses
from densify.geometry.height_map import HeightMap
from densify.types import FlowField, Motion, Stretch


def estimate_motion(stretch: Stretch, ground: HeightMap, settings: FlowSettings) -> Motion:
    """By the engine that the settings name."""
    if settings.engine == "groups":
        from densify.flow.tracking.groups import follow

        return follow(stretch, ground, settings.min_height_m, settings.soft)
    return ChainedMotion(
        stretch,
        lambda here, there: _objective(stretch, ground, here, there, settings),
        settings.max_gap_m,
    )


def _objective(
    stretch: Stretch, ground: HeightMap, here: int, there: int, settings: FlowSettings
) -> FlowField:
    """The published way: the points above the ground of two sweeps, by index."""
    from densify.flow.pairs.estimate import flow_between

    clouds = [
        poses.transform(s.T_world_lidar, s.sweep.points)
        for s in (stretch.sweeps[here], stretch.sweeps[there])
    ]
    above, above_there = (ground.above(c) >= settings.min_height_m for c in clouds)
    field = FlowField.zero(len(above))
    if above.any() and above_there.any():
        pair = flow_between(clouds[0][above], clouds[1][above_there], settings)
        R_world_lidar = stretch.sweeps[here].T_world_lidar[:3, :3]
        field.displacement[above] = pair.displacement @ R_world_lidar
        field.moving[above] = pair.moving
    return field
