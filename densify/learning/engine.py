# SPDX-License-Identifier: MIT
"""Use a trained network as an engine: its flow proposes, `densify.flow.tracking` decides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Obstacles, cluster_rings
from densify.flow.tracking.groups import GroupMotion, find_group_motion
from densify.geometry.types import Float
from densify.learning.network import AboveGround, Model, order_for, read_model

# Least speed by the network of points that may start a track (Chodosh et al., WACV 2024)
MOVES_M_S = 0.5


def check_argument(argument: str) -> None:
    """Raise InputError unless the argument is the path of a readable model file."""
    read_model(Path(argument))


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Return the motion of a scene's points by the network in the model file ``argument``."""
    model = read_model(Path(argument))
    sweeps = scene.stretch.sweeps
    pairs = zip(sweeps, scene.obstacles, strict=True)
    above = [AboveGround.of(sweep, scene.ground, obstacles.row) for sweep, obstacles in pairs]
    flows = flows_of(model, above, [registered.T_world_lidar[:3, 3] for registered in sweeps])
    stamps_s = [registered.sweep.stamp_ns * 1e-9 for registered in sweeps]
    grouped, velocities = [], []
    for index, flow in enumerate(flows):
        duration_s = 1.0
        if len(above) > 1:
            duration_s = stamps_s[_neighbor(index, len(above))] - stamps_s[index]
        velocity_m_s = flow / duration_s
        velocity_m_s[:, 2] = 0.0
        obstacles, common_m_s = _grouped(scene, index, above[index].points, velocity_m_s)
        grouped.append(obstacles)
        velocities.append(common_m_s)
    return find_group_motion(scene, grouped, velocities)


def flows_of(model: Model, above: list[AboveGround], origins: list[Float]) -> list[Float]:
    """Return for each sweep the flow (n,3) to the next sweep, metres, world, ego-motion removed.

    The last sweep has its flow to the previous sweep. A single sweep has flow 0. ``above`` has the
    points above the ground of each sweep, ``origins`` the (3,) position of its scanner, world.
    """
    flows = []
    for index, source in enumerate(above):
        if len(above) < 2 or not len(source.row):
            flows.append(np.zeros((len(source.row), 3)))
            continue
        numbers = order_for(index, _neighbor(index, len(above)), len(above))
        clouds = [
            None if number is None else above[number].cloud(origins[index]) for number in numbers
        ]
        flows.append(model.flow(clouds))
    return flows


def _neighbor(index: int, num_sweeps: int) -> int:
    """Return the index of the next sweep, for the last sweep that of the sweep before it."""
    return index + 1 if index + 1 < num_sweeps else index - 1


def _grouped(
    scene: Scene, index: int, points: Float, velocity_m_s: Float
) -> tuple[Obstacles, Float]:
    """Return a sweep's n obstacles (points, world) for tracking, and their (n,3) velocities."""
    # Clusters that move according to the network may start a track, at their median velocity.
    # Clusters from free-space violations alone may only join a track that was started elsewhere.
    moves = np.linalg.norm(velocity_m_s, axis=1) >= MOVES_M_S
    obstacles, registered = scene.obstacles[index], scene.stretch.sweeps[index]
    num, cluster = cluster_rings(points, obstacles.row, moves, registered, scene.space.sensors)
    common_m_s = np.zeros_like(velocity_m_s)
    for number in range(num):
        members = cluster == number
        common_m_s[members] = np.median(velocity_m_s[members & moves], axis=0)
    only_evidence = (cluster < 0) & obstacles.candidate
    label = np.where(only_evidence, num + obstacles.cluster, cluster)
    seed = obstacles.seed & (cluster >= 0)
    num_clusters = num + obstacles.num_clusters
    return replace(obstacles, seed=seed, cluster=label, num_clusters=num_clusters), common_m_s
