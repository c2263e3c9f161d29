# SPDX-License-Identifier: MIT
"""Find free-space violations: the points of one sweep that other sweeps saw through."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from densify.free_space.range_image import MIN_FILLED, RangeImage
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock, num_in_batch
from densify.geometry.types import Bool, Float, RegisteredSweep, Stretch

REACH_S = 1.0
"""Sweeps up to this long before and after a sweep are tested against its points."""
_MOST_TESTED = 10  # sweeps on each side; a larger number costs more and finds the same
_MARGIN_M, _MARGIN_FRACTION = 0.4, 0.015  # the larger one; tolerates errors of registration


def range_images(sweeps: Sequence[RegisteredSweep], num_together: int) -> list[RangeImage]:
    """Return the range image of each sweep, with single rings where that is safe.

    Args:
        num_together: Number of sweeps in a batch, see `densify.geometry.clock.num_in_batch`.
    """
    image = partial(RangeImage.of, num_together=num_together, by_ring=True)
    with ThreadPoolExecutor() as pool:
        return list(pool.map(image, sweeps))


@dataclass(frozen=True)
class FreeSpace:
    """The free space that each of W sweeps observed.

    Attributes:
        images: (W,).
        T_lidar_world: (W,) of (4,4).
        clock: Of the sweeps.
        sensors: Angles between rays.
        batches: Sweeps that are tested together, see `Clock.batches`.
    """

    images: tuple[RangeImage, ...]
    T_lidar_world: tuple[Float, ...]
    clock: Clock
    sensors: Sensors
    batches: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(stretch: Stretch, images: Sequence[RangeImage] | None = None) -> FreeSpace:
        """Return the free space of a stretch.

        Args:
            images: Of the sweeps, as in `range_images`; None makes them.
        """
        clock = Clock.of(stretch)
        if images is None:
            images = range_images(stretch.sweeps, num_in_batch(clock.period_ns * 1e-9))
        return FreeSpace(
            tuple(images),
            tuple(poses.inverse(s.T_world_lidar) for s in stretch.sweeps),
            clock,
            Sensors.of(stretch.sweeps),
            clock.batches(),
        )

    def gap_m(self, place: Float, i: int) -> float:
        """Return the metres between neighbouring rings of sweep i at a (3,) position, world."""
        in_lidar = poses.transform(self.T_lidar_world[i], place[None])
        return float(self.sensors.finest_gap_m(in_lidar)[0])

    def others(self, i: int) -> list[int]:
        """Return the first sweeps of the other batches that are tested against sweep i."""
        around = self.clock.around(i, REACH_S, _MOST_TESTED * max(map(len, self.batches)))
        return sorted({self._batch_of[j][0] for j in around} - {self._batch_of[i][0]})

    @cached_property
    def _batch_of(self) -> dict[int, tuple[int, ...]]:
        return {j: batch for batch in self.batches for j in batch}

    def seen_through(self, points: Float, j: int, velocity_m_s: Float | None = None) -> Bool:
        """Return (N,) True where the batch of sweep j certainly observed free space.

        No sweep of the batch may have a return near the direction of the point that is not clearly
        farther away, and all together must have enough returns there.

        Args:
            points: (N,3) world, at the reference time of sweep j.
            velocity_m_s: (N,3) of moving points, world.
        """
        batch, num_beyond = self._batch_of[j], []
        for k in batch:
            there, T_lidar_world = points, self.T_lidar_world[k]
            if velocity_m_s is not None and k != j:
                there = points + (self.clock.time_s[k] - self.clock.time_s[j]) * velocity_m_s
            num_beyond.append(
                self.images[k].num_beyond(
                    poses.transform(T_lidar_world, there),
                    (_MARGIN_M, _MARGIN_FRACTION),
                    MIN_FILLED if len(batch) == 1 else 1,
                    None if velocity_m_s is None else poses.rotate(T_lidar_world, velocity_m_s),
                )
            )
        # Sweeps without this scanner cannot be added to the others.
        together = [num for num in num_beyond if len(num) == len(num_beyond[0])]
        free: Bool = (np.sum(together, axis=0) >= MIN_FILLED).any(axis=0)
        return free
