# SPDX-License-Identifier: MIT
"""The search for moving objects: clusters of candidates are tracked, and kept if confirmed.

A track is the accumulated points of a cluster and one rigid pose per batch of sweeps. It starts
from the velocity that most batches agree on, is followed both ways, is smoothed in time, and is
confirmed only if the smooth motion explains the measurements.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy import ndimage

from densify.flow.surface_matching import Model
from densify.flow.tracking.candidates import LINK_M, Batch, Obstacles, height_weight
from densify.flow.tracking.extent import columns_apart_m
from densify.flow.tracking.following import (
    MIN_POINTS,
    Follower,
    find_ends,
    find_starts,
    velocities_beside,
)
from densify.flow.tracking.objects import MovingObject, Shape, Track
from densify.flow.tracking.proof import find_places_left, is_rail, violations_left
from densify.flow.tracking.vote import DistanceField, Group, vote
from densify.free_space.ground import HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.linking import link
from densify.geometry.types import Bool, Float, Int

_FIT_M = 0.3
_NEAR_S = 0.3
_REFINED_STD = np.array([0.15, 0.15, 0.03])  # m, m, rad: of the smooth motion
_CLEARLY = 0.5  # of the violations of another motion
_DOUBTFUL = 0.0025  # share of violations from which on a track is followed from its ends too
_AS_WHOLE = 0.9  # of its points
_MOSTLY = 0.5
_AHEAD_M, _SIDE_M = 15.0, 0.1
_COLUMNS_IN_GAP, _GAPS_IN_LINE_M = 2.0, (1.5, 4.0)
_ONE_RING, _ONE_COLUMN = 0.5, 2.5  # spread of one, in steps of rings and of columns


def find_tracks(
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    ground: HeightMap,
    velocities_m_s: Sequence[Float] | None = None,
) -> list[Track]:
    """Return the confirmed tracks of all moving objects in the stretch.

    velocities_m_s: per sweep (C,3) of its obstacles, with which clusters start; None lets the
    neighbouring sweeps vote.
    """
    search = _Search(obstacles, space, ground, velocities_m_s)
    starts = find_starts([batch.obstacles for batch in search.batches], search.clock)
    return search.tracks_of(starts) + search.tracks_of(starts, left_over=True)


class _Search:
    """The batches, the points that no track has claimed, and the objects found so far."""

    def __init__(
        self,
        obstacles: Sequence[Obstacles],
        space: FreeSpace,
        ground: HeightMap,
        velocities_m_s: Sequence[Float] | None,
    ) -> None:
        self._obstacles, self._space, self._ground = obstacles, space, ground
        self._velocities_m_s = velocities_m_s
        self.batches = [Batch.of(sweeps, obstacles, space.clock) for sweeps in space.batches]
        self.clock = Clock(np.array([batch.time_ns for batch in self.batches]))
        self._free, self._objects = self._all_points(), list[MovingObject]()
        self._follower = Follower(self.batches, self._free, ground, self.clock)
        self._fields: list[list[DistanceField]] = []
        if velocities_m_s is None:
            of_sweeps = [
                DistanceField.of(c.points[c.candidate], c.time_s[c.candidate]) for c in obstacles
            ]
            self._fields = [[of_sweeps[j] for j in batch.sweeps] for batch in self.batches]

    def _all_points(self) -> list[Bool]:
        return [np.ones(len(c.points), bool) for c in self._obstacles]

    def tracks_of(self, starts: Sequence[tuple[int, Int]], left_over: bool = False) -> list[Track]:
        """Return the confirmed tracks that begin at these starts, a batch and its rows each.

        left_over: track the remaining clusters where rings lie far apart, with a lower weight of
        heights; clusters that may be a part of a known object are left out.
        """
        untried, tracks = self._all_points(), list[Track]()
        for n, cluster in starts:
            batch = self.batches[n]
            untaken = batch.gather(self._free)[cluster] & batch.gather(untried)[cluster]
            members = cluster[untaken]
            if len(members) < MIN_POINTS:
                continue
            place = batch.obstacles.points[members].mean(axis=0)
            gap_m = self._space.gap_m(place, batch.sweeps[0])
            weights = self._height_weights(gap_m)[left_over:]
            if not weights or (left_over and self._is_part(n, members, gap_m)):
                continue
            track, confirmed = self._track_of(members, n, weights)
            for j, rows in track.claimed.items():
                untried[j][rows] = False
            if confirmed:
                self._take(track)
                tracks.append(track)
        return tracks

    def _height_weights(self, gap_m: float) -> list[float]:
        """Return the weights of heights to track with. Where rings lie far apart, they hit an
        approaching object at other heights than in the sweep before."""
        less = float(height_weight(gap_m))
        return [1.0, less] if less < 1.0 and not self._space.sensors.scattered else [1.0]

    def _is_part(self, n: int, members: Int, reach_m: float) -> bool:
        """Return True if most of a cluster lies within a known object or so close to it."""
        c = self.batches[n].obstacles
        points, time_s = c.points[members], c.time_s[members]
        return any(
            shape.near(track.undo(points, time_s), reach_m).mean() > _MOSTLY
            for track, shape in self._objects
        )

    def _track_of(self, members: Int, n: int, weights: Sequence[float]) -> tuple[Track, bool]:
        """Return the track of a cluster of batch n, complete if confirmed, and whether it is.

        weights: of heights; further ones are tried where the first leaves doubts.
        """
        track, left = self._followed(members, n, weights[0])
        for weight in weights[1:] if _DOUBTFUL < left < np.inf else ():
            tried, violations = self._followed(members, n, weight)
            if tried.total_points() >= track.total_points() and violations < _CLEARLY * left:
                track, left = tried, violations
        confirmed = bool(np.isfinite(left))
        if confirmed:
            self._gather(track)
            # A piece of a guard rail is recognised by the rest of it.
            confirmed = not is_rail(track, self._obstacles, self._space, self._objects)
        if confirmed and weights[0] < 1.0:  # rings glide over parked cars the more easily then
            left_places = find_places_left(track, self._obstacles, self._space, self._objects)
            confirmed = left_places.mostly_empty()
        if confirmed:
            _refine(track, self._obstacles, self._ground)
            self._claim_in_line(track)
        return track, confirmed

    def _take(self, track: Track) -> None:
        """Mark the track's points as taken, and remember the object."""
        for j, rows in track.claimed.items():
            self._free[j][rows] = False
        points = track.points_in(self._obstacles, sorted(track.claimed))
        self._objects.append(MovingObject(track, Shape.of(points)))

    def _followed(self, members: Int, n: int, weight: float) -> tuple[Track, float]:
        """Return the best track of a cluster of batch n, as `_best_of`: from there, or from one of
        its ends if as many points have clearly fewer violations."""
        beside = velocities_beside(self.batches[n], members, self._objects)
        starts: Iterator[Float] = chain([self._velocity_of(members, n)], beside)
        track, left = _best_of(self._follow(members, n, velocity, weight) for velocity in starts)
        # What is not confirmed is only followed from where more of it was observed.
        least = track.num_points(next(iter(track.observations))) if np.isinf(left) else 0
        for rows, k in find_ends(track, self.batches) if left > _DOUBTFUL else ():
            if len(rows) <= least:
                continue
            tried, violations = self._follow(rows, k, self._velocity_of(rows, k), weight)
            whole = tried.total_points() >= _AS_WHOLE * track.total_points()
            if whole and violations is not None and violations < _CLEARLY * left:
                track, left = tried, violations
        return track, left

    def _velocity_of(self, members: Int, n: int) -> Float:
        """Return the likely velocity (3,) m/s of a cluster of batch n."""
        c = self.batches[n].obstacles
        if self._velocities_m_s is None:
            group = Group.of(c.points[members], c.time_s[members])
            velocity = vote(group, n, self._fields, self.clock)
        else:
            velocity = np.median(self.batches[n].gather(self._velocities_m_s)[members], axis=0)
        return velocity

    def _follow(
        self, members: Int, n: int, velocity: Float, weight: float
    ) -> tuple[Track, float | None]:
        """Return the track of a cluster of batch n, and its share of violations, see
        `violations_left`."""
        track = self._follower.follow(members, n, velocity, weight)
        return track, violations_left(track, self._obstacles, self._space, self._objects)

    def _gather(self, track: Track) -> None:
        """Claim the free candidates close to or within the object that its motion explains, before
        a part of it starts a track of its own."""
        shape = Shape.of(track.points_in(self._obstacles, sorted(track.claimed)))
        for j, own in track.claimed.items():
            c = self._obstacles[j]
            there = track.place(shape.rim, track.seen_at(self._space.clock.time_ns[j]))
            rows = c.strips.rows_inside(there.min(0) - 2 * _FIT_M, there.max(0) + 2 * _FIT_M)
            rows = self._unclaimed(j, rows, own)
            rows = rows[shape.near(track.undo(c.points[rows], c.time_s[rows]), _FIT_M)]
            track.claimed[j] = np.concatenate([own, self._without_violations(track, j, rows)])

    def _claim_in_line(self, track: Track) -> None:
        """Claim the free clusters of single rings and columns ahead of and behind the object.

        On a roof, or a side that falls away from the scanner, they lie too far apart to be linked.
        Tracked alone, such a cluster would stay where the rays are.
        """
        space = self._space
        shape = Shape.of(track.points_in(self._obstacles, sorted(track.claimed)))
        ahead = MovingObject(track, shape).heading(next(iter(track.observations.values())).seen_s)
        across = np.array([-ahead[1], ahead[0]])
        aside = shape.rim[:, :2] @ across
        found, parts = {}, [shape.points]
        for j, own in track.claimed.items():
            c, T_lidar_world = self._obstacles[j], space.T_lidar_world[j]
            there = track.place(shape.rim, track.seen_at(space.clock.time_ns[j]))
            rows = c.strips.rows_inside(there.min(0) - _AHEAD_M, there.max(0) + _AHEAD_M)
            rows = self._unclaimed(j, rows, own)
            rows = rows[_few_rays(c, rows, T_lidar_world, space.sensors)]
            points = track.undo(c.points[rows], c.time_s[rows])
            side = points[:, :2] @ across
            fits = (side > aside.min() - _SIDE_M) & (side < aside.max() + _SIDE_M)
            fits &= points[:, 2] < shape.rim[:, 2].max() + _SIDE_M
            found[j] = self._without_violations(track, j, rows[fits])
            parts.append(track.undo(c.points[found[j]], c.time_s[found[j]]))
        j = next(iter(track.claimed))
        columns_m = columns_apart_m(track.centre, ahead, space.T_lidar_world[j], space.sensors)
        gap_m = float(np.clip(_COLUMNS_IN_GAP * columns_m, *_GAPS_IN_LINE_M))
        points = np.concatenate(parts)
        points[:, :2] -= (1 - LINK_M / gap_m) * (points[:, :2] @ ahead)[:, None] * ahead
        _, group = link(points, LINK_M)
        linked = np.isin(group, group[: len(shape.points)])
        ends = np.cumsum([len(part) for part in parts])
        for (j, rows), together in zip(found.items(), np.split(linked, ends)[1:-1], strict=True):
            track.claimed[j] = np.concatenate([track.claimed[j], rows[together]])

    def _unclaimed(self, j: int, rows: Int, own: Int) -> Int:
        """Return the free candidates among rows of sweep j, without the track's own."""
        rows = rows[self._free[j][rows] & (self._obstacles[j].cluster[rows] >= 0)]
        return np.setdiff1d(rows, own, assume_unique=True)

    def _without_violations(self, track: Track, j: int, rows: Int) -> Int:
        """Return the rows of sweep j that no sweep close in time sees through, once moved."""
        c = self._obstacles[j]
        for i in self._space.others(j):
            if self._space.clock.near(i, j, _NEAR_S) and len(rows):
                in_object = track.undo(c.points[rows], c.time_s[rows])
                rows = rows[~track.seen_through(in_object, i, self._space)]
        return rows


def _few_rays(c: Obstacles, rows: Int, T_lidar_world: Float, sensors: Sensors) -> Bool:
    """Return (N,) True where the cluster of a row is hit by one ring, or one column, only."""
    if not len(rows):
        return np.zeros(0, bool)
    clusters, of_row = np.unique(c.cluster[rows], return_inverse=True)
    members = np.flatnonzero(np.isin(c.cluster, clusters))
    label, in_lidar = c.cluster[members], poses.transform(T_lidar_world, c.points[members])

    def spread(values: Float) -> Float:
        low, high = (f(values, label, clusters) for f in (ndimage.minimum, ndimage.maximum))
        return np.asarray(high) - np.asarray(low)

    range_m = np.linalg.norm(in_lidar, axis=1)
    ring_rad = ndimage.minimum(sensors.finest_gap_m(in_lidar) / range_m, label, clusters)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    x, y = in_lidar[:, :2].mean(axis=0)
    azimuth_rad = np.arctan2(in_lidar[:, :2] @ [-y, x], in_lidar[:, :2] @ [x, y])
    single = spread(np.arcsin(in_lidar[:, 2] / range_m)) < _ONE_RING * np.asarray(ring_rad)
    single |= spread(azimuth_rad) < _ONE_COLUMN * column_rad
    return np.asarray(single[of_row.ravel()])


def _best_of(tried: Iterable[tuple[Track, float | None]]) -> tuple[Track, float]:
    """Return the confirmed track with the lowest share of violations, and the share; the last track
    and inf if none is confirmed. Stops at a track without violations.

    tried: tracks and their shares, None if they are not confirmed.
    """
    best, least = Track(np.zeros(3)), np.inf
    for track, violations in tried:
        if violations is not None and violations < _CLEARLY * least:
            best, least = track, violations
        elif np.isinf(least):
            best = track
        if least == 0:
            break
    return best, least


def _refine(track: Track, obstacles: Sequence[Obstacles], ground: HeightMap) -> None:
    """Align every observation once more, and keep the result if the motion becomes smoother.

    Followed batch by batch, an object drifts when its other side comes into view. Even batches are
    aligned with the points of the odd ones, and the other way round.
    """
    sweeps: tuple[list[int], list[int]] = [], []
    for n, seen in sorted(track.observations.items()):
        sweeps[n % 2].extend(seen.sweeps)
    points = [track.points_in(obstacles, some) for some in sweeps]
    if not all(map(len, points)):
        return
    models = [Model(x) for x in points]
    before = dict(track.observations), track.path
    for n, seen in track.observations.items():
        target = track.place(track.points_in(obstacles, seen.sweeps), seen.seen_s)
        predicted = track.path(seen.seen_s)
        state = models[1 - n % 2].align(target, track.centre, predicted, _REFINED_STD)
        if state is not None:
            state[2] = track.rise_m(ground, state)
            track.observations[n] = replace(seen, state=state)
    track.smooth()
    if track.path.residual_m > before[1].residual_m:
        track.observations, track.path = before
