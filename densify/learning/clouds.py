# SPDX-License-Identifier: MIT
"""The input of a network: the points of sweeps above the ground, with the ego motion undone.

Training and inference share this code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int, RegisteredSweep


class NetworkCloud(NamedTuple):
    """One sweep of n points.

    points: (n,3) float32 metres, world axes (z up) about the scanner at the time of the *source*
    sweep. height_m: (n,) float32 above the ground.
    """

    points: Tensor
    height_m: Tensor


class AboveGround(NamedTuple):
    """The points of a sweep above the ground.

    row: (n,) in the sweep. points: (n,3) metres, world. height_m: (n,) above the ground.
    """

    row: Int
    points: Float
    height_m: Float32

    @staticmethod
    def of(registered: RegisteredSweep, ground: HeightMap, row: Int | None = None) -> AboveGround:
        """Select the points above the ground, or those of the rows (n,)."""
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m >= ABOVE_GROUND_M) if row is None else row
        return AboveGround(row, points[row], height_m[row])

    def cloud(self, origin: Float) -> NetworkCloud:
        """Return the input of a network, about the origin (3,)."""
        points = torch.from_numpy((self.points - origin).astype(np.float32))
        return NetworkCloud(points, torch.from_numpy(np.ascontiguousarray(self.height_m)))


def order_for(source: int, target: int, num_sweeps: int, num_wanted: int) -> list[int | None]:
    """Return the numbers of the sweeps that a network gets for the flow from source to target.

    Source and target come first, then the sweeps before the source in that direction of time; None
    beyond the first and the last sweep.
    """
    step = source - target
    wanted = [source, target, *(source + step * n for n in range(1, num_wanted - 1))]
    return [n if 0 <= n < num_sweeps else None for n in wanted]


Sweeps = Sequence[NetworkCloud | None]
"""Source, target, and any number of sweeps before the source; None where there is none."""
