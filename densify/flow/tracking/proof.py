# SPDX-License-Identifier: MIT
"""The test that confirms a track: its smooth motion must explain the measurements.

A static object seen differently from sweep to sweep, such as a fence or a tree's crown, can look as
if it moved. A moving object differs in three ways: its motion is smooth, it removes the free-space
violations that the points have if they are static, and it leaves its positions empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.flow.tracking.candidates import Obstacles
from densify.flow.tracking.objects import MovingObject, Track
from densify.free_space.seen_through import FreeSpace
from densify.geometry.nearest import is_near, nearest, tree_of
from densify.geometry.types import Float

_LEAST_STATES, _LEAST_S = 3, 0.15
_ROUGH_M, _ROUGH_PER_GAP, _ROUGH_S = 0.04, 0.2, 0.003  # residual; by ring gap, by speed
_LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL, _LEAST_WAY_PER_ROUGH = 0.35, 8.0, 1.5
_NUM_ASKED = 60  # points of a batch
# Violations if the points are static: a number, or a share of few tests, and of many at least one.
_LEAST_VIOLATIONS, _SHARE_OF_FEW, _LEAST_SHARE = 20, 0.08, 0.01
# Violations that the motion may leave, as a share of those; limbs swing, so more are allowed where
# all positions are empty.
_MAX_LEFT, _MAX_LEFT_OF_LIMBS, _FAR_M = 0.3, 0.5, 3.0
_FEW, _MAX_LEFT_OF_FEW = 0.2, 0.1  # fewer violations than this share prove less
_SHORT_S, _MAX_LEFT_OF_SHORT = 0.35, 0.03  # three positions of a tree's crown may lie on a line
_RAIL_M, _SLENDER, _ALONG, _SHARE_OF_RAIL = 2.0, 8.0, 0.7, 0.3
_LEFT_M = 0.6  # from all of the object
_ROOM_M, _ROOM_S = 2.0, 0.5  # in front of and behind the object, by its speed
_THERE_M, _THERE_PER_GAP = 0.2, 0.5
_MOSTLY = 2  # times as often taken as empty
_LEAST_EMPTY, _MANY_EMPTY = 20, 100  # positions; the latter where all are on one side
_SELDOM, _HARDLY = 0.03, 0.1  # taken, as a share of empty


def violations_left(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
) -> float:
    """Fit the smooth motion of a track and test it.

    objects: other confirmed ones.
    Returns the share of tests in which another sweep sees through the moved points: of two motions,
    the one with the lower share is right. inf unless the track certainly moves.
    """
    if len(track.observations) < _LEAST_STATES:
        return np.inf
    track.smooth()
    seen_s = track.duration_s()
    if seen_s < _LEAST_S or not _is_smooth(track, space, seen_s):
        return np.inf
    static, moved, num_tests = count_violations(track, obstacles, space)
    least = max(min(_LEAST_VIOLATIONS, _SHARE_OF_FEW * num_tests), _LEAST_SHARE * num_tests)
    if static < least or moved > _MAX_LEFT_OF_LIMBS * static:
        return np.inf
    left = find_places_left(track, obstacles, space, objects)
    if left.still_there():
        return np.inf
    empty = left.empty(far=track.path.travelled_m() >= _FAR_M)
    if moved > (_MAX_LEFT_OF_LIMBS if empty else _MAX_LEFT) * static:
        return np.inf
    few = static < _FEW * num_tests and not left.mostly_empty()
    if few and moved > _MAX_LEFT_OF_FEW * static:
        return np.inf
    long_s = min(_SHORT_S, float(np.ptp(space.clock.time_s)) / 2)
    if moved > _MAX_LEFT_OF_SHORT * static and seen_s < long_s:
        return np.inf
    return moved / num_tests


def _is_smooth(track: Track, space: FreeSpace, seen_s: float) -> bool:
    """Return True if the states lie on a smooth path, long enough to be told from noise."""
    residual_m, travelled_m = track.path.residual_m, track.path.travelled_m()
    gap_m = space.gap_m(track.centre, next(iter(track.claimed)))
    rough_m = _ROUGH_M + _ROUGH_PER_GAP * gap_m + _ROUGH_S * travelled_m / seen_s
    least_m = max(
        _LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL * residual_m, _LEAST_WAY_PER_ROUGH * rough_m
    )
    return travelled_m >= least_m and residual_m <= rough_m


def count_violations(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace
) -> tuple[int, int, int]:
    """Test some points of the track against all sweeps around them.

    Returns the number of free-space violations of the points at their static positions, that at
    the positions to which the motion moves them, and the number of tests.
    """
    tested = {}
    for batch in space.batches:
        num = _NUM_ASKED // len(batch)
        for i in batch:
            if i in track.claimed:
                rows = track.claimed[i]
                tested[i] = rows[:: len(rows) // num + 1]
    others = {i: frozenset(space.others(i)) for i in tested}
    points = {i: obstacles[i].points[rows] for i, rows in tested.items()}
    body = {i: track.undo(points[i], obstacles[i].time_s[rows]) for i, rows in tested.items()}
    static = moved = num_tests = 0
    for j, *_ in space.batches:
        sources = [i for i in tested if j in others[i]]
        if sources:
            in_object = np.concatenate([body[i] for i in sources])
            moved += int(track.seen_through(in_object, j, space).sum())
            in_world = np.concatenate([points[i] for i in sources])
            static += int(space.seen_through(in_world, j).sum())
            num_tests += len(in_object)
    return static, moved, num_tests


def is_rail(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
) -> bool:
    """Return True if the track may be a guard rail: long, low, moving along itself, with few
    violations if static, and not leaving its positions empty.

    Nothing of a rail tells its motion along itself. Between two rings, sweeps see through it.
    """
    points = track.points_in(obstacles, track.claimed)
    points -= points.mean(axis=0)
    _, axes = np.linalg.eigh(points[:, :2].T @ points[:, :2])
    along_m = points[:, :2] @ axes[:, 1]
    way = (track.path(track.path.end_s) - track.path(track.path.begin_s))[:2]
    slope = along_m @ points[:, 2] / max(float(along_m @ along_m), 1e-6)
    high_m = float(np.subtract(*np.percentile(points[:, 2] - slope * along_m, [90, 10])))
    long_m = float(np.ptp(along_m))
    if long_m < max(_RAIL_M, _SLENDER * high_m) or abs(way @ axes[:, 1]) < _ALONG * np.hypot(*way):
        return False
    static, _, num_tests = count_violations(track, obstacles, space)
    if static >= _SHARE_OF_RAIL * num_tests:
        return False
    return not find_places_left(track, obstacles, space, objects).mostly_empty()


class Places(NamedTuple):
    """How often another return was at a position of the object, and how often it was empty."""

    taken: int
    empty: int


class PlacesLeft(NamedTuple):
    """The positions of an object before it arrived there, and after it left."""

    before: Places
    after: Places

    def still_there(self) -> bool:
        """Return True if most positions are taken, before and after: by a static object."""
        taken = all(p.taken >= _MOSTLY * p.empty for p in self)
        return taken and sum(p.taken for p in self) > 0

    def empty(self, far: bool) -> bool:
        """Return True if nearly no position is taken, on both sides. far: the object travels so
        far that many positions on one side are enough."""
        each = all(p.empty >= _LEAST_EMPTY and p.taken <= _SELDOM * p.empty for p in self)
        taken, empty = self._total()
        return each or (far and empty >= _MANY_EMPTY and taken <= _SELDOM * empty)

    def mostly_empty(self) -> bool:
        """Return True if hardly any position is taken, before or after."""
        taken, empty = self._total()
        return empty >= _LEAST_EMPTY and taken <= _HARDLY * empty

    def _total(self) -> tuple[int, int]:
        return sum(p.taken for p in self), sum(p.empty for p in self)


def find_places_left(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
) -> PlacesLeft:
    """Count what other sweeps observed at the positions of the track.

    A wire fence is seen through from beside and not from ahead. The border between the two moves
    along the fence with the scanner, but the fence stays where it is. Returns of other confirmed
    objects do not count.
    """
    some = {i: rows[:: len(rows) // _NUM_ASKED + 1] for i, rows in track.claimed.items()}
    tree = tree_of(track.points_in(obstacles, track.claimed))
    rate = track.path.rate((track.path.begin_s + track.path.end_s) / 2)
    room_m = _ROOM_M + _ROOM_S * float(np.linalg.norm(rate[:2]))
    there_m = max(_THERE_M, _THERE_PER_GAP * space.gap_m(track.centre, next(iter(track.claimed))))

    def count(batch: tuple[int, ...], sweeps: Sequence[int]) -> Places:
        places = np.concatenate([np.zeros((0, 3)), *(obstacles[i].points[some[i]] for i in sweeps)])
        in_object = track.undo(places, space.clock.time_s[batch[0]])
        away_m, _ = nearest(tree, in_object, room_m)
        places = places[(away_m > _LEFT_M) & np.isfinite(away_m)]
        if not len(places):
            return Places(0, 0)
        returns = np.concatenate(
            [_returns_near(places, there_m, obstacles[j], objects) for j in batch]
        )
        taken = np.zeros(len(places), bool)
        if len(returns):
            taken = is_near(tree_of(returns), places, there_m)
        empty = space.seen_through(places, batch[0]) & ~taken
        return Places(int(taken.sum()), int(empty.sum()))

    def total(parts: Sequence[Places]) -> Places:
        return Places(sum(p.taken for p in parts), sum(p.empty for p in parts))

    return PlacesLeft(
        total([count(batch, [i for i in some if i > batch[-1]]) for batch in space.batches]),
        total([count(batch, [i for i in some if i < batch[0]]) for batch in space.batches]),
    )


def _returns_near(
    places: Float, reach_m: float, c: Obstacles, objects: Sequence[MovingObject]
) -> Float:
    """Return (N,3) the points of a sweep close to some positions, without those of the objects."""
    rows = c.strips.rows_inside(places.min(0) - reach_m, places.max(0) + reach_m)
    rows = rows[is_near(tree_of(places), c.points[rows], reach_m)]
    for track, shape in objects:
        if len(rows):
            rows = rows[~shape.near(track.undo(c.points[rows], c.time_s[rows]), _LEFT_M)]
    return c.points[rows]
