# SPDX-License-Identifier: MIT
"""Decide which points of each sweep belong to which tracked object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.flow.tracking.candidates import LINK_M, Obstacles, Strips, firing_times_s
from densify.flow.tracking.following import MISSED_S
from densify.flow.tracking.objects import LANE_M, MovingObject, Shape, Track, near_m
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import close_to_seeds, is_near, nearest, tree_of
from densify.geometry.types import Bool, Float, Float32, Int, Stretch

Instance = NDArray[np.int32]

_REACH = 1.5  # of candidates to an object, in neighbour distances (`near_m`)
_LEAST_HEIGHT_M, _LEAST_HEIGHT_OF_WALKERS_M = 0.08, 0.1
_WALKS_M_S = 2.0
_LEAST_SEEDS, _WALKER_M = 0.1, 1.5
_WIDER_M, _MOSTLY = 0.5, 0.5  # least share of moving points within this distance
NUM_COLUMNS = 2.0
"""Columns of rays that may be missing along a side that recedes from the scanner."""
_LONGEST_HOLE_M = 2.0
_MAX_VIOLATIONS = 0.05


@dataclass(frozen=True)
class SweepPoints:
    """The N points of a sweep, or of a batch of sweeps, that may belong to an object."""

    row: Int  # (N,) index into the sweep's points
    points: Float  # (N,3) world
    time_s: Float  # (N,) firing time since the first sweep's reference time
    height_m: Float32  # (N,) height above the ground
    gap_m: Float  # (N,) distance between neighbouring rings at the point
    reach_m: Float  # (N,) greatest distance from the shape of an object that may own the point

    @staticmethod
    def of(
        stretch: Stretch, i: int, ground: HeightMap, obstacles: Obstacles, sensors: Sensors
    ) -> SweepPoints:
        """Return the points of the sweep with index i that are over 0.08 m above the ground."""
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
    def together(batch: Sequence[SweepPoints]) -> SweepPoints:
        """Concatenate the points of the sweeps of one batch, in the order of the sweeps."""
        columns = (np.concatenate([getattr(p, f.name) for p in batch]) for f in fields(SweepPoints))
        return SweepPoints(*columns)

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)


def find_shape(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Shape:
    """Return the accumulated shape of a track; shapes of walkers exclude their surroundings.

    Objects faster than 2 m/s keep all points. Otherwise three kinds of points are dropped. Echoes
    merged with a wall's occur only in even or only in odd sweeps. Points of a bush are static or
    lie among static points. Points of a wall are hardly ever seen through, like sides of slow cars:
    this cut applies only if the rest is shorter than 1.5 m.
    """
    sweeps = sorted(track.claimed)
    clouds = {j: track.in_object(obstacles[j], track.claimed[j]) for j in sweeps}
    points = np.concatenate(list(clouds.values()))
    if _speed_m_s(track, sweeps[len(sweeps) // 2], space.clock) > _WALKS_M_S:
        return Shape.of(points)
    within_m = near_m(space.gap_m(track.centre, sweeps[0]))
    sweep_number = np.repeat(np.arange(len(sweeps)), [len(p) for p in clouds.values()])
    recurs = np.zeros(len(points), bool)
    for is_odd in (False, True):
        same_parity = sweep_number % 2 == is_odd
        if not same_parity.all():
            tree = tree_of(points[~same_parity])
            recurs[same_parity] = is_near(tree, points[same_parity], _REACH * within_m)
    moves = ~_is_static(track, obstacles, clouds, sweep_number, within_m)
    recurs &= moves & close_to_seeds(points, moves, _WIDER_M, _MOSTLY)
    seed = np.concatenate([obstacles[j].seed[track.claimed[j]] for j in sweeps])
    core = recurs & close_to_seeds(points, seed, _REACH * within_m, _LEAST_SEEDS)
    if core.any() and np.linalg.norm(np.ptp(points[core, :2], axis=0)) < _WALKER_M:
        return Shape.of(points[core])
    return Shape.of(points[recurs] if recurs.any() else points)


def _is_static(
    track: Track,
    obstacles: Sequence[Obstacles],
    clouds: dict[int, Float],
    sweep_number: Int,
    reach_m: float,
) -> Bool:
    """Return (N,) True for points that more other sweeps confirm as static than as moved."""
    # clouds: N points by sweep index, object's frame; sweep_number: (N,) rank of each point's sweep
    in_object = np.concatenate(list(clouds.values()))
    measured = np.concatenate([obstacles[j].points[track.claimed[j]] for j in clouds])
    low, high = measured.min(0) - reach_m, measured.max(0) + reach_m
    static, moved = np.zeros((2, len(measured)), np.int64)
    for number, (j, cloud) in enumerate(clouds.items()):
        in_others, c = sweep_number != number, obstacles[j]
        returns = c.points[c.strips.rows_inside(low, high)]
        for num, points, observed in ((static, measured, returns), (moved, in_object, cloud)):
            if len(observed):
                num[in_others] += is_near(tree_of(observed), points[in_others], reach_m)
    return np.asarray(static > moved)


def assign_points(
    batch: Sequence[int],
    stretch: Stretch,
    ground: HeightMap,
    objects: Sequence[MovingObject],
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
) -> list[Instance]:
    """Return, for each sweep of a batch, (N,) the index of each point's object, -1 for none.

    ``batch`` are the indices of its sweeps, ``objects`` the confirmed ones, ``obstacles`` those of
    each sweep of the stretch.
    """
    clouds = [SweepPoints.of(stretch, i, ground, obstacles[i], space.sensors) for i in batch]
    attached = []
    for i, points in zip(batch, clouds, strict=True):
        attached.append(attach(points, i, objects, space.clock))
    joined = np.concatenate(attached)
    lengthen(joined, SweepPoints.together(clouds), batch[0], objects, space)
    attached = np.split(joined, np.cumsum([len(of_point) for of_point in attached])[:-1])
    instances = []
    for i, points, of_point in zip(batch, clouds, attached, strict=True):
        instance = np.full(len(stretch.sweeps[i].sweep), -1, np.int32)
        instance[points.row] = of_point
        instances.append(instance)
    return instances


def attach(seen: SweepPoints, i: int, objects: Sequence[MovingObject], clock: Clock) -> Instance:
    """Return (N,) the index in ``objects`` of the object near each point of ``seen``, -1 for none.

    A point belongs to an object if it is close to the object's accumulated points or within their
    outline. The ground below a walker does not belong to the walker.
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


def lengthen(
    instance: Instance,
    seen: SweepPoints,
    i: int,
    objects: Sequence[MovingObject],
    space: FreeSpace,
) -> None:
    """Extend vehicles along their heading, as wide and as high as they are, in ``instance`` (N,).

    The middle of a long side that slides along itself is never seen through, and lacks candidates.
    The extension ends at a hole, or where another sweep sees through the moved points. i is the
    first sweep of the batch.
    """
    batch_s = np.ptp(seen.time_s) if len(seen.time_s) else 0.0
    for k, (track, shape) in enumerate(objects):
        members = np.flatnonzero(instance == k)
        speed_m_s = _speed_m_s(track, i, space.clock)
        if not len(members) or speed_m_s <= _WALKS_M_S:
            continue
        at_s = track.seen_at(space.clock.time_ns[i])
        lane = MovingObject(track, shape).lane(at_s)
        middle = track.place(shape.points.mean(0, keepdims=True), at_s)[0]
        reach_m = np.array([1.5 * LANE_M, 1.5 * LANE_M, np.inf])
        rows = seen.strips.rows_inside(middle - reach_m, middle + reach_m)
        rows = rows[instance[rows] < 0]
        rows = rows[lane.holds(seen.points[rows], speed_m_s * batch_s)]
        at_once = track.carry(seen.points[rows], seen.time_s[rows], at_s)
        fits = lane.holds(at_once)
        rows, along = rows[fits], at_once[fits, :2] @ lane.ahead
        members_m = (
            track.carry(seen.points[members], seen.time_s[members], at_s)[:, :2] @ lane.ahead
        )
        columns_m = columns_apart_m(middle, lane.ahead, space.T_lidar_world[i], space.sensors)
        hole_m = float(np.clip(NUM_COLUMNS * columns_m, LINK_M, _LONGEST_HOLE_M))
        linked = _is_linked(along, members_m, hole_m)
        if linked.any():
            rows, along = rows[linked], along[linked] - np.median(members_m)
            instance[rows[_is_free_of_violations(track, seen, rows, along, i, space)]] = k


def columns_apart_m(point: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """Return the distance along a side between neighbouring columns of rays that hit it.

    ``point`` (3,) is on the side, ``ahead`` (2,) a unit vector along it, both in the world.
    """
    in_lidar = poses.transform(T_lidar_world, point[None])[0, :2]
    x, y = T_lidar_world[:2, :2] @ ahead
    aside_m = max(abs(float(in_lidar @ [-y, x])), 1e-3)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    return column_rad * float(in_lidar @ in_lidar) / aside_m


def _is_linked(along: Float, members_m: Float, hole_m: float) -> Bool:
    """Return (N,) True for positions linked to ``members_m`` (M,) by steps up to ``hole_m``."""
    all_along = np.concatenate([along, members_m])
    order = np.argsort(all_along, kind="stable")
    run = np.zeros(len(all_along), np.int64)
    run[order[1:]] = np.cumsum(np.diff(all_along[order]) > hole_m)
    return np.isin(run[: len(along)], run[len(along) :])


def _is_free_of_violations(
    track: Track, seen: SweepPoints, rows: Int, along: Float, i: int, space: FreeSpace
) -> Bool:
    """Return (N,) True for extension points up to the first violations, ahead and behind."""
    # along: (N,) metres ahead of the object's middle, negative behind
    step = np.floor(np.abs(along) / LINK_M).astype(np.int64)
    num_steps = int(step.max(initial=0)) + 1
    step += num_steps * (along < 0)  # steps ahead, then steps behind

    def up_to(steps: Int) -> Int:
        return np.bincount(steps, minlength=2 * num_steps).reshape(2, num_steps).cumsum(axis=1)

    is_blocked = np.zeros((2, num_steps), bool)
    in_object = track.undo(seen.points[rows], seen.time_s[rows])
    for j in space.others(i):
        violations = up_to(step[track.seen_through(in_object, j, space)])
        is_blocked |= violations > _MAX_VIOLATIONS * up_to(step)
    kept: Bool = ~np.logical_or.accumulate(is_blocked, axis=1).ravel()[step]
    return kept


def is_known_at(track: Track, i: int, clock: Clock) -> bool:
    """Return True if sweep i lies within the track's sweeps or at most 0.2 s outside."""
    first, last = min(track.claimed), max(track.claimed)
    return first <= i <= last or any(clock.near(i, end, MISSED_S) for end in (first, last))


def _speed_m_s(track: Track, i: int, clock: Clock) -> float:
    """Return the horizontal speed of the object at sweep i."""
    return float(np.linalg.norm(track.path.rate(track.seen_at(clock.time_ns[i]))[:2]))
