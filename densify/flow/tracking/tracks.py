# SPDX-License-Identifier: MIT
"""Search for moving objects: clusters of candidates are tracked, and kept if confirmed.

A track starts from the velocity that most batches (sweeps within 0.1 s) agree on, is followed both
ways, and is smoothed in time. It is confirmed only if the smooth motion explains the measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from densify.flow.surface_matching import Model
from densify.flow.tracking.candidates import LINK_M, Batch, Obstacles
from densify.flow.tracking.extent import NUM_COLUMNS, columns_apart_m
from densify.flow.tracking.following import (
    FIT_M,
    MIN_POINTS,
    PREDICTION_STD,
    DistanceField,
    Follower,
    Group,
    find_starts,
    velocities_beside,
    vote,
)
from densify.flow.tracking.likelihood import NUM_ASKED, Judge, Verdict, judge
from densify.flow.tracking.objects import LANE_M, MovingObject, Shape, Track
from densify.free_space.ground import HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import link
from densify.geometry.types import Bool, Float, Int

_NEAR_S = 0.3
_REFINED_STD = PREDICTION_STD / 2  # of the smooth motion
_AS_WHOLE = 0.9  # share of the known track's points that a better track must keep
_GAPS_IN_LINE_M = (1.5, 4.0)
_ONE_RING, _ONE_COLUMN = 0.5, 2.5  # spread of a single ring or column, in steps


def find_tracks(
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    ground: HeightMap,
    velocities_m_s: Sequence[Float] | None = None,
    judged: Judge | None = None,
) -> list[Track]:
    """Return the confirmed tracks of all moving objects in the stretch (consecutive sweeps).

    ``velocities_m_s`` are, for each sweep, (C,3) of its obstacles, world frame, at which clusters
    start. None lets the neighbouring sweeps vote. ``judged`` is called with each track that was
    tried, and its evidence.
    """
    return _Search(obstacles, space, ground, velocities_m_s, judged).tracks()


class _Trial(NamedTuple):
    """A track that was tried, and its verdict."""

    track: Track
    verdict: Verdict

    @property
    def leaves_much_unexplained(self) -> bool:
        """True if a motion without violations would be clearly more likely."""
        return self.verdict.is_clearly_below(self.verdict.at_most)

    def or_better(self, other_trial: _Trial) -> _Trial:
        """Return the other trial if it is clearly more likely, else this one."""
        return other_trial if self.verdict.is_clearly_below(other_trial.verdict.log_odds) else self


class _Search:
    """State of the search: batches, points free until a track claims them, and objects found."""

    def __init__(
        self,
        obstacles: Sequence[Obstacles],
        space: FreeSpace,
        ground: HeightMap,
        velocities_m_s: Sequence[Float] | None,
        judged: Judge | None,
    ) -> None:
        self._obstacles, self._space, self._ground = obstacles, space, ground
        self._judged = judged
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

    def tracks(self) -> list[Track]:
        """Return the confirmed tracks; tracks from the best starting clusters come first."""
        untried = self._all_points()
        for n, cluster in find_starts([batch.obstacles for batch in self.batches], self.clock):
            batch = self.batches[n]
            untaken = batch.gather(self._free)[cluster] & batch.gather(untried)[cluster]
            members = cluster[untaken]
            if len(members) < MIN_POINTS:
                continue
            beside = velocities_beside(self.batches[n], members, self._objects)
            velocities = [self._velocity_of(members, n), *beside]
            velocities = [v for v in velocities if self._may_move(members, n, v)]
            if not velocities:
                continue
            track, verdict = self._track_of(members, n, velocities)
            for j, rows in track.claimed.items():
                untried[j][rows] = False
            if verdict.moves:
                self._keep(track)
        return [track for track, _ in self._objects]

    def _keep(self, track: Track) -> None:
        """Keep a confirmed track, with all points that its motion explains."""
        self._gather(track)
        _refine(track, self._obstacles, self._ground)
        self._claim_in_line(track)
        for j, rows in track.claimed.items():
            self._free[j][rows] = False
        self._objects.append(MovingObject(track, self._shape_of(track)))

    def _shape_of(self, track: Track) -> Shape:
        return Shape.of(track.points_in(self._obstacles, sorted(track.claimed)))

    def _velocity_of(self, members: Int, n: int) -> Float:
        """Return the likely velocity (3,), m/s, world, of ``members`` of batch n's obstacles."""
        batch = self.batches[n]
        if self._velocities_m_s is not None:
            return np.asarray(np.median(batch.gather(self._velocities_m_s)[members], axis=0))
        group = Group.of(batch.obstacles.points[members], batch.obstacles.time_s[members])
        return vote(group, n, self._fields, self.clock)

    def _may_move(self, members: Int, n: int, velocity: Float) -> bool:
        """Return True if other sweeps see less often through ``members`` once they are moved."""
        obstacles, rows = self.batches[n].obstacles, members[:: len(members) // NUM_ASKED + 1]
        points, time_s = obstacles.points[rows], obstacles.time_s[rows]
        velocity_m_s = np.repeat([velocity, np.zeros(3)], len(rows), axis=0)
        num_seen_through = np.zeros(2, np.int64)  # moved, static
        for m, batch in enumerate(self.batches):
            if m != n and self.clock.near(m, n, _NEAR_S):
                j = batch.sweeps[0]
                moved = points + (self._space.clock.time_s[j] - time_s)[:, None] * velocity
                asked = np.concatenate([moved, points])
                seen_through = self._space.seen_through(asked, j, velocity_m_s)
                num_seen_through += seen_through.reshape(2, -1).sum(axis=1)
        # without any evidence they may move
        return bool(num_seen_through[0] < num_seen_through[1] or not num_seen_through.any())

    def _track_of(self, members: Int, n: int, velocities: Sequence[Float]) -> _Trial:
        """Return the most likely track of ``members`` of batch n's obstacles."""
        best = self._follow(members, n, velocities[0])
        for velocity in velocities[1:]:
            if best.leaves_much_unexplained:
                best = best.or_better(self._follow(members, n, velocity))
        if not (best.verdict.moves and best.leaves_much_unexplained):
            return best
        # At its ends more may be in view than one side that slides along itself.
        track = best.track
        for end in sorted({min(track.observations), max(track.observations)} - {n}):
            rows = track.rows_in(self.batches[end])
            if len(rows) >= MIN_POINTS:
                restarted = self._follow(rows, end, self._velocity_of(rows, end))
                if restarted.track.total_points() >= _AS_WHOLE * track.total_points():
                    best = best.or_better(restarted)
        return best

    def _follow(self, members: Int, n: int, velocity: Float) -> _Trial:
        """Return the track of ``members`` of batch n's obstacles from a velocity (3,), m/s."""
        track = self._follower.follow(members, n, velocity)
        if len(track.observations) > 1:
            track.smooth()
        verdict = judge(track, self._obstacles, self._space, self._objects, self._judged)
        return _Trial(track, verdict)

    def _gather(self, track: Track) -> None:
        """Claim free candidates in or near the object that its motion explains, in place."""
        # Otherwise these points would start a track of their own.
        shape = self._shape_of(track)
        for j, claimed in track.claimed.items():
            rows = self._unclaimed_around(track, shape, j, LINK_M)
            rows = rows[shape.near(track.in_object(self._obstacles[j], rows), FIT_M)]
            track.claimed[j] = np.concatenate([claimed, self._without_violations(track, j, rows)])

    def _claim_in_line(self, track: Track) -> None:
        """Claim free clusters of single rings or columns ahead of and behind the object."""
        # On a roof, or on a side that recedes from the scanner, they are too far apart to link.
        # Tracked alone, such a cluster would stay where the rays are.
        space, shape = self._space, self._shape_of(track)
        at_s = next(iter(track.observations.values())).seen_s
        lane = MovingObject(track, shape).lane(at_s)
        # (N,3) points of the object, then those in line of each sweep, all at one time
        rows_in_line, clouds = dict[int, Int](), [track.place(shape.points, at_s)]
        for j in track.claimed:
            obstacles, T_lidar_world = self._obstacles[j], space.T_lidar_world[j]
            rows = self._unclaimed_around(track, shape, j, LANE_M)
            rows = rows[_few_rays(obstacles, rows, T_lidar_world, space.sensors)]
            rows = rows[lane.holds(track.place(track.in_object(obstacles, rows), at_s))]
            rows_in_line[j] = rows = self._without_violations(track, j, rows)
            clouds.append(track.place(track.in_object(obstacles, rows), at_s))
        T_lidar_world = space.T_lidar_world[next(iter(track.claimed))]
        columns_m = columns_apart_m(track.centre, lane.ahead, T_lidar_world, space.sensors)
        gap_m = float(np.clip(NUM_COLUMNS * columns_m, *_GAPS_IN_LINE_M))
        # Shortened along the heading, gaps up to ``gap_m`` are linked.
        points = np.concatenate(clouds)
        points[:, :2] -= (1 - LINK_M / gap_m) * (points[:, :2] @ lane.ahead)[:, None] * lane.ahead
        _, group = link(points, LINK_M)
        is_linked = np.isin(group, group[: len(shape.points)])
        ends = np.cumsum([len(cloud) for cloud in clouds])
        in_sweeps = np.split(is_linked, ends)[1:-1]
        for (j, rows), is_linked in zip(rows_in_line.items(), in_sweeps, strict=True):
            track.claimed[j] = np.concatenate([track.claimed[j], rows[is_linked]])

    def _unclaimed_around(self, track: Track, shape: Shape, j: int, around_m: float) -> Int:
        """Return the rows of sweep j's obstacles, free candidates, in the box around the object."""
        obstacles = self._obstacles[j]
        rim = track.place(shape.rim, track.seen_at(self._space.clock.time_ns[j]))
        rows = obstacles.strips.rows_inside(rim.min(0) - around_m, rim.max(0) + around_m)
        rows = rows[self._free[j][rows] & (obstacles.cluster[rows] >= 0)]
        return np.setdiff1d(rows, track.claimed[j], assume_unique=True)

    def _without_violations(self, track: Track, j: int, rows: Int) -> Int:
        """Return those ``rows`` of sweep j that, moved with the track, are never seen through."""
        for i in self._space.others(j):
            if self._space.clock.near(i, j, _NEAR_S) and len(rows):
                in_object = track.in_object(self._obstacles[j], rows)
                rows = rows[~track.seen_through(in_object, i, self._space)]
        return rows


def _few_rays(obstacles: Obstacles, rows: Int, T_lidar_world: Float, sensors: Sensors) -> Bool:
    """Return (N,) True for ``rows`` whose cluster is hit by a single ring or column."""
    if not len(rows):
        return np.zeros(0, bool)
    clusters, of_row = np.unique(obstacles.cluster[rows], return_inverse=True)
    members = np.flatnonzero(np.isin(obstacles.cluster, clusters))
    label = obstacles.cluster[members]
    in_lidar = poses.transform(T_lidar_world, obstacles.points[members])

    def spread(values: Float) -> Float:
        lowest, highest = (f(values, label, clusters) for f in (ndimage.minimum, ndimage.maximum))
        return np.asarray(highest) - np.asarray(lowest)

    range_m = np.linalg.norm(in_lidar, axis=1)
    ring_rad = ndimage.minimum(sensors.finest_gap_m(in_lidar) / range_m, label, clusters)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    x, y = in_lidar[:, :2].mean(axis=0)
    azimuth_rad = np.arctan2(in_lidar[:, :2] @ [-y, x], in_lidar[:, :2] @ [x, y])
    is_single = spread(np.arcsin(in_lidar[:, 2] / range_m)) < _ONE_RING * np.asarray(ring_rad)
    is_single |= spread(azimuth_rad) < _ONE_COLUMN * column_rad
    return np.asarray(is_single[of_row.ravel()])


def _refine(track: Track, obstacles: Sequence[Obstacles], ground: HeightMap) -> None:
    """Align every observation again, in place; keep the result if the motion is smoother."""
    # Followed batch by batch, an object drifts when its other side comes into view. Therefore even
    # batches are aligned with the points of the odd batches, and the other way round.
    sweeps: tuple[list[int], list[int]] = [], []
    for n, seen in sorted(track.observations.items()):
        sweeps[n % 2].extend(seen.sweeps)
    points = [track.points_in(obstacles, half) for half in sweeps]
    if not all(map(len, points)):
        return
    models = [Model(x) for x in points]
    unrefined = dict(track.observations), track.path  # poses and path before
    for n, seen in track.observations.items():
        target = track.place(track.points_in(obstacles, seen.sweeps), seen.seen_s)
        predicted = track.path(seen.seen_s)
        state = models[1 - n % 2].align(target, track.centre, predicted, _REFINED_STD)
        if state is not None:
            state[2] = track.rise_m(ground, state)
            track.observations[n] = replace(seen, state=state)
    track.smooth()
    if track.path.residual_m > unrefined[1].residual_m:
        track.observations, track.path = unrefined
