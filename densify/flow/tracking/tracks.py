# SPDX-License-Identifier: MIT
"""Search for moving objects: clusters of candidates are tracked, and kept if confirmed.

A track starts from the velocity that most batches (sweeps within 0.1 s) agree on, and is followed
both ways. It is confirmed only if its smooth motion explains the measurements.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from densify.flow.surface_matching import Model
from densify.flow.tracking.candidates import LINK_M, Batch, Obstacles
from densify.flow.tracking.extent import two_columns_m
from densify.flow.tracking.following import (
    FIT_M,
    MIN_POINTS,
    PREDICTION_STD,
    DistanceField,
    Follower,
    Group,
    find_starts,
    vote,
)
from densify.flow.tracking.likelihood import NUM_ASKED, RecordEvidence, Verdict, judge
from densify.flow.tracking.objects import BESIDE_M, LANE_M, Lane, MovingObject, Shape, Track
from densify.free_space.ground import HeightMap
from densify.free_space.range_image import FreeSpace
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import is_near, link, tree_of
from densify.geometry.types import Bool, Float, Int

_NEAR_S = 0.3  # greatest time to the sweeps that test a motion
_PATH_STD = PREDICTION_STD / 2  # standard deviation (m, m, rad) of a smooth path
_GAPS_IN_LANE_M = (1.5, 4.0)  # least and greatest gap that is linked along the heading
_ONE_RING, _ONE_COLUMN = 0.5, 2.5  # spread of a single ring or column, in steps


def find_tracks(
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    ground: HeightMap,
    velocities_m_s: Sequence[Float] | None = None,
    record: RecordEvidence | None = None,
) -> list[Track]:
    """Return the confirmed tracks of all moving objects in the stretch (consecutive sweeps).

    Args:
        obstacles: Points above the ground of each sweep of the stretch.
        velocities_m_s: For each sweep, (C,3) velocities of its obstacles, world frame, at which
            tracks start. None lets the neighbouring sweeps vote.
        record: Called with each track that was tried, and its evidence.
    """
    return _Search(obstacles, space, ground, velocities_m_s, record).find_tracks()


class _Search:
    """State of the search: batches, points free until a track claims them, and objects found."""

    def __init__(
        self,
        obstacles: Sequence[Obstacles],
        space: FreeSpace,
        ground: HeightMap,
        velocities_m_s: Sequence[Float] | None,
        record: RecordEvidence | None,
    ) -> None:
        self._obstacles = obstacles
        self._space = space
        self._ground = ground
        self._record = record
        self._velocities_m_s = velocities_m_s
        self.batches = [Batch.of(sweeps, obstacles, space.clock) for sweeps in space.batches]
        self.clock = Clock(np.array([batch.time_ns for batch in self.batches]))
        # For each sweep (C,) True for obstacles that no track has claimed
        self._free = [np.ones(len(sweep.points), bool) for sweep in obstacles]
        self._objects = list[MovingObject]()
        self._follower = Follower(self.batches, self._free, ground, self.clock)
        # For each batch, the fields of its sweeps with candidates; empty if no vote is needed
        self._fields: list[list[DistanceField]] = []
        if velocities_m_s is None:
            for batch in self.batches:
                sweeps = [obstacles[j] for j in batch.sweeps if obstacles[j].candidate.any()]
                self._fields.append(
                    [DistanceField.of(s.points[s.candidate], s.time_s[s.candidate]) for s in sweeps]
                )

    def find_tracks(self) -> list[Track]:
        """Return the confirmed tracks; tracks from the best starting clusters come first."""
        is_untried = [np.ones(len(sweep.points), bool) for sweep in self._obstacles]
        for n, cluster in find_starts([batch.obstacles for batch in self.batches], self.clock):
            # Points of an earlier track, confirmed or rejected, start no other track.
            batch = self.batches[n]
            is_available = batch.gather(self._free)[cluster] & batch.gather(is_untried)[cluster]
            members = cluster[is_available]
            if len(members) < MIN_POINTS:
                continue
            # Velocities start a track only if they lower the number of violations, if any.
            proposed = [self._likely_velocity(members, n), *self._nearby_velocities(members, n)]
            velocities = [velocity for velocity in proposed if self._may_move(members, n, velocity)]
            if not velocities:
                continue
            verdict = self._track_of(members, n, velocities)
            for j, rows in verdict.track.claimed.items():
                is_untried[j][rows] = False
            if verdict.moves:
                self._confirm(verdict.track)
        return [track for track, _ in self._objects]

    def _confirm(self, track: Track) -> None:
        """Add a confirmed track to the objects, and claim all points that its motion explains."""
        self._claim_nearby(track)
        _realign(track, self._obstacles, self._ground)
        self._claim_in_lane(track)
        for j, rows in track.claimed.items():
            self._free[j][rows] = False
        self._objects.append(MovingObject(track, self._shape_of(track)))

    def _nearby_velocities(self, members: Int, n: int) -> Iterator[Float]:
        """Yield the velocity (3,), m/s, of each object within 1 m of ``members`` of batch n."""
        # A trailer has the velocity of the car that tows it. The measurements alone hardly show how
        # fast a long flat side moves along itself.
        points = self.batches[n].obstacles.points[members]
        tree = tree_of(points)
        for moving_object in self._objects:
            track = moving_object.track
            at_s = track.seen_at(self.batches[n].time_ns)
            if moving_object.may_be_near(points, at_s, BESIDE_M):
                object_points = track.place(moving_object.shape.points, at_s)
                if is_near(tree, object_points, BESIDE_M).any():
                    yield track.velocity_m_s(points.mean(0, keepdims=True), at_s)[0]

    def _shape_of(self, track: Track) -> Shape:
        """Return the shape of all points that a track has claimed."""
        return Shape.of(track.points_in(self._obstacles, sorted(track.claimed)))

    def _likely_velocity(self, members: Int, n: int) -> Float:
        """Return the likely velocity (3,), m/s, world, of ``members`` of batch n's obstacles."""
        batch = self.batches[n]
        if self._velocities_m_s is not None:
            return np.asarray(np.median(batch.gather(self._velocities_m_s)[members], axis=0))
        group = Group.of(batch.obstacles.points[members], batch.obstacles.time_s[members])
        return vote(group, n, self._fields, self.clock)

    def _may_move(self, members: Int, n: int, velocity: Float) -> bool:
        """Return True if other sweeps see less often through ``members`` once they are moved."""
        obstacles = self.batches[n].obstacles
        rows = members[:: len(members) // NUM_ASKED + 1]  # at most 60
        points = obstacles.points[rows]
        time_s = obstacles.time_s[rows]
        velocity_m_s = np.repeat([velocity, np.zeros(3)], len(rows), axis=0)
        num_moved = num_static = 0  # violations
        for m, batch in enumerate(self.batches):
            if m != n and self.clock.near(m, n, _NEAR_S):
                j = batch.sweeps[0]  # the first sweep stands for its batch
                moved = points + (self._space.clock.time_s[j] - time_s)[:, None] * velocity
                positions = np.concatenate([moved, points])
                is_violated = self._space.seen_through(positions, j, velocity_m_s)
                num_moved += int(is_violated[: len(rows)].sum())
                num_static += int(is_violated[len(rows) :].sum())
        # Points that no sweep saw through, moved or static, may move: nothing speaks against it.
        return num_moved < num_static or num_moved == num_static == 0

    def _track_of(self, members: Int, n: int, velocities: Sequence[Float]) -> Verdict:
        """Return the most likely track of ``members`` of batch n's obstacles."""
        best = self._follow(members, n, velocities[0])
        for velocity in velocities[1:]:
            if best.leaves_much_unexplained:
                best = best.or_better(self._follow(members, n, velocity))
        if best.moves and best.leaves_much_unexplained:
            return self._restart_from_ends(best, n)
        return best

    def _restart_from_ends(self, best: Verdict, n: int) -> Verdict:
        """Return the most likely of a track and its restarts from the first and last batch."""
        # A track that started at batch n from one flat side may have a wrong speed along that side.
        # In the first or the last batch, another side may be in view.
        track = best.track
        for end in sorted({min(track.observations), max(track.observations)} - {n}):
            batch = self.batches[end]
            sweeps = zip(batch.sweeps, batch.begins, strict=True)
            rows = np.concatenate(
                [track.claimed[j] + begin for j, begin in sweeps if j in track.claimed]
            )
            if len(rows) >= MIN_POINTS:
                restarted = self._follow(rows, end, self._likely_velocity(rows, end))
                if restarted.track.total_points() >= 0.9 * track.total_points():
                    best = best.or_better(restarted)
        return best

    def _follow(self, members: Int, n: int, velocity: Float) -> Verdict:
        """Follow ``members`` of batch n from a velocity (3,), m/s, and judge the track."""
        track = self._follower.follow(members, n, velocity)
        if len(track.observations) > 1:
            track.smooth()
        return judge(track, self._obstacles, self._space, self._objects, self._record)

    def _claim_nearby(self, track: Track) -> None:
        """Claim free candidates in or near the object that its motion explains, in place."""
        # Without this step, unclaimed points of the object would start a track of their own.
        shape = self._shape_of(track)
        for j, claimed in track.claimed.items():
            rows = self._unclaimed_around(track, shape, j, LINK_M)
            rows = rows[shape.near(track.in_object(self._obstacles[j], rows), FIT_M)]
            track.claimed[j] = np.concatenate([claimed, self._drop_violations(track, j, rows)])

    def _claim_in_lane(self, track: Track) -> None:
        """Claim free clusters of single rings or columns ahead of and behind the object."""
        # On a roof, or on a side that recedes from the scanner, neighbouring rings or columns are
        # too far apart to be linked. A cluster of one ring or column would seem static if it was
        # tracked alone: the ray that hits the passing side stays where it is.
        space = self._space
        shape = self._shape_of(track)
        at_s = next(iter(track.observations.values())).seen_s
        lane = MovingObject(track, shape).lane(at_s)
        rows_in_lane = dict[int, Int]()  # by sweep index
        # (N,3) points of the object, then those of each sweep in the lane, all moved to one time
        clouds = [track.place(shape.points, at_s)]
        for j in track.claimed:
            rows = self._rows_in_lane(track, shape, j, lane, at_s)
            rows_in_lane[j] = rows
            clouds.append(track.place(track.in_object(self._obstacles[j], rows), at_s))

        T_lidar_world = space.T_lidar_world[next(iter(track.claimed))]
        columns_m = two_columns_m(track.centre, lane.ahead, T_lidar_world, space.sensors)
        gap_m = float(np.clip(columns_m, *_GAPS_IN_LANE_M))
        # `link` joins points within `LINK_M`. Compressed along the heading by this ratio, points
        # with gaps up to ``gap_m`` are linked too.
        points = np.concatenate(clouds)
        points[:, :2] -= (1 - LINK_M / gap_m) * (points[:, :2] @ lane.ahead)[:, None] * lane.ahead
        _, group = link(points, LINK_M)
        is_linked = np.isin(group, group[: len(shape.points)])
        ends = np.cumsum([len(cloud) for cloud in clouds])
        is_linked_by_sweep = np.split(is_linked, ends)[1:-1]  # the first part is the object itself
        for (j, rows), linked in zip(rows_in_lane.items(), is_linked_by_sweep, strict=True):
            track.claimed[j] = np.concatenate([track.claimed[j], rows[linked]])

    def _rows_in_lane(self, track: Track, shape: Shape, j: int, lane: Lane, at_s: float) -> Int:
        """Return the rows of sweep j's free clusters of a single ring or column in a lane."""
        obstacles = self._obstacles[j]
        rows = self._unclaimed_around(track, shape, j, LANE_M)
        T_lidar_world = self._space.T_lidar_world[j]
        rows = rows[lane.holds(track.place(track.in_object(obstacles, rows), at_s))]
        rows = rows[_is_of_few_rays(obstacles, rows, T_lidar_world, self._space.sensors)]
        return self._drop_violations(track, j, rows)

    def _unclaimed_around(self, track: Track, shape: Shape, j: int, margin_m: float) -> Int:
        """Return the rows of free candidates of sweep j within a margin of an object's box."""
        obstacles = self._obstacles[j]
        rim = track.place(shape.rim, track.seen_at(self._space.clock.time_ns[j]))
        rows = obstacles.strips.rows_inside(rim.min(0) - margin_m, rim.max(0) + margin_m)
        rows = rows[self._free[j][rows] & (obstacles.cluster[rows] >= 0)]
        return np.setdiff1d(rows, track.claimed[j], assume_unique=True)

    def _drop_violations(self, track: Track, j: int, rows: Int) -> Int:
        """Return ``rows`` of sweep j but those that, moved with the track, are seen through."""
        for i in self._space.others(j):
            if self._space.clock.near(i, j, _NEAR_S) and len(rows):
                in_object = track.in_object(self._obstacles[j], rows)
                rows = rows[~track.seen_through(in_object, i, self._space)]
        return rows


def _is_of_few_rays(
    obstacles: Obstacles, rows: Int, T_lidar_world: Float, sensors: Sensors
) -> Bool:
    """Return the (N,) mask of ``rows`` (N,) whose cluster is hit by a single ring or column."""
    if not len(rows):
        return np.zeros(0, bool)
    # All points of the clusters count, also those that are not in ``rows``.
    clusters, cluster_of_row = np.unique(obstacles.cluster[rows], return_inverse=True)
    is_in_rows = np.zeros(obstacles.num_clusters + 1, bool)  # the last entry is for cluster -1
    is_in_rows[clusters] = True
    members = np.flatnonzero(is_in_rows[obstacles.cluster])
    label = obstacles.cluster[members]
    in_lidar = poses.transform(T_lidar_world, obstacles.points[members])

    def spread(values: Float) -> Float:  # (K,) range of the values in each cluster
        lowest = ndimage.minimum(values, label, clusters)
        highest = ndimage.maximum(values, label, clusters)
        return np.asarray(highest) - np.asarray(lowest)

    range_m = np.linalg.norm(in_lidar, axis=1)
    ring_rad = ndimage.minimum(sensors.finest_gap_m(in_lidar) / range_m, label, clusters)
    column_rad = min(model.azimuth_step_rad for model in sensors.models.values())
    # Azimuths relative to the mean direction, which keeps them away from the jump at 180 degrees
    x, y = in_lidar[:, :2].mean(axis=0)
    azimuth_rad = np.arctan2(in_lidar[:, :2] @ [-y, x], in_lidar[:, :2] @ [x, y])
    elevation_rad = np.arcsin(in_lidar[:, 2] / range_m)
    is_single = spread(elevation_rad) < _ONE_RING * np.asarray(ring_rad)
    is_single |= spread(azimuth_rad) < _ONE_COLUMN * column_rad
    return np.asarray(is_single[cluster_of_row.ravel()])


def _realign(track: Track, obstacles: Sequence[Obstacles], ground: HeightMap) -> None:
    """Align every observation of a track again, in place, if this makes the motion smoother."""
    # Followed batch by batch, an object drifts when its other side comes into view. Therefore even
    # batches are aligned with the points of the odd batches, and the other way round: points are
    # never aligned with themselves.
    even_sweeps, odd_sweeps = list[int](), list[int]()  # sweeps of the even and odd batches
    for n, observation in sorted(track.observations.items()):
        (odd_sweeps if n % 2 else even_sweeps).extend(observation.sweeps)
    clouds = [track.points_in(obstacles, sweeps) for sweeps in (even_sweeps, odd_sweeps)]
    if not all(map(len, clouds)):
        return  # observed in batches of one parity only
    models = [Model(cloud) for cloud in clouds]
    previous_observations = dict(track.observations)
    previous_path = track.path
    for n, observation in track.observations.items():
        points = track.points_in(obstacles, observation.sweeps)
        positions = track.place(points, observation.seen_s)
        predicted = track.path(observation.seen_s)
        other_model = models[1 - n % 2]
        state = other_model.align(positions, track.centre, predicted, _PATH_STD)
        if state is not None:
            state[2] = track.rise_m(ground, state)
            track.observations[n] = replace(observation, state=state)
    track.smooth()
    if track.path.residual_m > previous_path.residual_m:
        track.observations = previous_observations
        track.path = previous_path
