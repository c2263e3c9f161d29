# SPDX-License-Identifier: MIT
"""Groups of candidates followed through a stretch as rigid objects, and the proof that they move.

A track is a group's accumulated shape (its model) and one planar rigid motion per look. It starts
from the velocity that most looks agree on, is followed both ways by aligning each look with the
model, is smoothed in time, and counts only if that smooth motion explains what was measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from densify.flow.tracking.align import Model
from densify.flow.tracking.candidates import Batch, Obstacles, height_weight
from densify.flow.tracking.following import follow
from densify.flow.tracking.left_places import left_places
from densify.flow.tracking.lone_rays import few_rays, gap_in_line_m, in_line, linked_in_line
from densify.flow.tracking.proof import left_contradicted, may_be_a_rail, share_contradicted
from densify.flow.tracking.shapes import Body, Shape
from densify.flow.tracking.sightings import Track
from densify.flow.tracking.slides import go_with_the_rest, take_back_slides
from densify.flow.tracking.starts import (
    MIN_POINTS,
    ends,
    groups_to_start,
    is_line_on,
    is_part,
    velocities_beside,
    velocities_of_traffic,
)
from densify.flow.tracking.vote import DistanceField, Group, vote
from densify.free_space.ground import HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.geometry.clock import Clock
from densify.geometry.types import Bool, Float

_FIT_M = 0.3
_RAYS_M = 15.0
_NEAR_S = 0.3
_REFINED_STD = np.array([0.15, 0.15, 0.03])  # m, m, rad: of the smooth motion
_CLEARLY = 0.5  # of the looks that contradict the motion found before
_HARDLY_FOLLOWED = 2  # looks: the velocity that it was started with was none of its
_DOUBTFUL = 0.0025  # of the looks contradict it: it is followed again from its ends
_AS_WHOLE = 0.9  # of the points it had


def follow_groups(
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    ground: HeightMap,
    velocities_m_s: Sequence[Float] | None = None,
) -> list[Track]:
    """All proven moving objects of the stretch. velocities_m_s: (C,3) of each sweep's points, with
    which groups of them start; None has the sweeps around vote."""
    search = _Search(obstacles, space, ground, velocities_m_s)
    groups = groups_to_start([look.obstacles for look in search.looks], search.clock)
    return search.tracks_of(groups) + search.tracks_of(groups, left_over=True)


class _Search:
    """What is there to be tracked, and the tracks found so far.

    looks, clock: of the sweeps taken together, and when. free: (C,) of each sweep's points, which
    are part of no track yet. bodies: of the tracks.
    """

    def __init__(
        self,
        obstacles: Sequence[Obstacles],
        space: FreeSpace,
        ground: HeightMap,
        velocities_m_s: Sequence[Float] | None,
    ) -> None:
        self._standing, self._space, self._ground = obstacles, space, ground
        self._velocities_m_s = velocities_m_s
        self.looks = [Batch.of(b, obstacles, space.clock) for b in space.batches]
        self.clock = Clock(np.array([look.time_ns for look in self.looks]))
        self.free, self.bodies = self.all_points(), list[Body]()
        self._fields: list[list[DistanceField]] = []
        if velocities_m_s is None:
            of_sweeps = [
                DistanceField.of(c.points[c.candidate], c.time_s[c.candidate]) for c in obstacles
            ]
            self._fields = [[of_sweeps[j] for j in look.sweeps] for look in self.looks]

    def all_points(self) -> list[Bool]:
        """(C,) of each sweep's points, all True."""
        return [np.ones(len(c.points), bool) for c in self._standing]

    def tracks_of(
        self, groups: Sequence[tuple[int, np.ndarray]], left_over: bool = False
    ) -> list[Track]:
        """Those of groups, each a look and its members, that are proven to move. left_over: what no
        track was found of where rings lie far apart is followed with heights that count less,
        unless it may be a part of what is found."""
        looks, untried = self.looks, self.all_points()
        tracks: list[Track] = []
        for n, group in groups:
            untaken = looks[n].gather(self.free)[group] & looks[n].gather(untried)[group]
            members = group[untaken]
            if len(members) < MIN_POINTS or is_line_on(self.bodies, looks[n], members):
                continue
            gap_m = self._gap_m(members, n)
            weights = self._height_weights(gap_m)[left_over:]
            if not weights or (left_over and is_part(self.bodies, looks[n], members, gap_m)):
                continue
            track, proven = self._track_of(members, n, weights)
            for j, rows in track.claimed.items():
                untried[j][rows] = False
            if proven:
                self._take(track)
                tracks.append(track)
        return tracks

    def _gap_m(self, members: np.ndarray, n: int) -> float:
        """Between neighbouring rings at a group of look n."""
        look = self.looks[n]
        return self._space.gap_m(look.obstacles.points[members].mean(axis=0), look.sweeps[0])

    def _height_weights(self, gap_m: float) -> list[float]:
        """How much heights count while a group is followed, all at first. Where rings lie far apart
        each meets what comes nearer at another height than the sweep before."""
        less = float(height_weight(gap_m))
        return [1.0, less] if less < 1.0 and not self._space.sensors.scattered else [1.0]

    def _track_of(
        self, members: np.ndarray, n: int, weights: Sequence[float]
    ) -> tuple[Track, bool]:
        """The track of a group of look n, whole if it is proven, and whether it is. weights: of
        heights, see `_height_weights`; others than the first where the track is doubtful and no
        fewer points go with theirs."""
        track, left = self._followed(members, n, weights[0])
        for weight in weights[1:] if _DOUBTFUL < left < np.inf else ():
            tried, contradicted = self._followed(members, n, weight)
            as_many = tried.total_points() >= track.total_points()
            if as_many and contradicted < _CLEARLY * left:
                track, left = tried, contradicted
        proven = bool(np.isfinite(left))
        if proven:
            _gather(track, self._standing, self.free, self._space)
            # A piece of a guard rail shows with the rest what it is of.
            proven = not may_be_a_rail(track, self._standing, self._space, self.bodies)
            if proven and len(weights) > 1:  # rings glide over a roof, but not over all of the car
                still = share_contradicted(track, self._standing, self._space, self.bodies)
                proven = still is not None
        if proven and weights[0] < 1.0:  # rings glide over what is parked the more easily then
            places = left_places(track, self._standing, self._space, self.bodies)
            proven = places.mostly_bare()
        if proven:
            _refine(track, self._standing, self._ground)
            take_back_slides(track, self._standing, self._space)
            go_with_the_rest(track, self.bodies, self._standing, self._space)
            _claim_rays(track, self._standing, self.free, self._space)
        return track, proven

    def _take(self, track: Track) -> None:
        """Its points are no others'."""
        for j, rows in track.claimed.items():
            self.free[j][rows] = False
        points = track.seen_in(self._standing, sorted(track.claimed))
        self.bodies.append(Body(track, Shape.of(points)))

    def _followed(self, members: np.ndarray, n: int, weight: float) -> tuple[Track, float]:
        """The best track of a group of look n, from there or its ends on; as `_best_of`."""
        track, left = self._started(members, n, weight)
        return self._again_from_its_ends(track, left, weight)

    def _started(self, members: np.ndarray, n: int, weight: float) -> tuple[Track, float]:
        """The best track by the velocity that the sweeps tell, or else by that of what moves beside
        or of the other traffic; as `_best_of`."""
        beside = velocities_beside(self.looks[n], members, self.bodies)
        starts: Iterator[Float] = chain([self._velocity_of(members, n)], beside)
        track, left = _best_of(self._follow(members, n, velocity, weight) for velocity in starts)
        if np.isinf(left) and len(track.sightings) <= _HARDLY_FOLLOWED:
            starts = velocities_of_traffic(self.looks[n], self.bodies)
            in_traffic = _best_of(self._follow(members, n, velocity, weight) for velocity in starts)
            track, left = (track, left) if np.isinf(in_traffic[1]) else in_traffic
        return track, left

    def _again_from_its_ends(self, track: Track, left: float, weight: float) -> tuple[Track, float]:
        """The same, or followed from one of its ends, if as much of it is contradicted less; what
        is not proven only from where more of it is seen.

        left: how much contradicts it, inf if it is not proven.
        """
        least = track.num_points(next(iter(track.sightings))) if np.isinf(left) else 0
        for rows, k in ends(track, self.looks) if left > _DOUBTFUL else ():
            if len(rows) <= least:
                continue
            tried, contradicted = self._follow(rows, k, self._velocity_of(rows, k), weight)
            whole = tried.total_points() >= _AS_WHOLE * track.total_points()
            if whole and contradicted is not None and contradicted < _CLEARLY * left:
                track, left = tried, contradicted
        return track, left

    def _velocity_of(self, members: np.ndarray, n: int) -> Float:
        """(3,) m/s that a group of look n may have."""
        seen = self.looks[n].obstacles
        if self._velocities_m_s is None:
            group = Group.of(seen.points[members], seen.time_s[members])
            velocity = vote(group, n, self._fields, self.clock)
        else:
            velocity = np.median(self.looks[n].gather(self._velocities_m_s)[members], axis=0)
        return velocity if seen.radial is None else seen.radial.rows(members).corrected(velocity)

    def _follow(
        self, members: np.ndarray, n: int, velocity: Float, weight: float
    ) -> tuple[Track, float | None]:
        """A group of look n from that velocity on, and how much contradicts its track, None if that
        is not proven. weight: of heights."""
        looks, free, ground, clock = self.looks, self.free, self._ground, self.clock
        track = follow(members, n, velocity, looks, free, ground, clock, weight)
        return track, left_contradicted(track, self._standing, self._space, self.bodies)


def _best_of(tried: Iterable[tuple[Track, float | None]]) -> tuple[Track, float]:
    """The least contradicted of the proven tracks, and how much; the last one and inf if none is
    proven. No more are tried after one that nothing contradicts.

    tried: tracks and how much contradicts them, None if they are not proven.
    """
    best, least = Track(np.zeros(3)), np.inf
    for track, contradicted in tried:
        if contradicted is not None and contradicted < _CLEARLY * least:
            best, least = track, contradicted
        elif np.isinf(least):
            best = track
        if least == 0:
            break
    return best, least


def _gather(
    track: Track,
    obstacles: Sequence[Obstacles],
    free: Sequence[Bool],
    space: FreeSpace,
) -> None:
    """Claim the free candidates beside or within the object that its motion does not contradict,
    before a part of it starts a track of its own."""
    shape = Shape.of(track.seen_in(obstacles, sorted(track.claimed)))
    for j, own in track.claimed.items():
        c = obstacles[j]
        there = track.place(shape.rim, track.seen_at(space.clock.time_ns[j]))
        rows = c.strips.rows_inside(there.min(0) - 2 * _FIT_M, there.max(0) + 2 * _FIT_M)
        rows = rows[free[j][rows] & (c.cluster[rows] >= 0)]
        rows = np.setdiff1d(rows, own, assume_unique=True)
        in_shape = track.undo(c.points[rows], c.time_s[rows])
        belongs = np.isfinite(shape.tree.nearest(in_shape, _FIT_M)[0])
        rows = rows[belongs | shape.within_outline(in_shape)]
        rows = _not_contradicted(track, c, rows, j, space)
        track.claimed[j] = np.concatenate([own, rows])


def _claim_rays(
    track: Track, obstacles: Sequence[Obstacles], free: Sequence[Bool], space: FreeSpace
) -> None:
    """Claim the free clusters of single rings and columns of rays ahead of and behind the object
    that its motion does not contradict, see `densify.flow.tracking.lone_rays`. They do not place
    it: they stay where the rays are."""
    shape = Shape.of(track.seen_in(obstacles, sorted(track.claimed)))
    ahead = Body(track, shape).pointing(next(iter(track.sightings.values())).seen_s)
    found, bodies = [], []
    for j, own in track.claimed.items():
        c = obstacles[j]
        there = track.place(shape.rim, track.seen_at(space.clock.time_ns[j]))
        rows = c.strips.rows_inside(there.min(0) - _RAYS_M, there.max(0) + _RAYS_M)
        rows = rows[free[j][rows] & (c.cluster[rows] >= 0)]
        rows = np.setdiff1d(rows, own, assume_unique=True)
        rows = rows[few_rays(c, rows, space.T_lidar_world[j], space.sensors)]
        rows = rows[in_line(shape, track.undo(c.points[rows], c.time_s[rows]), ahead)]
        rows = _not_contradicted(track, c, rows, j, space)
        found.append(rows)
        bodies.append(track.undo(c.points[rows], c.time_s[rows]))
    j = next(iter(track.claimed))
    gap_m = gap_in_line_m(track.centre, ahead, space.T_lidar_world[j], space.sensors)
    linked = linked_in_line(shape, bodies, ahead, gap_m)
    for j, rows, together in zip(list(track.claimed), found, linked, strict=True):
        track.claimed[j] = np.concatenate([track.claimed[j], rows[together]])


def _not_contradicted(
    track: Track, c: Obstacles, rows: np.ndarray, j: int, space: FreeSpace
) -> np.ndarray:
    """Those rows of sweep j that no sweep close in time sees through where they are carried to."""
    for i in space.others(j):
        if space.clock.near(i, j, _NEAR_S) and len(rows):
            body = track.undo(c.points[rows], c.time_s[rows])
            rows = rows[~track.seen_through(body, i, space)]
    return rows


def _refine(track: Track, obstacles: Sequence[Obstacles], ground: HeightMap) -> None:
    """Align every look once more, with what others saw, if that makes the motion smoother.

    Followed look by look, an object whose other side comes into view drifts: the first shape is
    all there is to hold on to. The even looks are aligned with the shape that the odd ones show,
    and the other way round, so that no look holds on to itself.
    """
    sweeps: tuple[list[int], list[int]] = [], []
    for n, sighting in sorted(track.sightings.items()):
        sweeps[n % 2].extend(sighting.sweeps)
    shapes = [track.seen_in(obstacles, some) for some in sweeps]
    if not all(map(len, shapes)):
        return
    models = [Model(x) for x in shapes]
    before = dict(track.sightings), track.path
    for n, sighting in track.sightings.items():
        at_s = sighting.seen_s
        points = track.place(track.seen_in(obstacles, sighting.sweeps), at_s)
        state = models[1 - n % 2].align(points, track.centre, track.path(at_s), _REFINED_STD)
        if state is not None:
            state[2] = track.rise_m(ground, state)
            track.sightings[n] = replace(sighting, state=state)
    track.smooth()
    if track.path.residual_m > before[1].residual_m:
        track.sightings, track.path = before
