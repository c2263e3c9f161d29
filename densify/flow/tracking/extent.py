# SPDX-License-Identifier: MIT
"""Which points of a sweep belong to the objects that are followed: how far each reaches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.flow.tracking.candidates import Obstacles, Strips, firing_times_s
from densify.flow.tracking.lone_rays import columns_apart_m
from densify.flow.tracking.radial import Radial
from densify.flow.tracking.shapes import Body, Shape
from densify.flow.tracking.sightings import Track
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.linking import close_to_seeds
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Bool, Float, Float32, Int, Stretch

_ATTACH_M = 0.3
_ATTACH_UNSEEN_M = 0.15
_MIN_HEIGHT_M, _MIN_HEIGHT_OF_WALKERS_M, _AS_LOW_AS_ROAD_M = 0.08, 0.1, 0.15
_LENGTH_M = 15.0
_SIDE_M = 0.1
# Along a side that falls away from the scanner so many columns of rays, at the most.
_LONGEST_HOLE_M, _COLUMNS_IN_HOLE, _WIDEST_HOLE_M = 0.6, 2.0, 2.0
_CARRIED_SLACK_M = 0.5
_MAX_CONTRADICTED = 0.05
_WALKS_M_S, _FAST_M_S = 2.0, 8.0
# Of what all sweeps saw so close so many must be seeds; who walks is smaller.
_AROUND_M, _LEAST_SEEDS, _WALKER_M = 0.3, 0.1, 1.5
_WIDER_M, _MOSTLY = 0.5, 0.5  # of what is so close so much goes along
_ALONE_GAPS, _NUM_BESIDE = 2.0, 2  # of an object's points so many lie so close in the same sweep
_LEFT_M = 0.6  # from all of the object
_THERE_M = 0.2
_MAX_STILL_THERE = 0.2
_FORETOLD_S = 0.2  # before an object was first seen and after it was last seen
_GAPS_REACHED = 0.8  # of the gap between neighbouring rings
_GAPS_REACHED_UNSEEN = 0.5


@dataclass(frozen=True)
class Seen:
    """The points of a sweep that may belong to something.

    row: (N,) in the sweep. points: (N,3) world. time_s: (N,) when measured. height_m: (N,) above
    the ground. gap_m: (N,) between neighbouring rings there. reach_m: (N,) how close a point must
    be to an object's shape to belong to it. seed: (N,) another sweep saw through it.
    """

    row: Int
    points: Float
    time_s: Float
    height_m: Float32
    gap_m: Float
    reach_m: Float
    seed: Bool

    @staticmethod
    def of(
        stretch: Stretch, i: int, ground: HeightMap, obstacles: Obstacles, sensors: Sensors
    ) -> Seen:
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m > _MIN_HEIGHT_M)
        gap_m = sensors.gap_m(registered.sweep.points[row], registered.sweep.lidar[row])
        seeded, seed = np.zeros((2, len(points)), bool)
        seeded[obstacles.row[obstacles.candidate]] = True
        seed[obstacles.row[obstacles.seed]] = True
        reach_m = np.where(
            seeded[row],
            np.maximum(_ATTACH_M, _GAPS_REACHED * gap_m),
            np.maximum(_ATTACH_UNSEEN_M, _GAPS_REACHED_UNSEEN * gap_m),
        )
        time_s = firing_times_s(stretch, i, row)
        return Seen(row, points[row], time_s, height_m[row], gap_m, reach_m, seed[row])

    @staticmethod
    def together(parts: Sequence[Seen]) -> Seen:
        """What the sweeps of one look saw, one sweep's rows after the other's."""
        if len(parts) == 1:
            return parts[0]
        return Seen(
            *(
                np.concatenate([getattr(part, column.name) for part in parts])
                for column in fields(Seen)
            )
        )

    @cached_property
    def strips(self) -> Strips:
        """The points, to be found by boxes."""
        return Strips(self.points)


def shape_of(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Shape:
    """All that the sweeps saw of an object; of those who walk, what is small and comes into view at
    once, without what only even or only odd ones saw: echoes that melted with those of a wall
    behind them, which would make parts of the wall theirs; without what stays where it is, or lies
    mostly among such; and without what hardly any sweep saw through, if they are small then: the
    wall itself. (A slow car has sides that are not seen through either.)"""
    sweeps = sorted(track.claimed)
    evenly = sweeps[::2], sweeps[1::2]
    halves = [track.seen_in(obstacles, some) for some in evenly]
    points = np.concatenate(halves)
    if _speed_m_s(track, sweeps[len(sweeps) // 2], space.clock) > _WALKS_M_S:
        return Shape.of(points)
    reach_m = max(_ATTACH_M, _GAPS_REACHED * space.gap_m(track.centre, sweeps[0]))
    again = np.concatenate(
        [
            np.isfinite(BoxTree(other).nearest(own, reach_m)[0])
            for own, other in (halves, halves[::-1])
        ]
    )
    seed = np.concatenate([obstacles[j].seed[track.claimed[j]] for some in evenly for j in some])
    moves = ~_staying(track, obstacles, [j for some in evenly for j in some], space)
    again &= moves & close_to_seeds(points, moves, _WIDER_M, _MOSTLY)
    theirs = again & close_to_seeds(points, seed, _AROUND_M, _LEAST_SEEDS)
    if theirs.any() and np.linalg.norm(np.ptp(points[theirs, :2], axis=0)) < _WALKER_M:
        return Shape.of(points[theirs])
    return Shape.of(points[again] if again.any() else points)


def _staying(
    track: Track, obstacles: Sequence[Obstacles], sweeps: Sequence[int], space: FreeSpace
) -> Bool:
    """(N,) those of the track's points in these sweeps, one sweep's after the other's, whose places
    are taken in more of the other sweeps than the places that they would have moved to: of a bush
    beside who walks."""
    of = np.repeat(sweeps, [len(track.claimed[j]) for j in sweeps])
    body = track.seen_in(obstacles, sweeps)
    places = np.concatenate([obstacles[j].points[track.claimed[j]] for j in sweeps])
    reach_of = {
        j: max(_THERE_M, _GAPS_REACHED_UNSEEN * space.gap_m(track.centre, j)) for j in sweeps
    }
    reach_m = np.array([reach_of[j] for j in of])
    low, high = places.min(0) - reach_m.max(), places.max(0) + reach_m.max()
    stands, moves = np.zeros((2, len(places)), np.int64)

    def count(num: Int, points: Float, among: Float, asked: Bool) -> None:
        if len(among):
            away_m, _ = BoxTree(among).nearest(points[asked], float(reach_m.max()))
            num[asked] += away_m < reach_m[asked]

    for j in sweeps:
        c, others = obstacles[j], of != j
        count(moves, body, body[~others], others)
        count(stands, places, c.points[c.strips.rows_inside(low, high)], others)
    return np.asarray(stands > moves)


def attach(
    seen: Seen,
    i: int,
    tracks: Sequence[Track],
    shapes: Sequence[Shape],
    clock: Clock,
) -> NDArray[np.int32]:
    """(N,): the track each of the points seen by sweep number i belongs to, -1 none.

    A point belongs to a track where it is close to the object's points of all sweeps, or stands
    within their outline: nothing else can be where a solid object is.
    """
    instance = np.full(len(seen.points), -1, np.int32)
    nearest = np.full(len(seen.points), np.inf)
    for k, track in enumerate(tracks):
        if not foretold(track, i, clock):
            continue
        rim = track.place(shapes[k].rim, track.seen_at(clock.time_ns[i]))
        low, high = rim.min(0) - 2 * _ATTACH_M, rim.max(0) + 2 * _ATTACH_M
        low[2] -= 1.0  # down to the wheels
        rows = seen.strips.rows_inside(low, high)
        if not len(rows):
            continue
        in_shape = track.undo(seen.points[rows], seen.time_s[rows])
        distance, _ = shapes[k].tree.nearest(in_shape)
        belongs = (distance < seen.reach_m[rows]) & (seen.height_m[rows] >= ABOVE_GROUND_M)
        belongs |= shapes[k].within_outline(in_shape)
        closer = belongs & (distance < nearest[rows])
        instance[rows[closer]] = k
        nearest[rows[closer]] = distance[closer]
    return instance


def detach(
    instance: NDArray[np.int32],
    seen: Seen,
    i: int,
    tracks: Sequence[Track],
    shapes: Sequence[Shape],
    obstacles: Sequence[Obstacles],
    clock: Clock,
) -> None:
    """Take from those who walk what no sweep saw through and what is still there when they are
    gone: the wall beside them; and the ground under them. (What drives has sides that slide along
    themselves, and wheels.)"""
    for k, track in enumerate(tracks):
        if _speed_m_s(track, i, clock) > _WALKS_M_S:
            continue
        instance[(instance == k) & (seen.height_m < _MIN_HEIGHT_OF_WALKERS_M)] = -1
        rows = np.flatnonzero((instance == k) & ~seen.seed)
        if len(rows):
            _, there = _left_behind(track, shapes[k].tree, seen.points[rows], i, obstacles, clock)
            instance[rows[there]] = -1


def leave_out_alone(
    instance: NDArray[np.int32], seen: Seen, i: int, tracks: Sequence[Track], clock: Clock
) -> None:
    """Take from the tracks points that lie off all others of theirs, of those who walk and of what
    is as low as the road: echoes that melt with those of a wall or the road behind an edge."""
    low = seen.height_m < _AS_LOW_AS_ROAD_M
    for k in np.unique(instance[instance >= 0]):
        mine = np.flatnonzero(instance == k)
        doubtful = mine
        if _speed_m_s(tracks[k], i, clock) > _WALKS_M_S:
            doubtful = mine[low[mine]]
        if len(mine) <= _NUM_BESIDE or not len(doubtful):
            continue
        away_m, _ = BoxTree(seen.points[mine]).nearest_k(seen.points[doubtful], 1 + _NUM_BESIDE)
        instance[doubtful[away_m[:, -1] > _ALONE_GAPS * seen.gap_m[doubtful]]] = -1


def leave_out_slower(
    instance: NDArray[np.int32], seen: Seen, radial: Radial, tracks: Sequence[Track]
) -> None:
    """Take from the tracks the points whose measured radial velocities are not theirs: of what
    stands beside something fast, and of echoes that melt into one."""
    for k in np.unique(instance[instance >= 0]):
        rows = np.flatnonzero(instance == k)
        at_s = float(seen.time_s[rows].mean())
        velocity_m_s = tracks[k].velocity_m_s(seen.points[rows], at_s)
        instance[rows[radial.rows(rows).contradicts(velocity_m_s)]] = -1


def lengthen(
    instance: NDArray[np.int32],
    seen: Seen,
    i: int,
    tracks: Sequence[Track],
    shapes: Sequence[Shape],
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
) -> None:
    """Give the tracks what goes on ahead of and behind their points without a hole, as wide and as
    high as they are: nobody sees through the middle of a long side that slides along itself. Only
    as far as no other sweep sees through the points where they would be carried to; and what is
    fast must leave their places. Who walks has no long side, but there may be a wall beside him."""
    for k, track in enumerate(tracks):
        mine = np.flatnonzero(instance == k)
        if not len(mine) or _speed_m_s(track, i, space.clock) <= _WALKS_M_S:
            continue
        at_s = track.seen_at(space.clock.time_ns[i])
        ahead = Body(track, shapes[k]).pointing(at_s)
        axes = np.stack([ahead, [-ahead[1], ahead[0]]], axis=1)
        rim = track.place(shapes[k].rim, at_s)
        side = (rim[:, :2] @ axes)[:, 1]
        middle = track.place(shapes[k].points.mean(0, keepdims=True), at_s)[0]
        reach = np.array([1.5 * _LENGTH_M, 1.5 * _LENGTH_M, np.inf])
        rows = seen.strips.rows_inside(middle - reach, middle + reach)
        rows = rows[instance[rows] < 0]
        right, left = side.min() - _SIDE_M, side.max() + _SIDE_M
        # To carry them all would take longest: few come to lie beside it.
        beside, slack_m = seen.points[rows, :2] @ axes[:, 1], _carried_m(track, seen, rows, at_s)
        rows = rows[(beside > right - slack_m) & (beside < left + slack_m)]
        at_once = track.carry(seen.points[rows], seen.time_s[rows], at_s)
        along = at_once[:, :2] @ axes
        fits = (along[:, 1] > right) & (along[:, 1] < left)
        fits &= at_once[:, 2] < rim[:, 2].max() + _SIDE_M
        own = track.carry(seen.points[mine], seen.time_s[mine], at_s)[:, :2] @ ahead
        rows, along = rows[fits], along[fits, 0]
        columns_m = columns_apart_m(middle, ahead, space.T_lidar_world[i], space.sensors)
        hole_m = float(np.clip(_COLUMNS_IN_HOLE * columns_m, _LONGEST_HOLE_M, _WIDEST_HOLE_M))
        linked = _without_hole(along, own, hole_m)
        if not linked.any():
            continue
        rows, along = rows[linked], along[linked] - np.median(own)
        rows = rows[_uncontradicted(track, seen, rows, along, i, space)]
        if len(rows) and _leaves(track, seen, mine, rows, i, obstacles, space.clock):
            instance[rows] = k


def _carried_m(track: Track, seen: Seen, rows: NDArray[np.int64], at_s: float) -> float:
    """Certainly farther than any of the rows around the track is carried to where it is then."""
    if not len(rows):
        return 0.0
    times_s = seen.time_s[rows]
    ends = track.path(np.array([times_s.min(), times_s.max()])) - track.path(at_s)
    shift_m, turn_rad = np.linalg.norm(ends[:, :2], axis=1).max(), np.abs(ends[:, 3]).max()
    return float(_CARRIED_SLACK_M + 2 * (shift_m + 2 * _LENGTH_M * turn_rad))


def _without_hole(along: Float, own: Float, hole_m: float) -> Bool:
    """(N,) those of ``along`` that reach (M,) ``own`` by steps of up to ``hole_m``."""
    everything = np.concatenate([along, own])
    order = np.argsort(everything, kind="stable")
    run = np.zeros(len(everything), np.int64)
    run[order[1:]] = np.cumsum(np.diff(everything[order]) > hole_m)
    return np.isin(run[: len(along)], run[len(along) :])


def _uncontradicted(
    track: Track, seen: Seen, rows: NDArray[np.int64], along: Float, i: int, space: FreeSpace
) -> Bool:
    """(N,) those of the points from the middle of the object outwards, ahead and behind, up to
    where another sweep sees through too many of them when they are moved with the track.

    along: (N,) metres ahead of the middle.
    """
    step = np.floor(np.abs(along) / _LONGEST_HOLE_M).astype(np.int64)
    behind = along < 0
    num_steps = int(step.max(initial=0)) + 1
    step += num_steps * behind  # those ahead, then those behind
    size = np.bincount(step, minlength=2 * num_steps).reshape(2, num_steps).cumsum(axis=1)
    ends = np.zeros((2, num_steps), bool)
    body = track.undo(seen.points[rows], seen.time_s[rows])
    for j in space.others(i):
        through = step[track.seen_through(body, j, space)]
        looks = np.bincount(through, minlength=2 * num_steps).reshape(2, num_steps).cumsum(axis=1)
        ends |= looks > _MAX_CONTRADICTED * size
    kept: Bool = ~np.logical_or.accumulate(ends, axis=1).ravel()[step]
    return kept


def _leaves(
    track: Track,
    seen: Seen,
    mine: NDArray[np.int64],
    rows: NDArray[np.int64],
    i: int,
    obstacles: Sequence[Obstacles],
    clock: Clock,
) -> bool:
    """Whether the rows leave their places empty when the object with them is gone; asked of what is
    fast. Where a slow truck was are the parts of it that are not known yet to be its own. mine: its
    other points.
    """
    if _speed_m_s(track, i, clock) < _FAST_M_S:
        return True
    both = np.concatenate([mine, rows])
    tree = BoxTree(track.undo(seen.points[both], seen.time_s[both]))
    gone, there = _left_behind(track, tree, seen.points[rows], i, obstacles, clock)
    return bool(gone.any() and there.sum() <= _MAX_STILL_THERE * gone.sum())


def _speed_m_s(track: Track, i: int, clock: Clock) -> float:
    """When sweep number i is taken."""
    return float(np.linalg.norm(track.path.rate(track.seen_at(clock.time_ns[i]))[:2]))


def _left_behind(
    track: Track,
    tree: BoxTree,
    points: Float,
    i: int,
    obstacles: Sequence[Obstacles],
    clock: Clock,
) -> tuple[Bool, Bool]:
    """From which of the places (N,3) that sweep number i shows the object is gone in the first or
    in the last sweep that saw it, and where something that stands is there then. tree: of the
    object, in its own frame."""
    gone, there = np.zeros((2, len(points)), bool)
    for j in {min(track.claimed), max(track.claimed)} - {i}:
        body = track.undo(points, clock.time_s[j])
        away = np.flatnonzero(~np.isfinite(tree.nearest(body, _LEFT_M)[0]))
        if not len(away):
            continue
        gone[away] = True
        places, c = points[away], obstacles[j]
        rows = c.strips.rows_inside(places.min(0) - _THERE_M, places.max(0) + _THERE_M)
        stands = c.points[rows[~c.candidate[rows]]]
        if len(stands):
            there[away] |= np.isfinite(BoxTree(stands).nearest(places, _THERE_M)[0])
    return gone, there


def foretold(track: Track, i: int, clock: Clock) -> bool:
    """Whether sweep i is among those that saw the object, or little earlier or later."""
    first, last = min(track.claimed), max(track.claimed)
    return first <= i <= last or any(clock.near(i, end, _FORETOLD_S) for end in (first, last))
