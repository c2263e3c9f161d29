# SPDX-License-Identifier: MIT
"""A trained network as an engine: its flow proposes, the proof of `densify.flow.tracking` decides.

Where the network sees points move, groups start with the velocity that it sees; they are followed
through all sweeps and count as moving only if their path is smooth and does away with what
contradicts that they stand, exactly as for the engine ``groups``. Whatever else the network says
moves nothing.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Candidates, closer_rings, cluster_around
from densify.flow.tracking.groups import GroupMotion, motion_of
from densify.geometry import poses
from densify.geometry.threads import num_threads
from densify.geometry.types import Float
from densify.learning.clouds import AboveGround, order_for
from densify.learning.model_file import read_model
from densify.learning.network import NUM_SWEEPS, Voxels

MOVES_M_S = 0.5
"""Points that the network sees move more slowly start no track (Chodosh et al., WACV 2024)."""


def check_argument(argument: str) -> None:
    """Raise InputError unless it names a model."""
    read_model(Path(argument))


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """See `densify.flow.engines.EngineModule`. argument: the model's file."""
    network = read_model(Path(argument)).network
    standing = _standing(scene)
    flows = flows_of(network, standing, [s.T_world_lidar[:3, 3] for s in scene.stretch.sweeps])
    stamps_s = [s.sweep.stamp_ns * 1e-9 for s in scene.stretch.sweeps]
    found, velocities = [], []
    for i, candidates in enumerate(scene.candidates):
        duration_s = stamps_s[_neighbor(i, len(standing))] - stamps_s[i] if len(standing) > 1 else 1
        velocity_m_s = flows[i] / duration_s
        velocity_m_s[:, 2] = 0.0
        grouped, common_m_s = _grouped(scene, i, candidates, standing[i], velocity_m_s)
        found.append(grouped)
        velocities.append(common_m_s)
    return motion_of(scene, tuple(found), velocities)


def flows_of(network: Voxels, standing: list[AboveGround], origins: list[Float]) -> list[Float]:
    """(n,3) metres for each sweep: to the next, of the last one to the one before; world.

    origins: (3,) world, the scanner at each sweep.
    """

    def of_sweep(i: int) -> Float:
        if len(standing) < 2 or not len(standing[i].row):
            return np.zeros((len(standing[i].row), 3))
        numbers = order_for(i, _neighbor(i, len(standing)), len(standing), NUM_SWEEPS)
        sweeps = [None if n is None else standing[n].cloud(origins[i]) for n in numbers]
        with torch.inference_mode():
            flow: Float = network(sweeps).double().numpy()
        return flow

    with ThreadPoolExecutor(
        num_threads(), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        return list(pool.map(of_sweep, range(len(standing))))


def _neighbor(i: int, count: int) -> int:
    return i + 1 if i + 1 < count else i - 1


def _standing(scene: Scene) -> list[AboveGround]:
    """The points of `Scene.candidates`, as in training."""
    found = []
    for registered, candidates in zip(scene.stretch.sweeps, scene.candidates, strict=True):
        row = candidates.row
        points = poses.transform(registered.T_world_lidar, registered.sweep.points[row])
        found.append(AboveGround(row, points, scene.ground.above(points)))
    return found


def _grouped(
    scene: Scene, i: int, candidates: Candidates, standing: AboveGround, velocity_m_s: Float
) -> tuple[Candidates, Float]:
    """Return the points of sweep i that may start a track, and their (n,3) velocities, m/s.

    Clusters of points that the network sees move may start one; those of the evidence alone may
    only be found again by one that was started elsewhere.
    """
    moves = np.linalg.norm(velocity_m_s, axis=1) >= MOVES_M_S
    registered = scene.stretch.sweeps[i]
    row = candidates.row
    gap_m = scene.space.sensors.gap_m(registered.sweep.points[row], registered.sweep.lidar[row])
    close = closer_rings(standing.points - registered.T_world_lidar[:3, 3], gap_m)
    num, cluster = cluster_around(close, moves)
    common_m_s = np.zeros_like(velocity_m_s)
    for k in range(num):
        mine = cluster == k
        common_m_s[mine] = np.median(velocity_m_s[mine & moves], axis=0)
    only_evidence = (cluster < 0) & (candidates.cluster >= 0)
    label = np.where(only_evidence, num + candidates.cluster, cluster)
    seed = candidates.seed & (cluster >= 0)
    return Candidates(row, seed, label, num + candidates.num_clusters), common_m_s
