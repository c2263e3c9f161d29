# SPDX-License-Identifier: MIT
"""Search for moving objects: clusters of candidates are tracked, and kept if confirmed.

A track starts from the velocity that most batches (sweeps within 0.1 s) agree on, is followed both
ways, and is smoothed in time. It is confirmed only if the smooth motion explains the measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from densify.flow.surface_matching import Model
from densify.flow.tracking.candidates import LINK_M, Batch, Obstacles
from densify.flow.tracking.extent import NUM_COLUMNS, columns_apart_m
from densify.flow.tracking.following import (
    FIT_M,
    MIN_POINTS,
    PREDICTION_STD,
    Follower,
    find_starts,
    velocities_beside,
)
from densify.flow.tracking.likelihood import NUM_ASKED, Judge, Verdict, judge
from densify.flow.tracking.objects import LANE_M, MovingObject, Shape, Track
from densify.flow.tracking.vote import DistanceField, Group, vote
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
        c = self.batches[n].obstacles
        if self._velocities_m_s is None:
            group = Group.of(c.points[members], c.time_s[members])
            velocity = vote(group, n, self._fields, self.clock)
        else:
            velocity = np.median(self.batches[n].gather(self._velocities_m_s)[members], axis=0)
        return velocity

    def _may_move(self, members: Int, n: int, velocity: Float) -> bool:
        """Return True if other sweeps see less often through ``members`` once they are moved."""
        c, rows = self.batches[n].obstacles, members[:: len(members) // NUM_ASKED + 1]
        points, time_s = c.points[rows], c.time_s[rows]
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

    def _track_of(self, members: Int, n: int, velocities: Sequence[Float]) -> tuple[Track, Verdict]:
        """Return the most likely track of ``members`` of batch n's obstacles, and its verdict."""
        # best, restarted: a track and its verdict. Other velocities if violations remain.
        best = self._follow(members, n, velocities[0])
        for velocity in velocities[1:]:
            if best[1].is_clearly_below(best[1].at_most):
                best = _better(best, self._follow(members, n, velocity))
        track, verdict = best
        # At its ends more may be in view than one side that slides along itself.
        if verdict.moves and verdict.is_clearly_below(verdict.at_most):
            for k in sorted({min(track.observations), max(track.observations)} - {n}):
                rows = track.rows_in(self.batches[k])
                if len(rows) >= MIN_POINTS:
                    restarted = self._follow(rows, k, self._velocity_of(rows, k))
                    if restarted[0].total_points() >= _AS_WHOLE * track.total_points():
                        best = _better(best, restarted)
        return best

    def _follow(self, members: Int, n: int, velocity: Float) -> tuple[Track, Verdict]:
        track = self._follower.follow(members, n, velocity)
        if len(track.observations) > 1:
            track.smooth()
        return track, judge(track, self._obstacles, self._space, self._objects, self._judged)

    def _gather(self, track: Track) -> None:
        """Claim free candidates in or near the object that its motion explains, in place."""
        # Otherwise these points would start a track of their own.
        shape = self._shape_of(track)
        for j, claimed in track.claimed.items():
            c = self._obstacles[j]
            rim = track.place(shape.rim, track.seen_at(self._space.clock.time_ns[j]))
            rows = c.strips.rows_inside(rim.min(0) - LINK_M, rim.max(0) + LINK_M)
            rows = self._unclaimed(j, rows, claimed)
            rows = rows[shape.near(track.undo(c.points[rows], c.time_s[rows]), FIT_M)]
            track.claimed[j] = np.concatenate([claimed, self._without_violations(track, j, rows)])

    def _claim_in_line(self, track: Track) -> None:
        """Claim free clusters of single rings or columns ahead of and behind the object."""
        # On a roof, or on a side that recedes from the scanner, they are too far apart to link.
        # Tracked alone, such a cluster would stay where the rays are.
        space, shape = self._space, self._shape_of(track)
        at_s = next(iter(track.observations.values())).seen_s
        lane = MovingObject(track, shape).lane(at_s)
        rows_in_line, clouds = {}, [track.place(shape.points, at_s)]
        for j, claimed in track.claimed.items():
            c = self._obstacles[j]
            rim = track.place(shape.rim, track.seen_at(space.clock.time_ns[j]))
            rows = c.strips.rows_inside(rim.min(0) - LANE_M, rim.max(0) + LANE_M)
            rows = self._unclaimed(j, rows, claimed)
            rows = rows[_few_rays(c, rows, space.T_lidar_world[j], space.sensors)]
            rows = rows[lane.holds(track.carry(c.points[rows], c.time_s[rows], at_s))]
            rows_in_line[j] = rows = self._without_violations(track, j, rows)
            clouds.append(track.carry(c.points[rows], c.time_s[rows], at_s))
        j = next(iter(track.claimed))
        columns_m = columns_apart_m(track.centre, lane.ahead, space.T_lidar_world[j], space.sensors)
        gap_m = float(np.clip(NUM_COLUMNS * columns_m, *_GAPS_IN_LINE_M))
        points = np.concatenate(clouds)
        points[:, :2] -= (1 - LINK_M / gap_m) * (points[:, :2] @ lane.ahead)[:, None] * lane.ahead
        _, group = link(points, LINK_M)
        linked = np.isin(group, group[: len(shape.points)])
        ends = np.cumsum([len(cloud) for cloud in clouds])
        for (j, rows), kept in zip(rows_in_line.items(), np.split(linked, ends)[1:-1], strict=True):
            track.claimed[j] = np.concatenate([track.claimed[j], rows[kept]])

    def _unclaimed(self, j: int, rows: Int, claimed: Int) -> Int:
        """Return the ``rows`` of sweep j's obstacles that are free candidates, not ``claimed``."""
        rows = rows[self._free[j][rows] & (self._obstacles[j].cluster[rows] >= 0)]
        return np.setdiff1d(rows, claimed, assume_unique=True)

    def _without_violations(self, track: Track, j: int, rows: Int) -> Int:
        """Return those ``rows`` of sweep j that, moved with the track, are never seen through."""
        c = self._obstacles[j]
        for i in self._space.others(j):
            if self._space.clock.near(i, j, _NEAR_S) and len(rows):
                in_object = track.undo(c.points[rows], c.time_s[rows])
                rows = rows[~track.seen_through(in_object, i, self._space)]
        return rows


def _better(best: tuple[Track, Verdict], trial: tuple[Track, Verdict]) -> tuple[Track, Verdict]:
    """Return the found track and verdict if clearly more likely, else the known track."""
    return trial if best[1].is_clearly_below(trial[1].log_odds) else best


def _few_rays(c: Obstacles, rows: Int, T_lidar_world: Float, sensors: Sensors) -> Bool:
    """Return (N,) True for ``rows`` of ``c`` whose cluster is hit by a single ring or column."""
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
