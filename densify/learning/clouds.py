# SPDX-License-Identifier: MIT
"""What a network sees of a sweep: its points above the ground, with the vehicle's motion undone.

The same in training and in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from densify.free_space.height_map import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int, RegisteredSweep


class NetworkCloud(NamedTuple):
    """One sweep of n points. points: (n,3) float32 metres, axes of the world (z up), origin at the
    scanner when it took the *source* sweep. height_m: (n,) float32 above the ground."""

    points: Tensor
    height_m: Tensor

    def rows(self, index: Tensor) -> NetworkCloud:
        return NetworkCloud(self.points[index], self.height_m[index])

    def to(self, device: torch.device) -> NetworkCloud:
        return NetworkCloud(self.points.to(device), self.height_m.to(device))


class AboveGround(NamedTuple):
    """What stands above the ground in one sweep. row: (n,) in the sweep. points: (n,3) world.
    height_m: (n,)."""

    row: Int
    points: Float
    height_m: Float32

    @staticmethod
    def of(registered: RegisteredSweep, ground: HeightMap) -> AboveGround:
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m >= ABOVE_GROUND_M)
        return AboveGround(row, points[row], height_m[row])

    def cloud(self, origin: Float) -> NetworkCloud:
        """As a network takes it, about the origin (3,)."""
        points = torch.from_numpy((self.points - origin).astype(np.float32))
        return NetworkCloud(points, torch.from_numpy(np.ascontiguousarray(self.height_m)))


def order_for(source: int, target: int, num_sweeps: int, num_wanted: int) -> list[int | None]:
    """Numbers of the sweeps that a network gets for the flow of ``source`` to its neighbour
    ``target``: those two, then the ones before the source in that direction of time, None beyond
    the first and the last."""
    step = source - target
    wanted = [source, target, *(source + step * n for n in range(1, num_wanted - 1))]
    return [n if 0 <= n < num_sweeps else None for n in wanted]


Sweeps = Sequence[NetworkCloud | None]
"""Source, target, and any number of sweeps before the source; None where there is none."""
