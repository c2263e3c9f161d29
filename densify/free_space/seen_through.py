# SPDX-License-Identifier: MIT
"""Find free-space violations: the points of one sweep that other sweeps saw through."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from densify.free_space.range_image import MIN_FILLED, RangeImage
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import num_threads
from densify.geometry.types import Bool, Float, Stretch

REACH_S = 1.0
"""Greatest time between a sweep and the sweeps that are tested against its points."""
FREE_MARGIN = 0.4, 0.015
"""Least distance of a return beyond a seen-through point: the larger of metres, share of range."""


@dataclass(frozen=True)
class FreeSpace:
    """The free space that each of the W sweeps of a window observed."""

    images: tuple[RangeImage, ...]  # W range images
    T_lidar_world: tuple[Float, ...]  # W transforms (4,4) at the reference times
    clock: Clock  # reference times of the sweeps
    sensors: Sensors  # scanners, with the angles between their rays
    # Indices of consecutive sweeps that are tested together, see `Clock.batches`
    batches: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(stretch: Stretch) -> FreeSpace:
        """Return the free space of a window of sweeps."""
        clock = Clock.of(stretch)
        batches = clock.batches()
        image = partial(RangeImage.of, num_together=max(map(len, batches)), by_ring=True)
        with ThreadPoolExecutor(num_threads()) as pool:
            images = tuple(pool.map(image, stretch.sweeps))
        T_lidar_world = tuple(
            poses.inverse(registered.T_world_lidar) for registered in stretch.sweeps
        )
        return FreeSpace(images, T_lidar_world, clock, Sensors.of(stretch.sweeps), batches)

    def gap_m(self, position: Float, i: int) -> float:
        """Return the metres between neighbouring rings of sweep i at a (3,) world position."""
        position_lidar = poses.transform(self.T_lidar_world[i], position[None])
        return float(self.sensors.finest_gap_m(position_lidar)[0])

    def others(self, i: int) -> list[int]:
        """Return the index of a sweep of each other batch within `REACH_S` of sweep i."""
        return [
            batch[0]
            for batch in self.batches
            if i not in batch and any(self.clock.near(i, j, REACH_S) for j in batch)
        ]

    @cached_property
    def _batch_of(self) -> dict[int, tuple[int, ...]]:
        """Indices of the sweeps in the same batch, by index of the sweep."""
        return {j: batch for batch in self.batches for j in batch}

    def seen_through(self, points: Float, j: int, velocity_m_s: Float | None = None) -> Bool:
        """Return (N,) True where the batch of sweep j certainly observed free space.

        Every return near the direction of the point must be clearly farther away, in all sweeps of
        the batch. Together the sweeps must have enough returns there.

        Args:
            points: (N,3) positions in the world frame at the reference time of sweep j.
            velocity_m_s: (N,3) velocities in the world frame, None for static points.
        """
        batch = self._batch_of[j]
        # In a single sweep the image counts only full neighbourhoods; of several, the sum decides.
        min_filled = MIN_FILLED if len(batch) == 1 else 1
        counts = []  # one (S,N) array for each sweep of the batch
        for k in batch:
            T_lidar_world = self.T_lidar_world[k]
            points_k = points
            velocity_lidar = None
            if velocity_m_s is not None:
                velocity_lidar = poses.rotate(T_lidar_world, velocity_m_s)
                if k != j:
                    duration_s = self.clock.time_s[k] - self.clock.time_s[j]
                    points_k = points + duration_s * velocity_m_s
            points_lidar = poses.transform(T_lidar_world, points_k)
            image = self.images[k]
            counts.append(image.count_beyond(points_lidar, FREE_MARGIN, min_filled, velocity_lidar))
        # A sweep that lacks a scanner has fewer images: its counts cannot be added to the others.
        addable = [count for count in counts if len(count) == len(counts[0])]
        is_free: Bool = (np.sum(addable, axis=0) >= MIN_FILLED).any(axis=0)
        return is_free
