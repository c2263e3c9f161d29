# SPDX-License-Identifier: MIT
"""Solve the objective of Pontes, Hays, Lucey (3DV 2020) between two clouds.

The engine ``paper`` solves it between neighbouring sweeps, above the ground.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from densify.config import Config, ObjectiveSettings
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.flow.objective.solvers import SolverSettings, solve
from densify.flow.pairs.motions import MIN_MOTION_M, RigidMotion, judge
from densify.flow.pairs.surface import PairCloud
from densify.flow.tracking.candidates import LINK_M
from densify.free_space.ground import ABOVE_GROUND_M
from densify.geometry import poses
from densify.geometry.nearest import link
from densify.geometry.types import Float, FlowField, Motion


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Return the motion by the published objective, see `EngineModule`; takes no argument."""

    def step(i: int, j: int) -> FlowField:
        return _step(scene, i, j, settings)

    return ChainedMotion(scene.stretch, step)


def _step(scene: Scene, i: int, j: int, settings: Config) -> FlowField:
    """Return the flow of sweep index ``i`` to ``j``, in its lidar frame; 0 on the ground."""
    clouds = [
        poses.transform(s.T_world_lidar, s.sweep.points)
        for s in (scene.stretch.sweeps[i], scene.stretch.sweeps[j])
    ]
    above, target_above = (scene.ground.above(c) >= ABOVE_GROUND_M for c in clouds)
    field = FlowField.zero(len(above))
    if above.any() and target_above.any():
        pair = flow_between(clouds[0][above], clouds[1][target_above], settings.objective)
        R_world_lidar = scene.stretch.sweeps[i].T_world_lidar[:3, :3]
        field.displacement[above] = pair.displacement @ R_world_lidar
        field.moving[above] = pair.moving
    return field


def flow_between(
    source: ArrayLike,
    target: ArrayLike,
    settings: ObjectiveSettings,
    initial: ArrayLike | None = None,
) -> FlowField:
    """Return the flow of a source cloud (N,3) to a target (M,3), by the published objective.

    With ``static_prior`` only groups that certainly move have flow. See `densify.estimate_flow`.
    """
    objective = SolverSettings(
        solver=settings.solver,
        alpha=settings.alpha,
        num_neighbors=settings.num_neighbors,
    )
    flow = solve(source, target, objective, initial).flow
    if settings.static_prior:
        return _only_proven((np.asarray(source, float), np.asarray(target, float)), flow)
    static = FlowField.zero(len(flow))
    return replace(static, displacement=flow, moving=np.ones(len(flow), bool))


def _only_proven(clouds: tuple[Float, Float], flow: Float) -> FlowField:
    """Keep the flow (N,3) of groups of points that certainly move; other points get flow 0."""
    field = FlowField.zero(len(flow))
    source, target = (PairCloud(c, np.full(len(c), float(i))) for i, c in enumerate(clouds))
    moved = np.flatnonzero(np.linalg.norm(flow, axis=1) > MIN_MOTION_M)
    num_groups, group = link(source.points[moved], LINK_M)
    instance = 0
    for k in range(num_groups):
        rows = moved[group == k]
        state, centre = np.append(np.median(flow[rows], axis=0), 0.0), source.points[rows].mean(0)
        # by its common translation: the free flow always comes closer to the target
        if judge(k, rows, RigidMotion(state, centre), source, target).moves():
            field.displacement[rows] = flow[rows]
            field.moving[rows] = True
            field.instance[rows] = instance
            instance += 1
    return field
