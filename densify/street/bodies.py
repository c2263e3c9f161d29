# SPDX-License-Identifier: MIT
"""Exact poses of everything in a simulated recording, at every frame's reference time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, SweepTruth


@dataclass(frozen=True)
class Bodies:
    """Poses at the reference times of F frames. T_world_lidar: (F,4,4). T_world_body: (F,B,4,4),
    body 0 the static world. moving: (F,B)."""

    T_world_lidar: Float
    T_world_body: Float
    moving: Bool

    def place(self, frame: int, body: NDArray[np.int32], points: Float) -> Float:
        """(N,) bodies, (N,3) points in their frames -> (N,3) world, at that frame."""
        T_world_body = self.T_world_body[frame][body]
        placed: Float = np.einsum("nij,nj->ni", T_world_body[:, :3, :3], points)
        return placed + T_world_body[:, :3, 3]

    def sweep(
        self, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], points: Float
    ) -> SweepTruth:
        """Truth of a sweep whose points belong to those bodies."""
        T_world_lidar = self.T_world_lidar[frame]
        away = self.place(frame, body, points) - T_world_lidar[:3, 3]
        return SweepTruth(
            T_world_lidar, away @ T_world_lidar[:3, :3], instance, self.moving[frame][body]
        )

    def displacement(
        self, frame: int, target: int, body: NDArray[np.int32], points: Float
    ) -> Float:
        """(N,3) as `densify.geometry.types.Truth.displacement`; exactly 0 in the static world."""
        self.check(target)
        there, here = (self.place(f, body, points) for f in (target, frame))
        return (there - here) @ self.T_world_lidar[frame][:3, :3]

    def check(self, frame: int) -> None:
        """Raises InputError for a frame without poses."""
        if not 0 <= frame < len(self.moving):
            raise InputError(
                f"truth of frame {frame}: not there; poses are known of frames 0 to "
                f"{len(self.moving) - 1}"
            )
