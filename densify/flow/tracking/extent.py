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
from densify.free_space.range_image import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import close_to_seeds, is_near, nearest, tree_of
from densify.geometry.types import Bool, Float, Float32, Int, Stretch

Instance = NDArray[np.int32]

_REACH = 1.5  # reach of an object to candidates, in neighbour distances (`near_m`)
_LEAST_HEIGHT_M, _LEAST_HEIGHT_OF_WALKERS_M = 0.08, 0.1  # above the ground
_WALKS_M_S = 2.0  # greatest speed of walkers
_LEAST_SEEDS, _WALKER_M = 0.1, 1.5  # least share of seeds nearby; greatest length of a walker
_WIDER_M, _MOSTLY = 0.5, 0.5  # least share of moving points within this distance
NUM_COLUMNS = 2.0
"""Columns of rays that may be missing along a side that recedes from the scanner."""
_LONGEST_HOLE_M = 2.0  # longest hole in a side
_MAX_VIOLATIONS = 0.05  # greatest share of seen-through points in an extension


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
        columns = (
            np.concatenate([getattr(sweep, column.name) for sweep in batch])
            for column in fields(SweepPoints)
        )
        return SweepPoints(*columns)

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)


def find_shape(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Shape:
    """Return the accumulated shape of a track; shapes of walkers exclude their surroundings.

    Objects faster than 2 m/s keep all points. Otherwise three kinds of points are dropped:

    - Echoes merged with a wall's. They occur only in even or only in odd sweeps.
    - Points of a bush. They are static, or lie among static points.
    - Points of a wall. They are hardly ever seen through. Sides of slow cars are alike, hence these
      points are dropped only if the rest is shorter than 1.5 m.

    Args:
        obstacles: Points above the ground of each sweep of the stretch.
    """
    sweeps = sorted(track.claimed)
    clouds = {j: track.in_object(obstacles[j], track.claimed[j]) for j in sweeps}
    points = np.concatenate(list(clouds.values()))
    if _speed_m_s(track, sweeps[len(sweeps) // 2], space.clock) > _WALKS_M_S:
        return Shape.of(points)
    within_m = near_m(space.gap_m(track.centre, sweeps[0]))
    sweep_number = np.repeat(np.arange(len(sweeps)), [len(cloud) for cloud in clouds.values()])
    recurs = _recurs(points, sweep_number, _REACH * within_m)
    is_moving = ~_is_static(track, obstacles, clouds, sweep_number, within_m)
    is_own = recurs & is_moving & close_to_seeds(points, is_moving, _WIDER_M, _MOSTLY)
    seed = np.concatenate([obstacles[j].seed[track.claimed[j]] for j in sweeps])
    is_core = is_own & close_to_seeds(points, seed, _REACH * within_m, _LEAST_SEEDS)
    if is_core.any() and np.linalg.norm(np.ptp(points[is_core, :2], axis=0)) < _WALKER_M:
        return Shape.of(points[is_core])
    return Shape.of(points[is_own] if is_own.any() else points)


def _recurs(points: Float, sweep_number: Int, reach_m: float) -> Bool:
    """Return (N,) True for points near points of a sweep of the other parity."""
    recurs = np.zeros(len(points), bool)
    for parity in (0, 1):
        is_same = sweep_number % 2 == parity
        if not is_same.all():
            tree = tree_of(points[~is_same])
            recurs[is_same] = is_near(tree, points[is_same], reach_m)
    return recurs


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
    num_static, num_moved = np.zeros((2, len(measured)), np.int64)
    for number, (j, cloud) in enumerate(clouds.items()):
        is_other = sweep_number != number
        # Static points recur in the world, moving points in the object's frame.
        returns = obstacles[j].points[obstacles[j].strips.rows_inside(low, high)]
        if len(returns):
            num_static[is_other] += is_near(tree_of(returns), measured[is_other], reach_m)
        if len(cloud):
            num_moved[is_other] += is_near(tree_of(cloud), in_object[is_other], reach_m)
    return np.asarray(num_static > num_moved)


def assign_points(
    batch: Sequence[int],
    stretch: Stretch,
    ground: HeightMap,
    objects: Sequence[MovingObject],
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
) -> list[Instance]:
    """Return, for each sweep of a batch, (N,) the index of each point's object, -1 for none.

    Args:
        batch: Indices of the batch's sweeps.
        objects: Confirmed objects.
        obstacles: Points above the ground of each sweep of the stretch.
    """
    clouds = [SweepPoints.of(stretch, i, ground, obstacles[i], space.sensors) for i in batch]
    attached = [
        attach(cloud, i, objects, space.clock) for i, cloud in zip(batch, clouds, strict=True)
    ]
    # Vehicles are extended by the points of the whole batch at once.
    batch_instance = np.concatenate(attached)
    lengthen(batch_instance, SweepPoints.together(clouds), batch[0], objects, space)
    ends = np.cumsum([len(sweep_instance) for sweep_instance in attached])
    extended = np.split(batch_instance, ends[:-1])
    instances = []
    for i, cloud, sweep_instance in zip(batch, clouds, extended, strict=True):
        instance = np.full(len(stretch.sweeps[i].sweep), -1, np.int32)
        instance[cloud.row] = sweep_instance
        instances.append(instance)
    return instances


def attach(seen: SweepPoints, i: int, objects: Sequence[MovingObject], clock: Clock) -> Instance:
    """Return (N,) the index in ``objects`` of the object near each point of sweep i, or -1."""
    instance = np.full(len(seen.points), -1, np.int32)
    least_m = np.full(len(seen.points), np.inf)
    for k, (track, shape) in enumerate(objects):
        if not is_known_at(track, i, clock):
            continue
        rim = track.place(shape.rim, track.seen_at(clock.time_ns[i]))
        low, high = rim.min(0) - LINK_M, rim.max(0) + LINK_M
        low[2] = -np.inf  # wheels may lie below all accumulated points
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

    The middle of a long side that moves along itself is never seen through, and lacks candidates.
    The extension ends at a hole, or where another sweep sees through the moved points.

    Args:
        instance: (N,) index of each point's object, -1 for none; changed in place.
        seen: The N points of a batch.
        i: First sweep of the batch.
        objects: Confirmed objects.
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
        # Free points near the object, then those in its lane at their own times, then those in its
        # lane once all are moved to one time
        reach_m = np.array([1.5 * LANE_M, 1.5 * LANE_M, np.inf])
        rows = seen.strips.rows_inside(middle - reach_m, middle + reach_m)
        rows = rows[instance[rows] < 0]
        rows = rows[lane.holds(seen.points[rows], speed_m_s * batch_s)]
        at_once = track.carry(seen.points[rows], seen.time_s[rows], at_s)
        fits = lane.holds(at_once)
        rows = rows[fits]
        # Coordinates along the heading
        along_m = at_once[fits, :2] @ lane.ahead
        members_at_once = track.carry(seen.points[members], seen.time_s[members], at_s)
        members_m = members_at_once[:, :2] @ lane.ahead
        columns_m = columns_apart_m(middle, lane.ahead, space.T_lidar_world[i], space.sensors)
        hole_m = float(np.clip(NUM_COLUMNS * columns_m, LINK_M, _LONGEST_HOLE_M))
        is_linked = _is_linked(along_m, members_m, hole_m)
        if is_linked.any():
            rows = rows[is_linked]
            ahead_m = along_m[is_linked] - np.median(members_m)
            instance[rows[_is_free_of_violations(track, seen, rows, ahead_m, i, space)]] = k


def columns_apart_m(point: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """Return the distance (m) along a side between neighbouring columns of rays that hit it.

    Args:
        point: (3,) a point of the side, world.
        ahead: (2,) unit vector along the side, world.
        T_lidar_world: (4,4) inverse of the lidar's pose.
    """
    in_lidar = poses.transform(T_lidar_world, point[None])[0, :2]
    x, y = T_lidar_world[:2, :2] @ ahead
    aside_m = max(abs(float(in_lidar @ [-y, x])), 1e-3)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    return column_rad * float(in_lidar @ in_lidar) / aside_m


def _is_linked(along_m: Float, members_m: Float, hole_m: float) -> Bool:
    """Return (N,) True for coordinates linked to ``members_m`` (M,) by steps up to ``hole_m``."""
    all_m = np.concatenate([along_m, members_m])
    order = np.argsort(all_m, kind="stable")
    # Coordinates without a hole between them have the same run number.
    run = np.zeros(len(all_m), np.int64)
    run[order[1:]] = np.cumsum(np.diff(all_m[order]) > hole_m)
    return np.isin(run[: len(along_m)], run[len(along_m) :])


def _is_free_of_violations(
    track: Track, seen: SweepPoints, rows: Int, ahead_m: Float, i: int, space: FreeSpace
) -> Bool:
    """Return (N,) True for extension points up to the first violations, ahead and behind."""
    # ahead_m: (N,) metres ahead of the object's middle, negative behind
    step = np.floor(np.abs(ahead_m) / LINK_M).astype(np.int64)
    num_steps = int(step.max(initial=0)) + 1
    step += num_steps * (ahead_m < 0)  # first the steps ahead, then the steps behind

    def count_up_to(steps: Int) -> Int:
        num_at = np.bincount(steps, minlength=2 * num_steps)
        return num_at.reshape(2, num_steps).cumsum(axis=1)

    is_blocked = np.zeros((2, num_steps), bool)
    in_object = track.undo(seen.points[rows], seen.time_s[rows])
    for j in space.others(i):
        num_violations = count_up_to(step[track.seen_through(in_object, j, space)])
        is_blocked |= num_violations > _MAX_VIOLATIONS * count_up_to(step)
    is_beyond_block = np.logical_or.accumulate(is_blocked, axis=1)
    return np.asarray(~is_beyond_block.ravel()[step])


def is_known_at(track: Track, i: int, clock: Clock) -> bool:
    """Return True if sweep i is at most 0.2 s before the track's first or after its last sweep."""
    first, last = min(track.claimed), max(track.claimed)
    return first <= i <= last or any(clock.near(i, end, MISSED_S) for end in (first, last))


def _speed_m_s(track: Track, i: int, clock: Clock) -> float:
    """Return the horizontal speed of the object at sweep i."""
    return float(np.linalg.norm(track.path.rate(track.seen_at(clock.time_ns[i]))[:2]))
