# SPDX-License-Identifier: MIT
"""Track one cluster of candidates as a rigid object from batch to batch, both ways in time.

Candidates are aligned with the object so far, from the pose of constant speed and turn rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from densify.flow.surface_matching import GATES_M, MIN_FIT, Model, apply, undo
from densify.flow.tracking.candidates import MIN_SEED_SHARE, Batch, Obstacles
from densify.flow.tracking.objects import BESIDE_M, MovingObject, Track
from densify.free_space.ground import HeightMap
from densify.geometry.clock import Clock
from densify.geometry.nearest import is_near, tree_of
from densify.geometry.types import Bool, Float, Int

MIN_POINTS = 8  # to start a track
_AROUND_S = 0.5  # farther than this from both ends of the recording, starts are equally good
_NEARER_END, _NEARER_END_S = 0.7, 0.1  # closer to an end, a start is worth 0.7 per 0.1 s
FIT_M = 0.3
"""Greatest distance of a point from the object that claims it."""
_SHARE_UNSEEN = 0.5  # least share of the object's usual number of points
# Standard deviation (m, m, rad) of a prediction over 0.25 s; it grows with longer times.
PREDICTION_STD, _PREDICTION_S = np.array([0.3, 0.3, 0.06]), 0.25
_RECENT_S = 0.4  # age of the states that the rate is fitted to
_GIVEN_S2 = 0.02  # the given velocity weighs as much as states with this sum of squared times
_TURNS_ON = 0.9  # share of the turn rate that is predicted: turns level out
_MISSES_ALLOWED, _MISSED_S = 1, 0.2  # a track ends when both are exceeded


def find_starts(batches: Sequence[Obstacles], clock: Clock) -> list[tuple[int, Int]]:
    """Return the clusters that may start a track, the best first: batch index, rows of obstacles.

    Large clusters make good models. Far from the ends of the recording, sweeps on both sides show
    how the object moves.
    """
    starts = []

    def worth(start: tuple[int, Int]) -> float:
        n, members = start
        nearer_s = max(0.0, _AROUND_S - clock.from_end_s(n))
        return float(len(members) * _NEARER_END ** (nearer_s / _NEARER_END_S))

    for n, c in enumerate(batches):
        size = np.bincount(c.cluster[c.candidate], minlength=c.num_clusters)
        seeds = np.bincount(c.cluster[c.candidate & c.seed], minlength=c.num_clusters)
        good = np.flatnonzero((size >= MIN_POINTS) & (seeds >= MIN_SEED_SHARE * size))
        starts += [(n, np.flatnonzero(c.cluster == k)) for k in good]
    return sorted(starts, key=worth, reverse=True)


def velocities_beside(
    batch: Batch, members: Int, objects: Sequence[MovingObject]
) -> Iterator[Float]:
    """Yield the velocity (3,), m/s, of each object within 1 m of a cluster, as of a tow car.

    The measurements alone hardly show how fast a long side slides along itself. ``members`` are the
    cluster's rows of the batch's obstacles.
    """
    points = batch.obstacles.points[members]
    tree, middle = tree_of(points), points.mean(0, keepdims=True)
    for moving_object in objects:
        track, at_s = moving_object.track, moving_object.track.seen_at(batch.time_ns)
        if (
            moving_object.may_be_near(points, at_s, BESIDE_M)
            and is_near(tree, track.place(moving_object.shape.points, at_s), BESIDE_M).any()
        ):
            yield track.velocity_m_s(middle, at_s)[0]


@dataclass(frozen=True)
class Follower:
    """Tracker of clusters through the batches."""

    batches: Sequence[Batch]  # groups of consecutive sweeps within 0.1 s
    free: Sequence[Bool]  # for each sweep (C,) True for obstacles that no track has claimed
    ground: HeightMap
    clock: Clock  # times of the batches

    def follow(self, members: Int, start: int, velocity: Float) -> Track:
        """Track a cluster forwards, then backwards; the model is made of all points found so far.

        ``members`` are rows of the obstacles of batch ``start``; ``velocity`` (3,) is m/s, world.
        """
        obstacles, rate = self.batches[start].obstacles, np.append(velocity, 0.0)
        seen_s = float(obstacles.time_s[members].mean())
        points = _at_once(obstacles, members, rate, seen_s)
        track = Track(points.mean(0))
        track.add(start, self.batches[start], np.zeros(4), seen_s, members)
        model = Model(points)
        for direction in (1, -1):
            last, n = start, start + direction
            while 0 <= n < len(self.batches) and (
                abs(n - last) <= 1 + _MISSES_ALLOWED or self.clock.near(n, last, _MISSED_S)
            ):
                alignment = self._find(model, track, rate, n)
                if alignment is not None:
                    last = n
                    state, seen_s, rows, points = alignment
                    track.add(n, self.batches[n], state, seen_s, rows)
                    model.add(undo(state, points, track.centre))
                n += direction
        return track

    def _find(
        self, model: Model, track: Track, rate: Float, n: int
    ) -> tuple[Float, float, Int, Float] | None:
        """Align the candidates of batch n with the object so far; None if too few points fit."""
        batch, num_recent = self.batches[n], self.clock.num_in(_RECENT_S)
        c, centre = batch.obstacles, track.centre
        rough_state, rough_rate, _ = _predict(track, rate, num_recent, track.seen_at(batch.time_ns))
        expected = apply(rough_state, model.points, centre)
        slack_m = GATES_M[0] + batch.half_s * np.abs(rough_rate[:3])
        inside = c.strips.rows_inside(expected.min(0) - slack_m, expected.max(0) + slack_m)
        inside = inside[batch.gather(self.free)[inside]]
        rows, min_num_rows = inside[c.cluster[inside] >= 0], float(MIN_FIT)
        if len(rows) < MIN_FIT:  # no sweep saw through the object, but it may be there
            usual_num = float(np.median([track.num_points(m) for m in track.observations]))
            rows, min_num_rows = inside, max(MIN_FIT, _SHARE_UNSEEN * usual_num)
        if len(rows) < min_num_rows:
            return None
        seen_s = float(c.time_s[rows].mean())
        predicted, rate, std = _predict(track, rate, num_recent, seen_s)
        predicted[2] = track.rise_m(self.ground, predicted)
        target = _at_once(c, rows, rate, seen_s)
        state = model.align(target, centre, predicted, std)
        if state is None:
            return None
        state[2] = track.rise_m(self.ground, state)
        fit = model.covers(undo(state, target, centre), FIT_M)
        if fit.sum() < min_num_rows:
            return None
        return state, seen_s, rows[fit], target[fit]  # the (K,3) points at seen_s, world


def _at_once(c: Obstacles, rows: Int, rate: Float, time_s: float) -> Float:
    """Return (N,3) obstacles ``rows`` moved to time ``time_s`` by the velocity ``rate[:3]``."""
    return c.points[rows] + (time_s - c.time_s[rows])[:, None] * rate[:3]


def _predict(track: Track, rate: Float, num: int, time_s: float) -> tuple[Float, Float, Float]:
    """Predict state (4,), rate (4,), and (3,) x, y, yaw std at constant speed and turn rate."""
    # The velocity turns with the object (Schubert, Richter, Wanielik, "Comparison and Evaluation of
    # Advanced Motion Models for Vehicle Tracking", FUSION 2008).
    nearest_first = sorted(
        track.observations.items(), key=lambda s: (abs(s[1].seen_s - time_s), s[0])
    )
    known = dict(nearest_first[:num])
    states = np.stack([seen.state for seen in known.values()])
    t = np.array([seen.seen_s for seen in known.values()])
    ahead_s, middle_s = time_s - t[0], t.mean()
    if len(t) > 1:
        t -= middle_s
        given_s2 = np.full(4, _GIVEN_S2 * (next(iter(track.observations)) in known))
        given_s2[3] = 0  # it has no turn rate
        rate = (t @ states + given_s2 * rate) / (t @ t + given_s2)
        rate[3] *= _TURNS_ON
    std = PREDICTION_STD * max(1.0, abs(ahead_s) / _PREDICTION_S)
    mean_rate = _turned(rate, time_s - 0.5 * ahead_s - middle_s)
    return states[0] + mean_rate * ahead_s, _turned(rate, time_s - middle_s), std


def _turned(rate: Float, later_s: float) -> Float:
    """Return the rate (4,) of a state after ``later_s``, at constant speed and turn rate."""
    cos, sin = np.cos(rate[3] * later_s), np.sin(rate[3] * later_s)
    x, y = rate[:2]
    return np.array([cos * x - sin * y, sin * x + cos * y, *rate[2:]])
