# SPDX-License-Identifier: MIT
"""The extent of tracked objects: which points of each sweep belong to which object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.flow.tracking.candidates import LINK_M, Obstacles, Strips, firing_times_s
from densify.flow.tracking.objects import LANE_M, MovingObject, Shape, Track, near_m
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.linking import close_to_seeds
from densify.geometry.nearest import is_near, nearest, nearest_k, tree_of
from densify.geometry.types import Bool, Float, Float32, Int, Stretch

Instance = NDArray[np.int32]

_REACH = 1.5  # of candidates, in distances up to which other points count as neighbours
_LEAST_HEIGHT_M, _LEAST_HEIGHT_OF_WALKERS_M, _AS_LOW_AS_ROAD_M = 0.08, 0.1, 0.15
_WALKS_M_S = 2.0
_LEAST_SEEDS, _WALKER_M = 0.1, 1.5
_WIDER_M, _MOSTLY = 0.5, 0.5  # so many of the points so close must move too
_ALONE_GAPS, _NUM_BESIDE = 2.0, 2
NUM_COLUMNS = 2.0
"""Columns of rays in a gap along a side that falls away from the scanner."""
_LONGEST_HOLE_M = 2.0
_MAX_VIOLATIONS = 0.05
_PREDICTED_S = 0.2  # before the first and after the last observation


@dataclass(frozen=True)
class SweepPoints:
    """The N points of a sweep, or of a batch, that may belong to an object.

    Attributes:
        row: (N,) in the sweep.
        points: (N,3) world.
        time_s: (N,) firing time.
        height_m: (N,) above the ground.
        gap_m: (N,) between neighbouring rings there.
        reach_m: (N,) greatest distance from an object's shape.
    """

    row: Int
    points: Float
    time_s: Float
    height_m: Float32
    gap_m: Float
    reach_m: Float

    @staticmethod
    def of(
        stretch: Stretch, i: int, ground: HeightMap, obstacles: Obstacles, sensors: Sensors
    ) -> SweepPoints:
        """Return the points of sweep i that are not too low."""
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m > _LEAST_HEIGHT_M)
        gap_m = sensors.gap_m(registered.sweep.points[row], registered.sweep.lidar[row])
        candidate = np.zeros(len(points), bool)
        candidate[obstacles.row[obstacles.candidate]] = True
        reach_m = np.where(candidate[row], _REACH, 1.0) * near_m(gap_m)
        time_s = firing_times_s(stretch, i, row)
        return SweepPoints(row, points[row], time_s, height_m[row], gap_m, reach_m)

    @staticmethod
    def together(parts: Sequence[SweepPoints]) -> SweepPoints:
        """Return the points of the sweeps of one batch, sweep by sweep."""
        columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SweepPoints))
        return SweepPoints(*columns)

    @cached_property
    def strips(self) -> Strips:
        """Return the points, ready to be searched."""
        return Strips(self.points)


def find_shape(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Shape:
    """Return the shape of all points of a track; those of a walker without their surroundings.

    Echoes that merged with those of a wall occur in even or in odd sweeps only. The points of a
    bush are static, or lie among static points. Hardly any sweep sees through a wall itself, but
    slow cars have such sides too: only objects shorter than 1.5 m are cut.
    """
    sweeps = sorted(track.claimed)
    parts = {j: track.points_in(obstacles, [j]) for j in sweeps}
    points = np.concatenate(list(parts.values()))
    if _speed_m_s(track, sweeps[len(sweeps) // 2], space.clock) > _WALKS_M_S:
        return Shape.of(points)
    within_m = near_m(space.gap_m(track.centre, sweeps[0]))
    of = np.repeat(np.arange(len(sweeps)), [len(part) for part in parts.values()])
    again = np.zeros(len(points), bool)
    for odd in (False, True):
        mine = of % 2 == odd
        if not mine.all():
            tree = tree_of(points[~mine])
            again[mine] = is_near(tree, points[mine], _REACH * within_m)
    moves = ~_is_static(track, obstacles, parts, of, within_m)
    again &= moves & close_to_seeds(points, moves, _WIDER_M, _MOSTLY)
    seed = np.concatenate([obstacles[j].seed[track.claimed[j]] for j in sweeps])
    own = again & close_to_seeds(points, seed, _REACH * within_m, _LEAST_SEEDS)
    if own.any() and np.linalg.norm(np.ptp(points[own, :2], axis=0)) < _WALKER_M:
        return Shape.of(points[own])
    return Shape.of(points[again] if again.any() else points)


def _is_static(
    track: Track, obstacles: Sequence[Obstacles], parts: dict[int, Float], of: Int, reach_m: float
) -> Bool:
    """Return (N,) True for points whose measured positions are more often occupied than moved ones.

    Other sweeps decide: at a static point they have more returns at its measured position than at
    the position that it would have moved to.

    Args:
        track: The object.
        obstacles: Of all sweeps.
        parts: By sweep, in the object's own frame, N points in all.
        of: (N,) number of the point's sweep.
        reach_m: Greatest distance from a position to a return that occupies it.
    """
    in_object = np.concatenate(list(parts.values()))
    places = np.concatenate([obstacles[j].points[track.claimed[j]] for j in parts])
    low, high = places.min(0) - reach_m, places.max(0) + reach_m
    static, moved = np.zeros((2, len(places)), np.int64)
    for number, (j, own) in enumerate(parts.items()):
        others, c = of != number, obstacles[j]
        there = c.points[c.strips.rows_inside(low, high)]
        for num, asked, among in ((static, places, there), (moved, in_object, own)):
            if len(among):
                num[others] += is_near(tree_of(among), asked[others], reach_m)
    return np.asarray(static > moved)


def assign_points(
    batch: Sequence[int],
    stretch: Stretch,
    ground: HeightMap,
    objects: Sequence[MovingObject],
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
) -> list[Instance]:
    """Return for each sweep of a batch (N,) the object of each of its points, -1 for none.

    Args:
        obstacles: Of all sweeps of the stretch.
    """
    parts = [SweepPoints.of(stretch, i, ground, obstacles[i], space.sensors) for i in batch]
    attached = []
    for i, points in zip(batch, parts, strict=True):
        attached.append(attach(points, i, objects, space.clock))
    joined = np.concatenate(attached)
    lengthen(joined, SweepPoints.together(parts), batch[0], objects, space)
    attached = np.split(joined, np.cumsum([len(mine) for mine in attached])[:-1])
    instances = []
    for i, points, mine in zip(batch, parts, attached, strict=True):
        leave_out_isolated(mine, points, i, objects, space.clock)
        instance = np.full(len(stretch.sweeps[i].sweep), -1, np.int32)
        instance[points.row] = mine
        instances.append(instance)
    return instances


def attach(seen: SweepPoints, i: int, objects: Sequence[MovingObject], clock: Clock) -> Instance:
    """Return (N,) the object of each point of sweep i, -1 for none.

    A point belongs to an object if it is close to the object's accumulated points, or lies within
    their outline. The ground below a walker does not.
    """
    instance = np.full(len(seen.points), -1, np.int32)
    least_m = np.full(len(seen.points), np.inf)
    for k, (track, shape) in enumerate(objects):
        if not is_known_at(track, i, clock):
            continue
        rim = track.place(shape.rim, track.seen_at(clock.time_ns[i]))
        low, high = rim.min(0) - LINK_M, rim.max(0) + LINK_M
        low[2] = -np.inf  # wheels
        rows = seen.strips.rows_inside(low, high)
        if not len(rows):
            continue
        in_object = track.undo(seen.points[rows], seen.time_s[rows])
        distance_m, _ = nearest(shape.tree, in_object)
        belongs = (distance_m < seen.reach_m[rows]) & (seen.height_m[rows] >= ABOVE_GROUND_M)
        belongs |= shape.within_outline(in_object)
        if _speed_m_s(track, i, clock) <= _WALKS_M_S:
            belongs &= seen.height_m[rows] >= _LEAST_HEIGHT_OF_WALKERS_M
        closer = belongs & (distance_m < least_m[rows])
        instance[rows[closer]] = k
        least_m[rows[closer]] = distance_m[closer]
    return instance


def leave_out_isolated(
    instance: Instance, seen: SweepPoints, i: int, objects: Sequence[MovingObject], clock: Clock
) -> None:
    """Take isolated points from the objects, in place, where they are low or the object walks.

    They are echoes merged with those of a wall, or the road behind an edge.
    """
    low = seen.height_m < _AS_LOW_AS_ROAD_M
    for k in np.unique(instance[instance >= 0]):
        mine = np.flatnonzero(instance == k)
        doubtful = mine
        if _speed_m_s(objects[k].track, i, clock) > _WALKS_M_S:
            doubtful = mine[low[mine]]
        if len(mine) <= _NUM_BESIDE or not len(doubtful):
            continue
        away_m, _ = nearest_k(tree_of(seen.points[mine]), seen.points[doubtful], 1 + _NUM_BESIDE)
        instance[doubtful[away_m[:, -1] > _ALONE_GAPS * seen.gap_m[doubtful]]] = -1


def lengthen(
    instance: Instance,
    seen: SweepPoints,
    i: int,
    objects: Sequence[MovingObject],
    space: FreeSpace,
) -> None:
    """Extend vehicles along their heading, as wide and as high as they are, without a gap.

    No sweep sees through the middle of a long side that slides along itself. The extension ends
    where another sweep sees through the moved points.
    """
    for k, (track, shape) in enumerate(objects):
        mine = np.flatnonzero(instance == k)
        if not len(mine) or _speed_m_s(track, i, space.clock) <= _WALKS_M_S:
            continue
        at_s = track.seen_at(space.clock.time_ns[i])
        lane = MovingObject(track, shape).lane(at_s)
        middle = track.place(shape.points.mean(0, keepdims=True), at_s)[0]
        reach = np.array([1.5 * LANE_M, 1.5 * LANE_M, np.inf])
        rows = seen.strips.rows_inside(middle - reach, middle + reach)
        rows = rows[instance[rows] < 0]
        at_once = track.carry(seen.points[rows], seen.time_s[rows], at_s)
        fits = lane.holds(at_once)
        rows, along = rows[fits], at_once[fits, :2] @ lane.ahead
        own = track.carry(seen.points[mine], seen.time_s[mine], at_s)[:, :2] @ lane.ahead
        columns_m = columns_apart_m(middle, lane.ahead, space.T_lidar_world[i], space.sensors)
        hole_m = float(np.clip(NUM_COLUMNS * columns_m, LINK_M, _LONGEST_HOLE_M))
        linked = _is_linked(along, own, hole_m)
        if linked.any():
            rows, along = rows[linked], along[linked] - np.median(own)
            instance[rows[_is_free_of_violations(track, seen, rows, along, i, space)]] = k


def columns_apart_m(place: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """Return the distance along a side between the columns of rays that hit it.

    Args:
        place: (3,) on the side, world.
        ahead: (2,) unit vector along it.
        T_lidar_world: (4,4).
    """
    in_lidar = poses.transform(T_lidar_world, place[None])[0, :2]
    x, y = T_lidar_world[:2, :2] @ ahead
    aside_m = max(abs(float(in_lidar @ [-y, x])), 1e-3)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    return column_rad * float(in_lidar @ in_lidar) / aside_m


def _is_linked(along: Float, own: Float, hole_m: float) -> Bool:
    """Return (N,) True for the positions that reach (M,) ``own`` by steps of up to ``hole_m``."""
    everything = np.concatenate([along, own])
    order = np.argsort(everything, kind="stable")
    run = np.zeros(len(everything), np.int64)
    run[order[1:]] = np.cumsum(np.diff(everything[order]) > hole_m)
    return np.isin(run[: len(along)], run[len(along) :])


def _is_free_of_violations(
    track: Track, seen: SweepPoints, rows: Int, along: Float, i: int, space: FreeSpace
) -> Bool:
    """Return (N,) True for the points that no other sweep contradicts, from the middle outwards.

    Ahead and behind, the points end where another sweep sees through too many of the moved points.

    Args:
        track: The object.
        seen: Points of the batch.
        rows: (N,) of ``seen``.
        along: (N,) metres ahead of the middle.
        i: Sweep of the points.
        space: The free space that the sweeps observed.
    """
    step = np.floor(np.abs(along) / LINK_M).astype(np.int64)
    num_steps = int(step.max(initial=0)) + 1
    step += num_steps * (along < 0)  # those ahead, then those behind

    def up_to(steps: Int) -> Int:
        return np.bincount(steps, minlength=2 * num_steps).reshape(2, num_steps).cumsum(axis=1)

    ends = np.zeros((2, num_steps), bool)
    in_object = track.undo(seen.points[rows], seen.time_s[rows])
    for j in space.others(i):
        violations = up_to(step[track.seen_through(in_object, j, space)])
        ends |= violations > _MAX_VIOLATIONS * up_to(step)
    kept: Bool = ~np.logical_or.accumulate(ends, axis=1).ravel()[step]
    return kept


def is_known_at(track: Track, i: int, clock: Clock) -> bool:
    """Return True if sweep i is among those that observed the object, or at most 0.2 s away."""
    first, last = min(track.claimed), max(track.claimed)
    return first <= i <= last or any(clock.near(i, end, _PREDICTED_S) for end in (first, last))


def _speed_m_s(track: Track, i: int, clock: Clock) -> float:
    """Return the speed at sweep i."""
    return float(np.linalg.norm(track.path.rate(track.seen_at(clock.time_ns[i]))[:2]))
