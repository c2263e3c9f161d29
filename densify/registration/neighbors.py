# SPDX-License-Identifier: MIT
"""Poses by all neighbours: each sweep laid on those before and after it.

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
from densify.registration.alignment import Surface, lay_on_planes, subsample
from densify.registration.deskew import deskew
from densify.registration.odometry import is_plausible
from densify.types import Float, Int, Sweep, Trajectory

_STEP_NS = 100_000_000  # of sweeps that follow faster every second one is asked, third, ...
_NUM_POINTS = 15_000  # of a sweep
_VOXEL_M = 0.25
_MATCH_M = 0.3  # moving objects come farther between two sweeps
_MOST_M = 0.1  # that a sweep moves; farther off, wrong partners are as near as right ones
_HOLD = 0.01  # along highways one plane in fifty tells


def refine(
    sweeps: Sequence[Sweep], trajectory: Trajectory, around_ns: int, settings: RegisterSettings
) -> Trajectory:
    """The trajectory with every pose laid on the neighbours as they were placed by it.

    sweeps: raw, of all its frames. around_ns: how far before and after a sweep its neighbours are;
    the fewer points they hold, the more of them are needed. Sweeps of which less than
    ``settings.min_overlap`` lies on their neighbours, or that would move by more than 0.1 m, keep
    their pose; all do if the vehicle would move as none does. The first one stays.
    """
    T = trajectory.T_world_lidar
    chosen = [subsample(sweep, _NUM_POINTS) for sweep in sweeps]
    points = [s.sweep.points for s in deskew(chosen, trajectory).sweeps]

    def found(i: int) -> Float:
        around = _around(trajectory.stamp_ns, i, around_ns)
        if not around:
            return T[i]
        T_own_world = poses.inverse(T[i])
        parts = [poses.transform(T_own_world @ T[j], points[j]) for j in around]
        target = Surface.of(np.concatenate(parts), _VOXEL_M)
        T_found, overlap = lay_on_planes(target, points[i], _VOXEL_M, _MATCH_M, _HOLD)
        held = overlap < settings.min_overlap or np.linalg.norm(T_found[:3, 3]) > _MOST_M
        return T[i] if held else T[i] @ T_found

    with ThreadPoolExecutor(num_threads()) as pool:
        new = np.stack(list(pool.map(found, range(len(T)))))
    laid = replace(trajectory, T_world_lidar=T[0] @ poses.inverse(new[0]) @ new)
    return laid if is_plausible(laid, settings) else trajectory


def _around(stamp_ns: Int, i: int, around_ns: int) -> list[int]:
    """The sweeps before and after, without the sweep itself."""
    near = np.flatnonzero(abs(stamp_ns - stamp_ns[i]) <= around_ns)
    stride = max(1, round((len(near) - 1) * _STEP_NS / (2 * around_ns)))
    return [int(j) for j in near if j != i and (j - i) % stride == 0]
