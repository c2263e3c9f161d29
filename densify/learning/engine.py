# SPDX-License-Identifier: MIT
"""Use a trained network as an engine: its flow proposes, `densify.flow.tracking` decides."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Candidates, cluster_around, compress_heights
from densify.flow.tracking.groups import GroupMotion, find_group_motion
from densify.geometry.types import Float
from densify.learning.network import NUM_SWEEPS, AboveGround, Model, order_for, read_model

MOVES_M_S = 0.5
"""Least speed by the network of points that may start a track (Chodosh et al., WACV 2024)."""


def check_argument(argument: str) -> None:
    """Raise InputError unless the argument is the path of a model file."""
    read_model(Path(argument))


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Return the motion of a scene by the network of the model file ``argument``."""
    model = read_model(Path(argument))
    sweeps = scene.stretch.sweeps
    pairs = zip(sweeps, scene.candidates, strict=True)
    above = [AboveGround.of(sweep, scene.ground, candidates.row) for sweep, candidates in pairs]
    flows = flows_of(model, above, [registered.T_world_lidar[:3, 3] for registered in sweeps])
    stamps_s = [registered.sweep.stamp_ns * 1e-9 for registered in sweeps]
    all_grouped, velocities = [], []
    for index, candidates in enumerate(scene.candidates):
        duration_s = 1.0
        if len(above) > 1:
            duration_s = stamps_s[_neighbor(index, len(above))] - stamps_s[index]
        velocity_m_s = flows[index] / duration_s
        velocity_m_s[:, 2] = 0.0
        grouped, common_m_s = _grouped(scene, index, candidates, above[index], velocity_m_s)
        all_grouped.append(grouped)
        velocities.append(common_m_s)
    return find_group_motion(scene, tuple(all_grouped), velocities)


def flows_of(model: Model, above: list[AboveGround], origins: list[Float]) -> list[Float]:
    """Return for each sweep the flow (n,3) to the next sweep, metres, world, ego-motion removed.

    The last sweep has its flow to the previous sweep, a single one flow 0. ``above`` are the points
    above the ground, ``origins`` (3,) the position of the scanner in each sweep, world.
    """
    flows = []
    for index, source in enumerate(above):
        if len(above) < 2 or not len(source.row):
            flows.append(np.zeros((len(source.row), 3)))
            continue
        numbers = order_for(index, _neighbor(index, len(above)), len(above), NUM_SWEEPS)
        clouds = [
            None if number is None else above[number].cloud(origins[index]) for number in numbers
        ]
        flows.append(model.flow(clouds))
    return flows


def _neighbor(index: int, num_sweeps: int) -> int:
    """Return the index of the next sweep, for the last sweep that of the sweep before it."""
    return index + 1 if index + 1 < num_sweeps else index - 1


def _grouped(
    scene: Scene, index: int, candidates: Candidates, above: AboveGround, velocity_m_s: Float
) -> tuple[Candidates, Float]:
    """Return the candidates of a sweep for tracking, and their (n,3) velocities, m/s, world."""
    # Clusters that move according to the network may start a track, at their median velocity.
    # Clusters from free-space violations alone may only join a track that was started elsewhere.
    moves = np.linalg.norm(velocity_m_s, axis=1) >= MOVES_M_S
    registered = scene.stretch.sweeps[index]
    row = candidates.row
    gap_m = scene.space.sensors.gap_m(registered.sweep.points[row], registered.sweep.lidar[row])
    squeezed = compress_heights(above.points - registered.T_world_lidar[:3, 3], gap_m)
    num, cluster = cluster_around(squeezed, moves)
    common_m_s = np.zeros_like(velocity_m_s)
    for number in range(num):
        members = cluster == number
        common_m_s[members] = np.median(velocity_m_s[members & moves], axis=0)
    only_evidence = (cluster < 0) & (candidates.cluster >= 0)
    label = np.where(only_evidence, num + candidates.cluster, cluster)
    seed = candidates.seed & (cluster >= 0)
    return Candidates(row, seed, label, num + candidates.num_clusters), common_m_s
