# SPDX-License-Identifier: MIT
"""Decide which points of each sweep belong to which tracked object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.flow.tracking.candidates import LINK_M, Obstacles, Strips, firing_times_s
from densify.flow.tracking.following import MAX_MISSED_S
from densify.flow.tracking.objects import LANE_M, Lane, MovingObject, Shape, Track, near_m
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.free_space.range_image import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import close_to_seeds, is_near, nearest, tree_of
from densify.geometry.types import Bool, Float, Float32, Int, Stretch

Instance = NDArray[np.int32]

_REACH = 1.5  # greatest distance of a candidate from its object, in neighbour distances (`near_m`)
_MIN_HEIGHT_M, _MIN_WALKER_HEIGHT_M = 0.08, 0.1  # above the ground
_MAX_WALKER_SPEED_M_S = 2.0
_MAX_WALKER_M = 1.5  # greatest length of a walker's shape
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
        """Return the points of sweep index i that are more than 0.08 m above the ground."""
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m > _MIN_HEIGHT_M)
        gap_m = sensors.gap_m(registered.sweep.points[row], registered.sweep.lidar[row])
        # Other sweeps saw through candidates, hence candidates may lie farther from the shape.
        candidate = np.zeros(len(points), bool)
        candidate[obstacles.row[obstacles.candidate]] = True
        reach_m = np.where(candidate[row], _REACH, 1.0) * near_m(gap_m)
        time_s = firing_times_s(stretch, i, row)
        return SweepPoints(row, points[row], time_s, height_m[row], gap_m, reach_m)

    @staticmethod
    def concatenate(batch: Sequence[SweepPoints]) -> SweepPoints:
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
    """Return the accumulated shape of a track, without the surroundings of slow objects.

    Objects faster than 2 m/s in their middle sweep keep all points. From slower objects three kinds
    of points are dropped, unless no point would remain:

    - Echoes merged with a wall's. They occur only in even or only in odd sweeps.
    - Points of a bush. They are static, or lie among static points.
    - Points of a wall. They are hardly ever seen through. So are the sides of slow cars, hence
      these points are dropped only if the remaining points span less than 1.5 m.
    """
    sweeps = sorted(track.claimed)
    clouds = {j: track.in_object(obstacles[j], track.claimed[j]) for j in sweeps}
    points = np.concatenate(list(clouds.values()))
    if _speed_m_s(track, sweeps[len(sweeps) // 2], space.clock) > _MAX_WALKER_SPEED_M_S:
        return Shape.of(points)
    neighbour_m = near_m(space.gap_m(track.centre, sweeps[0]))
    # (N,) rank of the sweep that measured each point
    sweep_number = np.repeat(np.arange(len(sweeps)), [len(cloud) for cloud in clouds.values()])
    recurs = _recurs(points, sweep_number, _REACH * neighbour_m)
    is_moving = ~_is_static(track, obstacles, clouds, sweep_number, neighbour_m)
    # Moving points of a bush lie among static points. Points of the object lie within 0.5 m of a
    # point around which at least half of the points move.
    is_own = recurs & is_moving & close_to_seeds(points, is_moving, 0.5, 0.5)
    seed = np.concatenate([obstacles[j].seed[track.claimed[j]] for j in sweeps])
    # The third kind of points has less than 10 % seeds around: it is hardly ever seen through.
    is_core = is_own & close_to_seeds(points, seed, _REACH * neighbour_m, 0.1)
    if is_core.any() and np.linalg.norm(np.ptp(points[is_core, :2], axis=0)) < _MAX_WALKER_M:
        return Shape.of(points[is_core])
    return Shape.of(points[is_own] if is_own.any() else points)  # a shape needs points


def _recurs(points: Float, sweep_number: Int, reach_m: float) -> Bool:
    """Return the (N,) mask of points near a point of a sweep of the other parity (even, odd)."""
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
    """Return the (N,) mask of points that more other sweeps confirm as static than as moved."""
    in_object = np.concatenate(list(clouds.values()))
    measured = np.concatenate([obstacles[j].points[track.claimed[j]] for j in clouds])
    low, high = measured.min(0) - reach_m, measured.max(0) + reach_m
    num_static, num_moved = np.zeros((2, len(measured)), np.int64)
    for number, (j, cloud) in enumerate(clouds.items()):
        is_other = sweep_number != number  # a sweep does not confirm its own points
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
    """Find the object of each point of a batch of sweeps.

    Returns:
        For each sweep (N,) int32, the index in ``objects``, -1 for points of no object.
    """
    clouds = [SweepPoints.of(stretch, i, ground, obstacles[i], space.sensors) for i in batch]
    attached = [
        _attach(cloud, i, objects, space.clock) for i, cloud in zip(batch, clouds, strict=True)
    ]
    # A batch is short, hence vehicles are extended by the points of all its sweeps at once.
    batch_instance = np.concatenate(attached)
    _extend_vehicles(batch_instance, SweepPoints.concatenate(clouds), batch[0], objects, space)
    instances = [np.full(len(stretch.sweeps[i].sweep), -1, np.int32) for i in batch]
    ends = np.cumsum([len(cloud.row) for cloud in clouds])
    parts = np.split(batch_instance, ends[:-1])
    for cloud, instance, part in zip(clouds, instances, parts, strict=True):
        instance[cloud.row] = part
    return instances


def _attach(cloud: SweepPoints, i: int, objects: Sequence[MovingObject], clock: Clock) -> Instance:
    """Return the index (N,) in ``objects`` of the object at each point of sweep i, -1 for none.

    A point belongs to an object if it lies near the shape and at least 0.2 m above the ground, or
    inside the outline seen from above. Points less than 0.1 m above the ground belong to no object
    of up to 2 m/s. Of several objects the nearest owns the point.
    """
    instance = np.full(len(cloud.points), -1, np.int32)
    least_m = np.full(len(cloud.points), np.inf)
    for k, (track, shape) in enumerate(objects):
        if not is_tracked_at(track, i, clock):
            continue
        rim = track.place(shape.rim, track.seen_at(clock.time_ns[i]))
        low, high = rim.min(0) - LINK_M, rim.max(0) + LINK_M
        low[2] = -np.inf  # wheels may lie below all accumulated points
        rows = cloud.strips.rows_inside(low, high)
        if not len(rows):
            continue
        in_object = track.undo(cloud.points[rows], cloud.time_s[rows])
        distance_m, _ = nearest(shape.tree, in_object)
        # A point near the shape but below `ABOVE_GROUND_M` may be of the road. Inside the outline
        # such a point is of the object, for example of a wheel.
        belongs = (distance_m < cloud.reach_m[rows]) & (cloud.height_m[rows] >= ABOVE_GROUND_M)
        belongs |= shape.within_outline(in_object)
        if _speed_m_s(track, i, clock) <= _MAX_WALKER_SPEED_M_S:
            belongs &= cloud.height_m[rows] >= _MIN_WALKER_HEIGHT_M
        is_nearest = belongs & (distance_m < least_m[rows])
        instance[rows[is_nearest]] = k
        least_m[rows[is_nearest]] = distance_m[is_nearest]
    return instance


def _extend_vehicles(
    instance: Instance,
    cloud: SweepPoints,
    i: int,
    objects: Sequence[MovingObject],
    space: FreeSpace,
) -> None:
    """Assign free points ahead of and behind vehicles, in their lane, to the vehicles, in place.

    The middle of a long side that moves along itself is never seen through, and lacks candidates.
    Vehicles are objects faster than 2 m/s. The extension ends at a hole (0.6 to 2 m, by the spacing
    of the rays), or where another sweep sees through more than 5 % of the moved points. The cloud
    holds the N points of a batch whose first sweep has index i.
    """
    for k, moving_object in enumerate(objects):
        track, shape = moving_object
        members = np.flatnonzero(instance == k)
        if not len(members) or _speed_m_s(track, i, space.clock) <= _MAX_WALKER_SPEED_M_S:
            continue
        at_s = track.seen_at(space.clock.time_ns[i])
        lane = moving_object.lane(at_s)
        middle = track.place(shape.points.mean(0, keepdims=True), at_s)[0]
        rows, along_m = _free_rows_in_lane(cloud, instance < 0, track, lane, middle, at_s)
        # Only points that are linked with the object may belong to it. They are linked if their
        # coordinates along the heading have no hole.
        members_at_one_time = track.carry(cloud.points[members], cloud.time_s[members], at_s)
        members_m = members_at_one_time[:, :2] @ lane.ahead
        columns_m = two_columns_m(middle, lane.ahead, space.T_lidar_world[i], space.sensors)
        hole_m = float(np.clip(columns_m, LINK_M, _LONGEST_HOLE_M))
        is_linked = _is_linked(along_m, members_m, hole_m)
        # Of the linked points, only those up to the first violations are taken.
        if is_linked.any():
            linked_rows = rows[is_linked]
            ahead_m = along_m[is_linked] - np.median(members_m)
            is_kept = _is_unviolated(track, cloud, linked_rows, ahead_m, i, space)
            instance[linked_rows[is_kept]] = k


def _free_rows_in_lane(
    cloud: SweepPoints, is_free: Bool, track: Track, lane: Lane, middle: Float, at_s: float
) -> tuple[Int, Float]:
    """Return the free rows (K,) of a cloud in a lane, and their coordinates (K,) along it (m)."""
    # Fast and coarse tests come first: a box, and the lane widened by the motion within the batch
    reach_m = np.array([1.5 * LANE_M, 1.5 * LANE_M, np.inf])
    boxed_rows = cloud.strips.rows_inside(middle - reach_m, middle + reach_m)
    free_rows = boxed_rows[is_free[boxed_rows]]
    travel_m = float(np.linalg.norm(track.path.rate(at_s)[:2])) * np.ptp(cloud.time_s)
    near_rows = free_rows[lane.holds(cloud.points[free_rows], travel_m)]
    # The exact test needs all points moved to one time.
    at_one_time = track.carry(cloud.points[near_rows], cloud.time_s[near_rows], at_s)
    in_lane = lane.holds(at_one_time)
    return near_rows[in_lane], at_one_time[in_lane, :2] @ lane.ahead


def two_columns_m(point: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """Return the distance (m) over two columns of rays on a side that recedes from the scanner.

    The side contains a point (3,) and runs along a unit vector ``ahead`` (2,), both world.
    """
    # Two columns, because one may lack returns. Two rays that differ by a small angle hit the side
    # at points that are angle x range² / (distance of the side's line from the lidar) apart.
    in_lidar = poses.transform(T_lidar_world, point[None])[0, :2]
    x, y = T_lidar_world[:2, :2] @ ahead
    aside_m = max(abs(float(in_lidar @ [-y, x])), 1e-3)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    return 2 * (column_rad * float(in_lidar @ in_lidar) / aside_m)


def _is_linked(along_m: Float, members_m: Float, hole_m: float) -> Bool:
    """Return the mask of coordinates linked to ``members_m`` by steps of at most ``hole_m``."""
    all_m = np.concatenate([along_m, members_m])
    order = np.argsort(all_m, kind="stable")
    # Coordinates without a hole between them have the same run number.
    run = np.zeros(len(all_m), np.int64)
    run[order[1:]] = np.cumsum(np.diff(all_m[order]) > hole_m)
    return np.isin(run[: len(along_m)], run[len(along_m) :])


def _is_unviolated(
    track: Track, cloud: SweepPoints, rows: Int, ahead_m: Float, i: int, space: FreeSpace
) -> Bool:
    """Return the (N,) mask of extension points up to the first violations, ahead and behind."""
    # The lane is divided into bins of `LINK_M`, from the object to both sides.
    bin_number = np.floor(np.abs(ahead_m) / LINK_M).astype(np.int64)
    num_bins = int(bin_number.max(initial=0)) + 1
    bin_number += num_bins * (ahead_m < 0)  # first the bins ahead, then the bins behind

    def count_up_to(numbers: Int) -> Int:  # (2,num_bins) points up to each bin, ahead and behind
        num_in_bin = np.bincount(numbers, minlength=2 * num_bins)
        return num_in_bin.reshape(2, num_bins).cumsum(axis=1)

    is_blocked = np.zeros((2, num_bins), bool)
    in_object = track.undo(cloud.points[rows], cloud.time_s[rows])
    for j in space.others(i):
        num_violations = count_up_to(bin_number[track.seen_through(in_object, j, space)])
        is_blocked |= num_violations > _MAX_VIOLATIONS * count_up_to(bin_number)
    # A violation also rejects all points that are farther from the object.
    is_rejected = np.logical_or.accumulate(is_blocked, axis=1)
    return np.asarray(~is_rejected.ravel()[bin_number])


def is_tracked_at(track: Track, i: int, clock: Clock) -> bool:
    """Return True if sweep i is from 0.2 s before a track's first to 0.2 s after its last sweep."""
    first_sweep, last_sweep = min(track.claimed), max(track.claimed)
    if first_sweep <= i <= last_sweep:
        return True
    return clock.near(i, first_sweep, MAX_MISSED_S) or clock.near(i, last_sweep, MAX_MISSED_S)


def _speed_m_s(track: Track, i: int, clock: Clock) -> float:
    """Return the horizontal speed of the object at sweep i."""
    return float(np.linalg.norm(track.path.rate(track.seen_at(clock.time_ns[i]))[:2]))
