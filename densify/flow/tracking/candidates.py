# SPDX-License-Identifier: MIT
"""Find candidates: the points that may move, because other sweeps saw through them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.free_space.range_image import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import num_threads
from densify.geometry.nearest import close_to_seeds, link
from densify.geometry.types import Bool, Float, Int, RegisteredSweep, Stretch

LINK_M = 0.6  # candidates closer to each other are one cluster
MIN_SEED_SHARE = 0.4  # least share of seeds around a seed, and in a cluster that starts a track
_RING_GAP_M = 0.35  # greatest distance between rings that are linked
_STRIP = 32  # number of consecutive points in a strip

T = TypeVar("T", bound=np.generic)


class Strips:
    """Index that finds points in a box; fast because neighbours in scan order lie close."""

    def __init__(self, points: Float) -> None:
        """Index the points (N,3, metres), given in scan order."""
        # Bounds (3,S) and points (S,3,32) of the strips, laid out so that comparisons run along
        # contiguous memory
        begins = np.arange(0, len(points), _STRIP)
        self._low = np.ascontiguousarray(np.minimum.reduceat(points, begins).T)
        self._high = np.ascontiguousarray(np.maximum.reduceat(points, begins).T)
        padded = np.full((len(begins) * _STRIP, 3), np.inf)  # infinite points are in no box
        padded[: len(points)] = points
        strips = padded.reshape(len(begins), _STRIP, 3)
        self._strips = np.ascontiguousarray(strips.transpose(0, 2, 1))

    def rows_inside(self, low: Float, high: Float) -> Int:
        """Return the ascending indices of the points in a box with corners low and high (3,)."""
        # Only strips whose bounds overlap the box can have points in it.
        low, high = low[:, None], high[:, None]
        strip_numbers = np.flatnonzero(((self._low < high) & (self._high > low)).all(axis=0))
        points = self._strips[strip_numbers]
        strip, offset = np.nonzero(((points > low) & (points < high)).all(axis=1))
        return strip_numbers[strip] * _STRIP + offset


@dataclass(frozen=True)
class Obstacles:
    """The C points above the ground (obstacles) in one sweep, or in a `Batch` of sweeps.

    Candidates are the obstacles that may move.
    """

    row: Int  # (C,) index into the sweep's points
    points: Float  # (C,3) world, registered and deskewed for ego-motion only
    time_s: Float  # (C,) firing time since the first sweep's reference time
    seed: Bool  # (C,) True if another sweep saw through the point
    cluster: Int  # (C,) label of the cluster of candidates, -1 for other points
    num_clusters: int  # number of clusters; labels are below it

    @property
    def candidate(self) -> Bool:
        """The (C,) mask of the candidates: seeds and points close to seeds."""
        return self.cluster >= 0

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)


@dataclass(frozen=True)
class Batch:
    """Consecutive sweeps within 0.1 s (one at 10 Hz), merged to search for moving objects."""

    sweeps: tuple[int, ...]  # indices of the sweeps in the stretch
    # Middle between the first and the last reference time, since the stretch's first sweep
    time_ns: int
    half_s: float  # half the time between the first and the last sweep
    obstacles: Obstacles  # obstacles of all sweeps, concatenated; clusters that touch are merged
    begins: tuple[int, ...]  # first row of each sweep in ``obstacles``

    @staticmethod
    def of(sweeps: Sequence[int], obstacles: Sequence[Obstacles], clock: Clock) -> Batch:
        """Build a batch of some ``sweeps``, with the obstacles and clock of the whole stretch."""
        parts = [obstacles[j] for j in sweeps]
        first_ns, last_ns = clock.time_ns[[sweeps[0], sweeps[-1]]].tolist()
        begins = np.cumsum([0] + [len(part.points) for part in parts[:-1]]).tolist()
        return Batch(
            sweeps=tuple(sweeps),
            time_ns=(first_ns + last_ns) // 2,
            half_s=(last_ns - first_ns) * 0.5e-9,
            obstacles=_merge(parts),
            begins=tuple(begins),
        )

    def gather(self, columns: Sequence[NDArray[T]]) -> NDArray[T]:
        """Return the values of the batch's obstacles, from the values (C,...) of every sweep."""
        return np.concatenate([columns[j] for j in self.sweeps])

    def split(self, rows: Int) -> dict[int, Int]:
        """Convert ascending rows of ``obstacles`` to rows by sweep index, without empty sweeps."""
        rows_of_sweeps = np.split(rows, np.searchsorted(rows, self.begins[1:]))
        sweeps = zip(self.sweeps, rows_of_sweeps, self.begins, strict=True)
        return {j: sweep_rows - begin for j, sweep_rows, begin in sweeps if len(sweep_rows)}


def _merge(sweeps: Sequence[Obstacles]) -> Obstacles:
    """Concatenate the obstacles of sweeps; clusters within `LINK_M` of each other become one."""
    if len(sweeps) == 1:
        return sweeps[0]
    # All fields but the last one, ``num_clusters``, are columns.
    row, points, time_s, seed, label = (
        np.concatenate([getattr(sweep, column.name) for sweep in sweeps])
        for column in fields(Obstacles)[:-1]
    )
    # Every sweep counts its clusters from 0. An offset makes the labels unique.
    first_labels = np.cumsum([0] + [sweep.num_clusters for sweep in sweeps])
    candidate = np.flatnonzero(label >= 0)
    label[candidate] += np.repeat(first_labels[:-1], [s.candidate.sum() for s in sweeps])
    # Two clusters are merged if they share a group, which is a set of linked points of all sweeps.
    # The nodes of the graph are clusters, then groups. Each candidate is an edge between its
    # cluster and its group, and the connected components are the merged clusters.
    num_groups, group = link(points[candidate], LINK_M)
    num_nodes = int(first_labels[-1]) + num_groups
    edges = label[candidate], first_labels[-1] + group
    graph = coo_array((np.ones(len(candidate), bool), edges), shape=(num_nodes, num_nodes))
    num_clusters, cluster = connected_components(graph, directed=False)
    label[candidate] = cluster[label[candidate]]
    return Obstacles(row, points, time_s, seed, label, int(num_clusters))


def find_candidates(stretch: Stretch, space: FreeSpace, ground: HeightMap) -> tuple[Obstacles, ...]:
    """Return the obstacles of each sweep in order, with the candidates: obstacles that may move.

    An obstacle is a point above the ground. It is a seed if another sweep saw through it. Obstacles
    close to seeds are candidates too, because usually only a part of a moving object's points is
    seen through.
    """

    def find_in_sweep(i: int) -> Obstacles:
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        rows = np.flatnonzero(ground.above(points) >= ABOVE_GROUND_M)
        points = points[rows]
        seed = np.zeros(len(rows), bool)
        for j in space.others(i):
            unmarked = np.flatnonzero(~seed)  # one sweep that saw through a point is enough
            seed[unmarked] = space.seen_through(points[unmarked], j)
        num_clusters, cluster = cluster_rings(points, rows, seed, registered, space.sensors)
        time_s = firing_times_s(stretch, i, rows)
        return Obstacles(rows, points, time_s, seed, cluster, num_clusters)

    with ThreadPoolExecutor(num_threads()) as pool:
        return tuple(pool.map(find_in_sweep, range(len(stretch.sweeps))))


def cluster_rings(
    points: Float, rows: Int, seed: Bool, registered: RegisteredSweep, sensors: Sensors
) -> tuple[int, Int]:
    """Cluster points (N,3, world) of a sweep around seeds (N,), as `cluster_around` does.

    ``rows`` (N,) are the points' rows in the sweep. Heights are compressed until rings are at most
    0.35 m apart. Otherwise the rings of an object would be too far apart to be linked.

    Returns:
        The number of clusters, and the (N,) labels from 0, -1 for points in no cluster.
    """
    sweep = registered.sweep
    gap_m = sensors.gap_m(sweep.points[rows], sweep.lidar[rows])
    # Relative to the scanner, level surfaces stay level.
    compressed = points - registered.T_world_lidar[:3, 3]
    compressed[:, 2] *= np.minimum(1.0, _RING_GAP_M / np.maximum(gap_m, 1e-6))
    return cluster_around(compressed, seed)


def firing_times_s(stretch: Stretch, i: int, rows: Int) -> Float:
    """Return the firing times (N,) of ``rows`` of sweep i, s since the first reference time."""
    sweep = stretch.sweeps[i].sweep
    offset_ns = np.zeros(len(rows), np.int64) if sweep.offset_ns is None else sweep.offset_ns[rows]
    begin_ns = stretch.sweeps[0].sweep.stamp_ns
    return (sweep.stamp_ns - begin_ns + offset_ns).astype(np.float64) * 1e-9


def cluster_around(points: Float, seed: Bool) -> tuple[int, Int]:
    """Cluster seeds and points (N,3) within 0.4 m of seeds, linked by steps of up to 0.6 m.

    A seed does not count if less than 40 % of the points around it are seeds, as in a hedge.

    Returns:
        The number of clusters, and the (N,) labels from 0, -1 for points in no cluster.
    """
    cluster = np.full(len(points), -1, np.int64)
    rows = np.flatnonzero(close_to_seeds(points, seed, 0.4, MIN_SEED_SHARE))
    num_clusters, cluster[rows] = link(points[rows], LINK_M)
    return num_clusters, cluster
