# SPDX-License-Identifier: MIT
"""Scene flow of sweeps, and how everything in a stretch moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float
from densify.geometry.types.sweeps import Stretch


@dataclass(frozen=True)
class FlowField:
    """Scene flow of one sweep's (or point file's) N points to another time, ego-motion removed.

    From the sweep's reference time: a moving point that was measured earlier or later is first
    brought there by ``to_reference``.

    displacement: (N,3) metres, in the coordinates the points are in; exactly 0 where not moving.
    moving: (N,) bool, proven to move.
    instance: (N,) int32, the moving object the point belongs to, -1 none.
    lost: (N,) bool, belongs to something that moves but cannot be followed to the target time.
    to_reference: (N,3) metres, own motion between a point's firing and the sweep's reference time,
        in the same coordinates; None where nothing is known of it.
    velocity_m_s: (N,3) at the target time, in the same coordinates; None where nothing is known.
    """

    displacement: Float
    moving: Bool
    instance: NDArray[np.int32]
    lost: Bool
    to_reference: Float | None = None
    velocity_m_s: Float | None = None

    @property
    def total(self) -> Float:
        """(N,3) from where a point was measured to where it is at the target time."""
        if self.to_reference is None:
            return self.displacement
        return self.to_reference + self.displacement

    @staticmethod
    def zero(num_points: int) -> FlowField:
        """Nothing moves."""
        return FlowField(
            displacement=np.zeros((num_points, 3)),
            moving=np.zeros(num_points, bool),
            instance=np.full(num_points, -1, np.int32),
            lost=np.zeros(num_points, bool),
        )


class Motion(Protocol):
    """How everything in a stretch moves, whatever found it out."""

    def flow(self, frame: int, target: int) -> FlowField:
        """Flow of every point of a sweep to another sweep's reference time; both by frame
        number."""
        ...


@dataclass(frozen=True)
class StretchFlow:
    """Flow between neighbouring sweeps of a stretch, by (frame, target frame)."""

    stretch: Stretch
    steps: Mapping[tuple[int, int], FlowField]

    @staticmethod
    def towards(key: int, stretch: Stretch, motion: Motion) -> StretchFlow:
        """Flow of every sweep to the next one on the way to the key, and of the key to a
        neighbour."""
        before = [f for f in stretch.frames if f <= key]
        after = [f for f in reversed(stretch.frames) if f >= key]
        hops = [*pairwise(before), *pairwise(after)]
        if len(stretch.frames) > 1:
            hops.append((key, after[-2] if len(after) > 1 else before[-2]))
        return StretchFlow(stretch, {hop: motion.flow(*hop) for hop in hops})
