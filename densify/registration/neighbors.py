# SPDX-License-Identifier: MIT
"""Poses by all neighbours: each sweep laid on those of half a second before and after it.

Odometry lays a sweep on the map of what was before, point to point, and scanning patterns that move
with the vehicle pull it along. Sweeps from both sides together show surfaces, on which a sweep is
laid point to plane (Chen, Medioni, "Object modelling by registration of multiple range images",
IVC 1992): only the surfaces' normals are asked, for a sweep's own neighbours lie along one ring.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.kernels.threads import num_threads
from densify.registration.alignment import Surface, lay_on_planes, some
from densify.registration.deskew import deskew
from densify.registration.odometry import is_plausible
from densify.types import Float, Sweep, Trajectory

_AROUND_NS = 550_000_000
_NUM_AROUND = 10  # sweeps; of more every second one, third, ...
_NUM_POINTS = 15_000  # of a sweep
_VOXEL_M = 0.25
_MATCH_M = (0.3,)  # moving objects come farther between two sweeps
_FEW_POINTS = 20_000  # of patterns that odometry leaves decimetres off
_MATCH_OF_FEW_M = (0.9, 0.6, 0.3)  # in turn
_MOST = 1 / 3  # of that a sweep moves; farther off, wrong partners are as near as right ones
_HOLD = 0.01  # along highways one plane in fifty tells


def refine(
    sweeps: Sequence[Sweep], trajectory: Trajectory, settings: RegisterSettings
) -> Trajectory:
    """The trajectory with every pose laid on the neighbours as they were placed by it.

    sweeps: raw, of all its frames. Sweeps of which less than ``settings.min_overlap`` lies on their
    neighbours, or that would move by more than 0.1 m, keep their pose. The first one
    stays. Where sweeps hold few points it is done three times, and they may first move by 0.3 m.
    What no vehicle does is left aside.
    """
    chosen = [some(sweep, _NUM_POINTS) for sweep in sweeps]
    few = np.median([len(sweep) for sweep in sweeps]) < _FEW_POINTS
    for match_m in _MATCH_OF_FEW_M if few else _MATCH_M:
        laid = _round(chosen, trajectory, match_m, settings.min_overlap)
        if not is_plausible(laid, settings):
            break
        trajectory = laid
    return trajectory


def _round(
    sweeps: Sequence[Sweep], trajectory: Trajectory, match_m: float, min_overlap: float
) -> Trajectory:
    T = trajectory.T_world_lidar
    points = [s.sweep.points for s in deskew(sweeps, trajectory).sweeps]

    def found(i: int) -> Float:
        around = _around(trajectory, i)
        if not around:
            return T[i]
        T_own_world = poses.inverse(T[i])
        parts = [poses.transform(T_own_world @ T[j], points[j]) for j in around]
        target = Surface.of(np.concatenate(parts), _VOXEL_M)
        T_found, overlap = lay_on_planes(target, points[i], _VOXEL_M, match_m, _HOLD)
        held = overlap < min_overlap or np.linalg.norm(T_found[:3, 3]) > _MOST * match_m
        return T[i] if held else T[i] @ T_found

    with ThreadPoolExecutor(num_threads()) as pool:
        new = np.stack(list(pool.map(found, range(len(T)))))
    return replace(trajectory, T_world_lidar=T[0] @ poses.inverse(new[0]) @ new)


def _around(trajectory: Trajectory, i: int) -> list[int]:
    """The sweeps before and after, without the sweep itself."""
    near = np.flatnonzero(abs(trajectory.stamp_ns - trajectory.stamp_ns[i]) <= _AROUND_NS)
    stride = max(1, round((len(near) - 1) / _NUM_AROUND))
    return [int(j) for j in near if j != i and (j - i) % stride == 0]
