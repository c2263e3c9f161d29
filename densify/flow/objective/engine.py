# SPDX-License-Identifier: MIT
"""Engine ``paper``: solve the published objective between neighbouring sweeps, above the ground."""

from __future__ import annotations

from densify.config import Config
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.flow.pairs.estimate import flow_between
from densify.free_space.ground import ABOVE_GROUND_M
from densify.geometry import poses
from densify.geometry.types import FlowField, Motion


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Return the motion by the published objective, see `EngineModule`; takes no argument."""

    def step(here: int, there: int) -> FlowField:
        return _step(scene, here, there, settings)

    return ChainedMotion(scene.stretch, step)


def _step(scene: Scene, here: int, there: int, settings: Config) -> FlowField:
    """Return the flow of sweep index ``here`` to ``there``, in its lidar frame; 0 on the ground."""
    clouds = [
        poses.transform(s.T_world_lidar, s.sweep.points)
        for s in (scene.stretch.sweeps[here], scene.stretch.sweeps[there])
    ]
    above, above_there = (scene.ground.above(c) >= ABOVE_GROUND_M for c in clouds)
    field = FlowField.zero(len(above))
    if above.any() and above_there.any():
        pair = flow_between(clouds[0][above], clouds[1][above_there], settings.objective)
        R_world_lidar = scene.stretch.sweeps[here].T_world_lidar[:3, :3]
        field.displacement[above] = pair.displacement @ R_world_lidar
        field.moving[above] = pair.moving
    return field
