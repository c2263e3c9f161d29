# SPDX-License-Identifier: MIT
"""How everything in a stretch moves: the engines behind one call."""

from __future__ import annotations

from collections.abc import Sequence

from densify import poses
from densify.config import FlowSettings
from densify.flow.chained import ChainedMotion
from densify.flow.groups import follow
from densify.types import Float32, FlowField, Motion, Stretch


def estimate_motion(
    stretch: Stretch, heights_m: Sequence[Float32], settings: FlowSettings
) -> Motion:
    """By the engine that the settings name.

    heights_m: per sweep (N,) above the ground.
    """
    if settings.engine == "groups":
        return follow(stretch, heights_m, settings.min_height_m)
    return ChainedMotion(
        stretch,
        lambda here, there: _objective(stretch, heights_m, here, there, settings),
        settings.max_gap_m,
    )


def _objective(
    stretch: Stretch, heights_m: Sequence[Float32], here: int, there: int, settings: FlowSettings
) -> FlowField:
    """The published way: the points above the ground of two sweeps, by index."""
    from densify.flow.pair import flow_between

    source, target = (stretch.sweeps[i] for i in (here, there))
    above, above_there = (heights_m[i] >= settings.min_height_m for i in (here, there))
    field = FlowField.zero(len(source.sweep))
    if above.any() and above_there.any():
        pair = flow_between(
            poses.transform(source.T_world_lidar, source.sweep.points[above]),
            poses.transform(target.T_world_lidar, target.sweep.points[above_there]),
            settings,
        )
        field.displacement[above] = pair.displacement @ source.T_world_lidar[:3, :3]
        field.moving[above] = pair.moving
    return field
