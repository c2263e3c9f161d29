# SPDX-License-Identifier: MIT
"""Which points cannot belong to the static world: other sweeps saw through where they were."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from densify.flow.tracking.radial import Radial
from densify.free_space.height_map import HeightMap
from densify.free_space.range_image import RangeImage
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock, num_in_look
from densify.geometry.clouds import Strips
from densify.geometry.linking import close_to_seeds, link
from densify.geometry.types import Bool, Float, Int, RegisteredSweep, Stretch

_MARGIN_M = 0.4
_MARGIN_FRACTION = 0.015
_MIN_FILLED = 6  # of the 3 x 3 cells around a direction
_NEAR_M = 0.4
_MIN_SEED_SHARE = 0.3
LINK_M = 0.6
_RING_GAP_M = 0.35
REACH_S = 1.0
"""Sweeps up to so long before and after one tell about it: from where others were taken, little of
what it saw is in view."""
_MOST_ASKED = 10  # of them on each side: more in the same time cost more and tell the same


def range_images(sweeps: Sequence[RegisteredSweep], num_together: int) -> list[RangeImage]:
    """What sweeps saw, ring by ring too where that is safe. num_together: as many are asked
    together, see `densify.geometry.clock.num_in_look`."""
    image = partial(RangeImage.of, num_together=num_together, by_ring=True)
    with ThreadPoolExecutor() as pool:
        return list(pool.map(image, sweeps))


@dataclass(frozen=True)
class FreeSpace:
    """What each sweep of a stretch saw through.

    T_lidar_world: (4,4) per sweep. clock: when they were taken. sensors: how far apart their rays
    are. looks: the sweeps that are asked together, see `Clock.looks`.
    """

    images: tuple[RangeImage, ...]
    T_lidar_world: tuple[Float, ...]
    clock: Clock
    sensors: Sensors
    looks: tuple[tuple[int, ...], ...]

    @staticmethod
    def of(stretch: Stretch, images: Sequence[RangeImage] | None = None) -> FreeSpace:
        """images: of the sweeps, where they are known, as `range_images` makes them."""
        clock = Clock.of(stretch)
        looks = clock.looks()
        if images is None:
            images = range_images(stretch.sweeps, num_in_look(clock.period_ns * 1e-9))
        return FreeSpace(
            tuple(images),
            tuple(poses.inverse(s.T_world_lidar) for s in stretch.sweeps),
            clock,
            Sensors.of(stretch.sweeps),
            looks,
        )

    def __len__(self) -> int:
        return len(self.images)

    def gap_m(self, place: Float, i: int) -> float:
        """Metres between neighbouring rings at a place (3,), world, as sweep number i saw it."""
        in_lidar = poses.transform(self.T_lidar_world[i], place[None])
        return float(self.sensors.finest_gap_m(in_lidar)[0])

    def others(self, i: int) -> list[int]:
        """The looks around sweep number i that tell about it, by their first sweeps; its own does
        not."""
        most = _MOST_ASKED * max(map(len, self.looks))
        around = self.clock.around(i, REACH_S, most)
        return sorted({self._look_of[j][0] for j in around} - {self._look_of[i][0]})

    @cached_property
    def _look_of(self) -> dict[int, tuple[int, ...]]:
        return {j: look for look in self.looks for j in look}

    def seen_through(self, points: Float, j: int, velocity_m_s: Float | None = None) -> Bool:
        """(N,3) world -> (N,) True where the look with sweep number j certainly saw free space:
        none of its sweeps saw anything there, and all together looked there closely.

        points: at the sweep's reference time. velocity_m_s: (N,3) of those that move.
        """
        look, told = self._look_of[j], []
        for k in look:
            there, T_lidar_world = points, self.T_lidar_world[k]
            if velocity_m_s is not None and k != j:
                there = points + (self.clock.time_s[k] - self.clock.time_s[j]) * velocity_m_s
            told.append(
                self.images[k].num_beyond(
                    poses.transform(T_lidar_world, there),
                    (_MARGIN_M, _MARGIN_FRACTION),
                    _MIN_FILLED if len(look) == 1 else 1,
                    None if velocity_m_s is None else poses.rotate(T_lidar_world, velocity_m_s),
                )
            )
        together = [t for t in told if len(t) == len(told[0])]  # images of the same scanners
        free: Bool = (np.sum(together, axis=0) >= _MIN_FILLED).any(axis=0)
        return free


@dataclass(frozen=True)
class Candidates:
    """What a `Standing` says of its sweep's rows, wherever the world's origin is."""

    row: Int
    seed: Bool
    cluster: Int
    num_clusters: int


@dataclass(frozen=True)
class Standing:
    """The points of one sweep that stand above the ground, and what the others say of them.

    row: (C,) index into the sweep's points. points: (C,3) world, rigidly registered.
    time_s: (C,) when each was measured, since the first sweep's reference time.
    seed: (C,) some other sweep sees through the point, or its radial velocity is none of what
    stands. cluster: (C,) label of ``num_clusters`` groups of candidates (seeds and what is close to
    them), -1 of points that are none. radial: None where no scanner measures it.
    """

    row: Int
    points: Float
    time_s: Float
    seed: Bool
    cluster: Int
    num_clusters: int
    radial: Radial | None = None

    @staticmethod
    def of(stretch: Stretch, i: int, found: Candidates) -> Standing:
        """Place the candidates of sweep number i in the world."""
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points[found.row])
        radial = Radial.of(registered)
        return Standing(
            row=found.row,
            points=points,
            time_s=firing_times_s(stretch, i, found.row),
            seed=found.seed,
            cluster=found.cluster,
            num_clusters=found.num_clusters,
            radial=None if radial is None else radial.rows(found.row),
        )

    @property
    def candidate(self) -> Bool:
        return self.cluster >= 0

    @cached_property
    def strips(self) -> Strips:
        """The points, to be found by boxes."""
        return Strips(self.points)


def find_candidates(
    stretch: Stretch,
    space: FreeSpace,
    ground: HeightMap,
    min_height_m: float,
    among: Sequence[int] | None = None,
) -> tuple[Candidates, ...]:
    """What stands in every sweep, and which of it may move.

    A point is a seed where any other sweep around sees through it; points close to a seed are
    candidates too, since a mover's own points are not all seen through. Points beside these whose
    measured radial velocity says that they move are candidates of their own.
    min_height_m: points lower above the ground do not stand. among: numbers of the sweeps to look
    at, all if None.
    """

    def of_sweep(i: int) -> Candidates:
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        above = np.flatnonzero(ground.above(points) >= min_height_m)
        points = points[above]
        seed = np.zeros(len(above), bool)
        for j in space.others(i):
            rest = np.flatnonzero(~seed)
            seed[rest] = space.seen_through(points[rest], j)
        gap_m = space.sensors.gap_m(registered.sweep.points[above], registered.sweep.lidar[above])
        over_scanner = points - registered.T_world_lidar[:3, 3]
        close = closer_rings(over_scanner, gap_m)
        num_clusters, cluster = cluster_around(close, seed)
        radial = Radial.of(registered)
        if radial is not None:
            fast = np.flatnonzero(radial.moving()[above] & (cluster < 0))
            num_more, more = link(close[fast], LINK_M)
            seed[fast], cluster[fast] = True, num_clusters + more
            num_clusters += num_more
        return Candidates(above, seed, cluster, num_clusters)

    with ThreadPoolExecutor() as pool:
        return tuple(pool.map(of_sweep, range(len(stretch.sweeps)) if among is None else among))


def closer_rings(points: Float, gap_m: Float) -> Float:
    """The points with heights compressed where the scanner's rings lie farther apart than what is
    taken for one thing.

    points: from where the scanner stands, z up. Measured from anywhere else a level surface would
    not stay one, for the compression grows with the range.
    """
    squeezed = points.copy()
    squeezed[:, 2] *= height_weight(gap_m)
    return squeezed


def height_weight(gap_m: float | Float) -> Float:
    """How much heights count where rings lie so far apart, 1 at most."""
    return np.minimum(1.0, _RING_GAP_M / np.maximum(gap_m, 1e-6))


def firing_times_s(stretch: Stretch, i: int, rows: Int) -> Float:
    """(N,) when each of some points of sweep number i was measured, since the first reference
    time."""
    sweep = stretch.sweeps[i].sweep
    offset_ns = np.zeros(len(rows), np.int64) if sweep.offset_ns is None else sweep.offset_ns[rows]
    begin_ns = stretch.sweeps[0].sweep.stamp_ns
    return (sweep.stamp_ns - begin_ns + offset_ns).astype(np.float64) * 1e-9


def cluster_around(points: Float, seed: Bool) -> tuple[int, Int]:
    """Keep the seeds that are not alone among unseen points (a hedge's flicker is), add what is
    close to them, and link. Returns the number of clusters and (N,) labels."""
    cluster = np.full(len(points), -1, np.int64)
    near = np.flatnonzero(close_to_seeds(points, seed, _NEAR_M, _MIN_SEED_SHARE))
    num_clusters, cluster[near] = link(points[near], LINK_M)
    return num_clusters, cluster
