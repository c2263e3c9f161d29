# SPDX-License-Identifier: MIT
"""Track one cluster of candidates as a rigid object from batch to batch, both ways in time.

A track starts at the velocity that the sweeps before and after it vote for. Candidates are aligned
with the object so far, from the pose of constant speed and turn rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from densify.flow.surface_matching import GATES_M, MIN_FIT, Model, apply, undo
from densify.flow.tracking.candidates import LINK_M, MIN_SEED_SHARE, Batch, Obstacles
from densify.flow.tracking.objects import Track
from densify.free_space.ground import HeightMap
from densify.geometry.clock import Clock
from densify.geometry.compiled import Kernel
from densify.geometry.nearest import bulk, nearest, tree_of
from densify.geometry.types import Bool, Float, Int

Bytes = NDArray[np.uint8]

MAX_SPEED_M_S = 38.0  # 137 km/h, greatest speed of the vote
_NEAR_S, _AROUND_S = 0.1, 0.5  # times to the nearest and the farthest batches that vote
STEP_M = 0.2  # side of a voxel
_MOST_VOXELS = 1 << 28  # voxels of a sweep, a byte each: 250 m x 250 m x 34 m
FEW_POINTS, _MANY_POINTS = 60, 600  # points of a cluster in the first vote, and in later votes


@dataclass(frozen=True)
class DistanceField:
    """A voxel grid of the distance to the nearest candidate of a sweep."""

    nearness: Bytes  # (X,Y,Z) voxels of 0.2 m: 255 at a candidate, falling to 0 at 0.6 m from it
    low: Float  # (3,) corner of the grid, world
    tree: cKDTree  # search tree of the N candidates
    time_s: Float  # (N,) firing times of the candidates

    @staticmethod
    def of(points: Float, time_s: Float) -> DistanceField:
        """Build the field of N > 0 candidates from points (N,3, world) and firing times (N,)."""
        # A candidate reaches 0.6 m far. The margin of the grid is twice as wide.
        inside = points[bulk(points, STEP_M, _MOST_VOXELS)]
        low = inside.min(0) - 2 * LINK_M
        shape = tuple(np.ceil((inside.max(0) + 2 * LINK_M - low) / STEP_M).astype(int) + 1)
        nearness = np.zeros(shape, np.uint8)
        # Offsets of the voxels around a candidate, and their nearness: 255 (1 - distance / 0.6 m)
        num_voxels = int(np.ceil(LINK_M / STEP_M))  # to each side
        span = np.arange(-num_voxels, num_voxels + 1)
        offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
        relative_distance = np.linalg.norm(offsets, axis=1) * STEP_M / LINK_M
        is_reached = relative_distance < 1
        values = (255 - np.round(255 * relative_distance[is_reached])).astype(np.uint8)
        _spread(inside, low, STEP_M, offsets[is_reached], values, nearness)
        return DistanceField(nearness, low, tree_of(points), time_s)

    def raise_nearness(self, nearness: Bytes, group: Group, velocities: Float) -> None:
        """Raise ``nearness`` (V,N), in place, to that of a group's N points at V velocities.

        Nearness is from 0 (no candidate within 0.6 m) to 255. The points are moved at velocities
        (V,3), m/s, world, to the time when this sweep fired at their new position.
        """
        # The firing time depends on the position, and the position on the time. The time is that of
        # the nearest candidate: first at the group's old position, then at the moved position.
        _, old_neighbour = nearest(self.tree, group.middle[None])
        moved = group.middle + (self.time_s[old_neighbour] - group.middle_s) * velocities
        _, moved_neighbour = nearest(self.tree, moved)
        elapsed_s = self.time_s[moved_neighbour] - group.middle_s
        _look_up.over_rows(
            len(velocities),
            group.points,
            group.offset_s,
            velocities,
            elapsed_s,
            self.low,
            1 / STEP_M,
            self.nearness,
            nearness,
        )


@dataclass(frozen=True)
class Group:
    """The N points of a cluster in one batch (consecutive sweeps within 0.1 s)."""

    points: Float  # (N,3) world
    offset_s: Float  # (N,) firing times since ``middle_s``
    middle_s: float  # mean firing time of the points
    middle: Float  # (3,) mean of the points

    @staticmethod
    def of(points: Float, time_s: Float) -> Group:
        """Build the group from points (N,3, world) and their firing times (N,) in seconds."""
        middle_s = float(time_s.mean())
        return Group(points, time_s - middle_s, middle_s, points.mean(axis=0))

    def thinned(self, max_points: int) -> Group:
        """Return the group with at most ``max_points`` of its points, chosen at equal steps."""
        step = len(self.points) // max_points + 1
        points = np.ascontiguousarray(self.points[::step])
        offset_s = np.ascontiguousarray(self.offset_s[::step])
        return Group(points, offset_s, self.middle_s, self.middle)


def vote(group: Group, n: int, fields: Sequence[Sequence[DistanceField]], clock: Clock) -> Float:
    """Return the horizontal velocity (3,), m/s, that brings a cluster nearest to candidates.

    These are the candidates of batches around the cluster's batch n, in the ``fields`` of their
    sweeps. First the batches about 0.1 and 0.2 s before and after are compared, in coarse steps of
    velocity. A flat side shows its speed only at its ends, which move by less than a voxel in this
    short time. Therefore batches up to 0.5 s away are compared too, in fine steps.
    """
    near_step_s = clock.num_in(_NEAR_S) * clock.period_ns * 1e-9
    # The farthest batches are two of these steps away.
    far_step_s = max(_AROUND_S / 2, near_step_s)
    near_fields = [fields[m] for m in _batches_around(n, near_step_s, clock)]
    all_fields = near_fields + [fields[m] for m in _batches_around(n, far_step_s, clock)]
    # First vote: all velocities, in steps that move the group by two voxels to the nearest batches
    few_points = group.thinned(FEW_POINTS)
    coarse_step_m_s = 2 * STEP_M / near_step_s
    coarse_grid = _grid(int(MAX_SPEED_M_S / coarse_step_m_s)) * coarse_step_m_s
    coarse_m_s = _best_velocity(few_points, near_fields, coarse_grid)
    # Second vote: thirds of the coarse step, up to two coarse steps (6 thirds) to each side
    many_points = group.thinned(_MANY_POINTS)
    medium_grid = coarse_m_s + _grid(6) * coarse_step_m_s / 3
    medium_m_s = _best_velocity(many_points, near_fields, medium_grid)
    # Last vote: steps of about 0.2 m/s (half a voxel in 0.5 s), up to one medium step to each side
    num_steps = max(1, round(coarse_step_m_s / 3 / 0.2))
    fine_grid = medium_m_s + _grid(num_steps) * coarse_step_m_s / 3 / num_steps
    return _best_velocity(many_points, all_fields, fine_grid)


def _batches_around(n: int, step_s: float, clock: Clock) -> list[int]:
    """Return the existing batches one and two steps of ``step_s`` before and after batch n."""
    batches = [clock.at(n, later_s) for later_s in (-2 * step_s, -step_s, step_s, 2 * step_s)]
    return sorted({m for m in batches if m is not None})


def _best_velocity(
    group: Group, fields: Sequence[Sequence[DistanceField]], velocities: Float
) -> Float:
    """Return the one of ``velocities`` (V,3) that brings a group nearest to candidates."""
    cost = np.zeros(len(velocities))
    for batch_fields in fields:
        # A point counts once per batch, by the sweep in which it comes nearest to a candidate.
        nearness = np.zeros((len(velocities), len(group.points)), np.uint8)
        for field in batch_fields:
            field.raise_nearness(nearness, group, velocities)
        cost += 1 - nearness.mean(axis=1) / 255
    # Of velocities with the same nearness the slowest is best.
    return np.asarray(velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))])


def _grid(num_steps: int) -> Float:
    """Return the vectors (V,3) with whole x and y from -num_steps to num_steps, and z 0."""
    span = np.arange(-num_steps, num_steps + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


@Kernel
def _spread(
    points: Float, low: Float, step: float, offsets: Int, values: Bytes, grid: Bytes
) -> None:
    """Raise the voxels of ``grid`` at ``offsets`` (K,3) from points (N,3) to ``values`` (K,)."""
    for i in range(len(points)):
        x = int((points[i, 0] - low[0]) / step)
        y = int((points[i, 1] - low[1]) / step)
        z = int((points[i, 2] - low[2]) / step)
        for k in range(len(offsets)):
            voxel = x + offsets[k, 0], y + offsets[k, 1], z + offsets[k, 2]
            grid[voxel] = max(grid[voxel], values[k])


@Kernel
def _look_up(
    first: int,  # first velocity of this thread
    last: int,  # end of the velocities of this thread
    points: Float,  # (N,3) world
    offset_s: Float,  # (N,) firing times since the group's middle time
    velocities: Float,  # (V,3) m/s
    elapsed_s: Float,  # (V,) from the group's middle time to the firing time at the moved position
    low: Float,  # (3,) corner of the grid, world
    voxels_per_m: float,
    grid: Bytes,  # (X,Y,Z) nearness of the voxels
    nearness: Bytes,  # (V,N) result
) -> None:
    """Raise ``nearness`` (V,N), in place, to the grid's at N points moved at V velocities."""
    num_x, num_y, num_z = grid.shape
    for v in range(first, last):
        for i in range(len(points)):
            # A point fired after the middle time has less time to move. Positions up to a voxel
            # below the grid are truncated to voxel 0, which is in the margin and has nearness 0.
            moving_s = elapsed_s[v] - offset_s[i]
            x = int((points[i, 0] + velocities[v, 0] * moving_s - low[0]) * voxels_per_m)
            y = int((points[i, 1] + velocities[v, 1] * moving_s - low[1]) * voxels_per_m)
            z = int((points[i, 2] + velocities[v, 2] * moving_s - low[2]) * voxels_per_m)
            if 0 <= x < num_x and 0 <= y < num_y and 0 <= z < num_z:
                nearness[v, i] = max(nearness[v, i], grid[x, y, z])


MIN_POINTS = 8  # to start a track
FIT_M = 0.3  # greatest distance of a point from the object that claims it
# Standard deviation (m, m, rad) of a prediction over 0.25 s; it grows with longer times.
PREDICTION_STD, _PREDICTION_S = np.array([0.3, 0.3, 0.06]), 0.25
_RECENT_S = 0.4  # age of the states that the rate is fitted to
# Weight of the velocity that a track starts at: that of states with this sum of squared times, such
# as two states 0.2 s apart
_START_RATE_S2 = 0.02
MAX_MISSED_S = 0.2  # time without points after which a track ends


def find_starts(batches: Sequence[Obstacles], clock: Clock) -> list[tuple[int, Int]]:
    """Return the clusters that may start a track, the largest first.

    Such a cluster has at least 8 points, 40 % of them seeds. Within 0.5 s of an end of the stretch
    a cluster counts as smaller, because fewer sweeps vote for its velocity.

    Returns:
        For each cluster the batch index, and the (K,) rows of its points in the batch's obstacles.
    """
    starts = []

    def rank(start: tuple[int, Int]) -> float:
        n, members = start
        # Each 0.1 s without votes costs 30 % of the size.
        missing_s = max(0.0, _AROUND_S - clock.from_end_s(n))
        return float(len(members) * 0.7 ** (missing_s / _NEAR_S))

    for n, obstacles in enumerate(batches):
        cluster, candidate = obstacles.cluster, obstacles.candidate
        size = np.bincount(cluster[candidate], minlength=obstacles.num_clusters)
        seed_cluster = cluster[candidate & obstacles.seed]
        num_seeds = np.bincount(seed_cluster, minlength=obstacles.num_clusters)
        may_start = (size >= MIN_POINTS) & (num_seeds >= MIN_SEED_SHARE * size)
        starts += [(n, np.flatnonzero(cluster == k)) for k in np.flatnonzero(may_start)]
    return sorted(starts, key=rank, reverse=True)


@dataclass(frozen=True)
class Follower:
    """Tracker that follows a cluster from batch to batch."""

    batches: Sequence[Batch]  # groups of consecutive sweeps within 0.1 s
    is_free: Sequence[Bool]  # for each sweep (C,) True for obstacles that no track has claimed
    ground: HeightMap  # height of the ground, on which objects move
    clock: Clock  # times of the batches

    def follow(self, members: Int, start: int, velocity: Float) -> Track:
        """Return the track of a cluster, followed forwards in time, then backwards.

        The cluster is at rows ``members`` of the obstacles of batch ``start``. Its track starts at
        a velocity (3,), m/s, world. All points found so far, in the object's frame, are the model
        with which the next points are aligned.
        """
        batch = self.batches[start]
        rate = np.append(velocity, 0.0)  # of the state, without a turn
        seen_s = float(batch.obstacles.time_s[members].mean())
        points = _at_once(batch.obstacles, members, rate, seen_s)
        track = Track(points.mean(0))
        track.add(start, batch, np.zeros(4), seen_s, members)
        model = Model(points)
        for direction in (1, -1):
            last_found = start  # batch index
            n = start + direction
            # An object that was not found in two batches may be found again within 0.2 s.
            while 0 <= n < len(self.batches) and (
                abs(n - last_found) <= 2 or self.clock.near(n, last_found, MAX_MISSED_S)
            ):
                if self._extend(track, model, rate, n):
                    last_found = n
                n += direction
        return track

    def _extend(self, track: Track, model: Model, rate: Float, n: int) -> bool:
        """Add the object's points in batch n to track and model; False if too few points fit."""
        centre = track.centre
        batch = self.batches[n]
        obstacles = batch.obstacles
        num_recent = self.clock.num_in(_RECENT_S)

        # Phase 1: free obstacles in the box around the expected position. The firing time of the
        # points is not known yet, hence the box grows by the motion within the batch.
        expected, expected_rate, _ = _predict(track, rate, num_recent, track.seen_at(batch.time_ns))
        expected_points = apply(expected, model.points, centre)
        slack_m = GATES_M[0] + batch.half_s * np.abs(expected_rate[:3])
        low, high = expected_points.min(0) - slack_m, expected_points.max(0) + slack_m
        free_rows = obstacles.strips.rows_inside(low, high)
        free_rows = free_rows[batch.gather(self.is_free)[free_rows]]
        rows = free_rows[obstacles.cluster[free_rows] >= 0]  # candidates
        min_num_rows = float(MIN_FIT)
        if len(rows) < MIN_FIT:
            # No sweep saw through the object here, hence the object has no candidates. Other
            # obstacles are taken if they are at least half as many as the object usually has.
            usual_num_rows = float(np.median([track.num_points(m) for m in track.observations]))
            rows = free_rows
            min_num_rows = max(MIN_FIT, usual_num_rows / 2)
        if len(rows) < min_num_rows:
            return False

        # Phase 2: alignment with the model, from the state predicted for the mean firing time
        seen_s = float(obstacles.time_s[rows].mean())
        predicted, predicted_rate, std = _predict(track, rate, num_recent, seen_s)
        predicted[2] = track.rise_m(self.ground, predicted)
        points = _at_once(obstacles, rows, predicted_rate, seen_s)
        state = model.align(points, centre, predicted, std)
        if state is None:
            return False
        state[2] = track.rise_m(self.ground, state)
        # Phase 3: only points that lie on the aligned model belong to the object.
        in_object = undo(state, points, centre)
        fits = model.covers(in_object, FIT_M)
        if fits.sum() < min_num_rows:
            return False
        track.add(n, batch, state, seen_s, rows[fits])
        model.add(in_object[fits])
        return True


def _at_once(obstacles: Obstacles, rows: Int, rate: Float, time_s: float) -> Float:
    """Return the obstacles ``rows`` (N,), moved to one time by the velocity ``rate[:3]``."""
    until_s = time_s - obstacles.time_s[rows]
    return obstacles.points[rows] + until_s[:, None] * rate[:3]


def _predict(
    track: Track, start_rate: Float, num_recent: int, time_s: float
) -> tuple[Float, Float, Float]:
    """Predict state (4,), rate (4,) per second and std (3,) of x, y (m), yaw (rad) at a time.

    Speed and turn rate are those of the nearest states, and constant.
    """
    # The velocity turns with the object (Schubert, Richter, Wanielik, "Comparison and Evaluation of
    # Advanced Motion Models for Vehicle Tracking", FUSION 2008).
    nearest_first = sorted(
        track.observations.items(), key=lambda item: (abs(item[1].seen_s - time_s), item[0])
    )
    recent = dict(nearest_first[:num_recent])  # by batch index
    states = np.stack([observation.state for observation in recent.values()])
    times_s = np.array([observation.seen_s for observation in recent.values()])
    ahead_s = time_s - times_s[0]  # from the nearest state
    middle_s = times_s.mean()
    rate = start_rate
    if len(times_s) > 1:
        # The slope of the least-squares line through the states is Σ t state / Σ t², with times t
        # from their mean. The velocity at which the track started counts as a further measurement
        # while the first observation is recent. This velocity says nothing about the turn rate.
        centred_s = times_s - middle_s
        first_batch = next(iter(track.observations))
        weight_s2 = np.full(4, _START_RATE_S2 * (first_batch in recent))
        weight_s2[3] = 0
        rate = (centred_s @ states + weight_s2 * start_rate) / (centred_s @ centred_s + weight_s2)
        rate[3] *= 0.9  # turns end, hence the turn rate falls
    std = PREDICTION_STD * max(1.0, abs(ahead_s) / _PREDICTION_S)
    # The slope is the rate at the mean time of the states. At constant turn rate, the mean rate
    # between the nearest state and ``time_s`` is the rate halfway between them.
    mean_rate = _turn(rate, time_s - 0.5 * ahead_s - middle_s)
    return states[0] + mean_rate * ahead_s, _turn(rate, time_s - middle_s), std


def _turn(rate: Float, duration_s: float) -> Float:
    """Return the rate (4,) of a state after ``duration_s``, at constant speed and turn rate."""
    cos, sin = np.cos(rate[3] * duration_s), np.sin(rate[3] * duration_s)
    x, y = rate[:2]
    return np.array([cos * x - sin * y, sin * x + cos * y, *rate[2:]])
