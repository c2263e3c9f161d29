# SPDX-License-Identifier: MIT
"""The places that an object comes to or has left: what moves leaves them empty, what stands is
still there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.flow.tracking.candidates import Obstacles
from densify.flow.tracking.shapes import Body
from densify.flow.tracking.sightings import Track
from densify.free_space.seen_through import FreeSpace
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Float

_NUM_ASKED = 60  # places of each sweep
_LEFT_M = 0.6  # from all of the object: it is gone, or not there yet;
_ROOM_M, _ROOM_S = 2.0, 0.5  # so far, and what it goes in that time, is left to who is in front
_THERE_M, _THERE_PER_GAP = 0.2, 0.5  # between two rings
_MOSTLY = 2  # times as often taken as empty: what stands is there nearly always
# So many empty places tell, and of what goes far so many on one side; taken as often as empty.
_LEAST, _MANY = 20, 100
_SELDOM, _HARDLY = 0.03, 0.1
_SOME = 8  # empty places tell, if none is taken


class Places(NamedTuple):
    """How often something else was seen at a place, and how often nothing was there."""

    taken: int
    empty: int

    def stand(self) -> bool:
        """Whether they are taken as often as those of what stands."""
        return self.taken >= _MOSTLY * self.empty

    def bare(self, least: int) -> bool:
        """Whether at least so many are empty, and next to none is taken."""
        return self.empty >= least and self.taken <= _SELDOM * self.empty


class LeftPlaces(NamedTuple):
    """What was seen where an object had not come to yet, and where it had been."""

    coming: Places
    gone: Places

    @property
    def both(self) -> Places:
        return Places(self.coming.taken + self.gone.taken, self.coming.empty + self.gone.empty)

    def unknown(self) -> bool:
        """Whether nothing tells: it never left its place."""
        return not any(self.both)

    def still_there(self) -> bool:
        """Whether something stands at all of them."""
        return self.both.taken > 0 and self.coming.stand() and self.gone.stand()

    def one_still_there(self) -> bool:
        """Whether something certainly stands at those before or at those after."""
        return any(p.taken > _MOSTLY * p.empty for p in self)

    def none_taken(self) -> bool:
        """Whether some are empty and nothing at all was seen at any."""
        return self.both.taken == 0 and self.both.empty >= _SOME

    def bare(self, far: bool) -> bool:
        """Whether next to nothing was seen at any of them: so they are of nothing that stands. far:
        it goes so far that many places on one side tell enough."""
        return (far and self.both.bare(_MANY)) or all(p.bare(_LEAST) for p in self)

    def mostly_bare(self) -> bool:
        """Whether hardly anything was seen there, before or after."""
        return self.both.empty >= _LEAST and self.both.taken <= _HARDLY * self.both.empty

    def many_empty(self) -> bool:
        return self.both.empty >= _MANY


def left_places(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace, proven: Sequence[Body]
) -> LeftPlaces:
    """What the sweeps saw at the places that a track comes to or has left.

    A wire fence is seen through from beside and not from ahead: where one becomes the other goes
    along it as the scanner does, and with it what seems to move; but the fence is still there, on
    both sides. Beside the end of a long object there may be the rest of it on one. Other objects
    that are proven to move do not count.
    """
    some = {i: rows[:: len(rows) // _NUM_ASKED + 1] for i, rows in track.claimed.items()}
    tree = BoxTree(track.seen_in(obstacles, track.claimed))
    rate = track.path.rate((track.path.begin_s + track.path.end_s) / 2)
    room_m = _ROOM_M + _ROOM_S * float(np.linalg.norm(rate[:2]))
    gap_m = space.gap_m(track.centre, next(iter(track.claimed)))
    there_m = max(_THERE_M, _THERE_PER_GAP * gap_m)

    def seen(look: tuple[int, ...], sweeps: Sequence[int]) -> Places:
        places = np.concatenate([np.zeros((0, 3)), *(obstacles[i].points[some[i]] for i in sweeps)])
        away_m, _ = tree.nearest(track.undo(places, space.clock.time_s[look[0]]), room_m)
        places = places[(away_m > _LEFT_M) & np.isfinite(away_m)]
        if not len(places):
            return Places(0, 0)
        there = np.concatenate([_there(places, there_m, obstacles[j], proven) for j in look])
        taken = np.zeros(len(places), bool)
        if len(there):
            taken = np.isfinite(BoxTree(there).nearest(places, there_m)[0])
        empty = space.seen_through(places, look[0]) & ~taken
        return Places(int(taken.sum()), int(empty.sum()))

    coming = [seen(look, [i for i in some if i > look[-1]]) for look in space.batches]
    gone = [seen(look, [i for i in some if i < look[0]]) for look in space.batches]
    return LeftPlaces(_total(coming), _total(gone))


def _total(parts: Sequence[Places]) -> Places:
    return Places(sum(p.taken for p in parts), sum(p.empty for p in parts))


def _there(places: Float, reach_m: float, c: Obstacles, proven: Sequence[Body]) -> Float:
    """(N,3) what a sweep saw that close to some places, but of no object proven to move."""
    rows = c.strips.rows_inside(places.min(0) - reach_m, places.max(0) + reach_m)
    rows = rows[np.isfinite(BoxTree(places).nearest(c.points[rows], reach_m)[0])]
    for track, shape in proven:
        if len(rows):
            body = track.undo(c.points[rows], c.time_s[rows])
            near = np.isfinite(shape.tree.nearest(body, _LEFT_M)[0])
            rows = rows[~(near | shape.within_outline(body))]
    return c.points[rows]
