# SPDX-License-Identifier: MIT
"""Groups of candidates followed through a stretch as rigid objects, and the proof that they move.

A track is a group's accumulated shape (its model) and one planar rigid motion per sweep. It starts
from the velocity that most sweeps agree on, is followed both ways by aligning each sweep with the
model, is smoothed in time, and counts only if that smooth motion explains what was measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from densify.flow.tracking.align import GATES_M, MIN_FIT, Model, align, apply, undo
from densify.flow.tracking.clock import Clock
from densify.flow.tracking.evidence import FreeSpace, Standing
from densify.flow.tracking.lone_rings import in_line, linked_in_line, single_rings
from densify.flow.tracking.paths import Path
from densify.flow.tracking.shapes import Shape
from densify.flow.tracking.vote import DistanceField, vote
from densify.geometry.height_map import HeightMap
from densify.kernels.clouds import rows_inside
from densify.types import Bool, Float

_MIN_POINTS = 8
_MIN_SEED_SHARE = 0.4
_AROUND_S = 0.5  # before and after a start is as good as any time
_NEARER_END, _NEARER_END_S = 0.7, 0.1  # each time a start is so much nearer it is worth less
_FIT_M = 0.3
_RINGS_M = 5.0
_NEAR_S = 0.3
_SHARE_UNSEEN = 0.5  # of the points a sweep usually shows
_MANY_POINTS = 100  # more do not place a sweep better
# m, m, rad: of what is foretold by up to so long, and in proportion by longer.
_PREDICTION_STD, _PREDICTION_S = np.array([0.3, 0.3, 0.06]), 0.25
_REFINED_STD = np.array([0.15, 0.15, 0.03])  # m, m, rad: of the smooth motion
_RECENT_S = 0.4  # the states in so long tell a rate
_STEADY = np.array([1.0, 1.0, 1.0, 0.9])  # of what it was then: turns level out
_ROUGH_M, _ROUGH_PER_GAP, _ROUGH_S = 0.04, 0.2, 0.003  # by gap of rings, by speed
_LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL = 0.35, 8.0
_BESIDE_M = 1.0
_NUM_ASKED = 60
_MISSES_ALLOWED, _MISSED_S = 1, 0.2  # either: a track ends when both are exceeded
_LEAST_STATES, _LEAST_S = 3, 0.15
_MAX_CONTRADICTIONS = 0.3  # of those that standing still leaves


@dataclass
class Track:
    """One rigid object in the stretch.

    centre: (3,) about which it turns, world. states: sweep index -> (4,) x y z displacement (m)
    and yaw (rad) since the sweep it started in; z as the ground under it rises. times_s:
    sweep index -> when that sweep saw it, which is not the sweep's reference time. claimed: sweep
    index -> rows of `Standing` that are its. path: the smooth motion.
    """

    centre: Float
    states: dict[int, Float] = field(default_factory=dict)
    times_s: dict[int, float] = field(default_factory=dict)
    claimed: dict[int, np.ndarray] = field(default_factory=dict)
    path: Path = field(init=False)

    def carry(self, points: Float, from_s: float | Float, to_s: float | Float) -> Float:
        """(N,3) points of the object at one time -> at another, world; one time or one each."""
        return self.place(self.undo(points, from_s), to_s)

    def undo(self, points: Float, seen_s: float | Float) -> Float:
        """(N,3) points seen at a time -> in the object's own frame."""
        return undo(self.path(seen_s), points, self.centre)

    def place(self, points: Float, time_s: float | Float) -> Float:
        """Inverse of `undo`."""
        return apply(self.path(time_s), points, self.centre)

    def velocity_m_s(self, points: Float, time_s: float) -> Float:
        """(N,3) of the object's points where they are at that time."""
        state, rate = self.path(time_s), self.path.rate(time_s)
        velocity_m_s = np.tile(rate[:3], (len(points), 1))
        velocity_m_s[:, 0] -= rate[3] * (points[:, 1] - self.centre[1] - state[1])
        velocity_m_s[:, 1] += rate[3] * (points[:, 0] - self.centre[0] - state[0])
        return velocity_m_s

    def seen_in(self, standing: Sequence[Standing], sweeps: Iterable[int]) -> Float:
        """(N,3) what these sweeps saw of the object, in its own frame."""
        parts = [np.zeros((0, 3))]
        for j in sweeps:
            c, rows = standing[j], self.claimed[j]
            parts.append(self.undo(c.points[rows], c.time_s[rows]))
        return np.concatenate(parts)

    def add(self, j: int, state: Float, time_s: float, rows: np.ndarray) -> None:
        """What sweep j saw of the object."""
        self.states[j], self.times_s[j], self.claimed[j] = state, time_s, rows

    def rise_m(self, ground: HeightMap, state: Float) -> float:
        """How much higher the ground is in that state under the object and on both sides of it, in
        the median: nobody may ever have seen the road that it covers."""
        way = state[:2] / max(float(np.linalg.norm(state[:2])), 1e-9)
        start = self.centre[:2] + np.outer([-_BESIDE_M, 0.0, _BESIDE_M], [-way[1], way[0]])
        return float(np.median(ground.under(start + state[:2]) - ground.under(start)))

    def typical_size(self) -> float:
        """Points per sweep."""
        return float(np.median([len(rows) for rows in self.claimed.values()]))

    def smooth(self) -> None:
        """Lay the path through the states; sweeps that saw many points count more."""
        seen = sorted(self.states)
        times_s = np.array([self.times_s[j] for j in seen])
        states = np.stack([self.states[j] for j in seen])
        weights = np.array([min(len(self.claimed[j]), _MANY_POINTS) for j in seen], float)
        self.path = Path.fit(times_s, states, weights)

    def seen_at(self, j: int, clock: Clock) -> float:
        """When sweep j sees, or would see, the object."""
        nearest = clock.nearest(j, self.times_s)
        return float(clock.time_s[j] + self.times_s[nearest] - clock.time_s[nearest])


def follow_groups(standing: Sequence[Standing], space: FreeSpace, ground: HeightMap) -> list[Track]:
    """All proven moving objects of the stretch."""
    fields = [DistanceField.of(c.points[c.candidate]) for c in standing]
    free = [np.ones(len(c.points), bool) for c in standing]  # not yet part of a track
    untried = [np.ones(len(c.points), bool) for c in standing]
    tracks = []
    for i, group in _groups_to_start(standing, space.clock):
        members = group[free[i][group] & untried[i][group]]
        if len(members) < _MIN_POINTS:
            continue
        velocity = vote(standing[i].points[members], i, fields, space.clock)
        track = _follow(members, i, velocity, standing, free, ground, space.clock)
        proven = _prove(track, standing, space)
        if proven:
            _gather(track, standing, free, space)
            _refine(track, standing, ground)
            _claim_rings(track, standing, free, space)
        for j, rows in track.claimed.items():
            untried[j][rows] = False
            if proven:
                free[j][rows] = False
        if proven:
            tracks.append(track)
    return tracks


def _groups_to_start(standing: Sequence[Standing], clock: Clock) -> list[tuple[int, np.ndarray]]:
    """Sweep and members of the clusters that are mostly seeds, the best start first: what is seen
    well makes a good model, and far from the ends of the stretch both sides tell how it moves."""
    groups = []

    def worth(start: tuple[int, np.ndarray]) -> float:
        i, members = start
        nearer_s = max(0.0, _AROUND_S - clock.from_end_s(i))
        return float(len(members) * _NEARER_END ** (nearer_s / _NEARER_END_S))

    for i, c in enumerate(standing):
        size = np.bincount(c.cluster[c.candidate], minlength=c.num_clusters)
        seeds = np.bincount(c.cluster[c.candidate & c.seed], minlength=c.num_clusters)
        good = np.flatnonzero((size >= _MIN_POINTS) & (seeds >= _MIN_SEED_SHARE * size))
        groups += [(i, np.flatnonzero(c.cluster == k)) for k in good]
    return sorted(groups, key=worth, reverse=True)


def _follow(
    members: np.ndarray,
    start: int,
    velocity: Float,
    standing: Sequence[Standing],
    free: Sequence[Bool],
    ground: HeightMap,
    clock: Clock,
) -> Track:
    """Forwards, then backwards, with everything seen so far as the model."""
    here = standing[start]
    rate = np.append(velocity, 0.0)
    seen_s = float(here.time_s[members].mean())
    points = _at_once(here, members, rate, seen_s)
    track = Track(points.mean(0))
    track.add(start, np.zeros(4), seen_s, members)
    model = Model(points)
    for direction in (1, -1):
        last, j = start, start + direction
        while 0 <= j < len(standing) and (
            abs(j - last) <= 1 + _MISSES_ALLOWED or clock.near(j, last, _MISSED_S)
        ):
            recent = clock.num_in(_RECENT_S)
            about_s = track.seen_at(j, clock)
            found = _find(model, track, rate, recent, standing[j], free[j], ground, about_s)
            if found is not None:
                last = j
                state, seen_s, rows, points = found
                track.add(j, state, seen_s, rows)
                model.add(undo(state, points, track.centre))
            j += direction
    return track


def _at_once(c: Standing, rows: np.ndarray, rate: Float, time_s: float) -> Float:
    """(N,3) candidates of one sweep, seen one after the other, where they all were at one time."""
    return c.points[rows] + (time_s - c.time_s[rows])[:, None] * rate[:3]


def _predict(track: Track, rate: Float, num: int, time_s: float) -> tuple[Float, Float, Float]:
    """State, its rate, and how far off (3,) the state may be in x y and yaw, by the constant
    velocity of the ``num`` states nearest in time."""
    known = sorted(track.states, key=lambda k: (abs(track.times_s[k] - time_s), k))[:num]
    nearest = known[0]
    ahead_s = time_s - track.times_s[nearest]
    if len(known) > 1:
        t = np.array([track.times_s[k] for k in known])
        t -= t.mean()
        rate = t @ np.stack([track.states[k] for k in known]) / (t @ t) * _STEADY
    std = _PREDICTION_STD * max(1.0, abs(ahead_s) / _PREDICTION_S)
    return track.states[nearest] + rate * ahead_s, rate, std


def _find(
    model: Model,
    track: Track,
    rate: Float,
    num_recent: int,
    c: Standing,
    free: Bool,
    ground: HeightMap,
    about_s: float,
) -> tuple[Float, float, np.ndarray, Float] | None:
    """Align one sweep's candidates with the model.

    about_s: roughly when the sweep saw the object. Returns the state, when it held, the rows that
    fit and where those points were at that time; None where too few fit.
    """
    centre = track.centre
    expected = apply(_predict(track, rate, num_recent, about_s)[0], model.points, centre)
    low, high = expected.min(0) - GATES_M[0], expected.max(0) + GATES_M[0]
    inside = rows_inside(c.points, low, high)
    inside = inside[free[inside]]
    rows, enough = inside[c.cluster[inside] >= 0], float(MIN_FIT)
    if len(rows) < MIN_FIT:  # seen by nobody else, it may be there all the same
        rows, enough = inside, max(MIN_FIT, _SHARE_UNSEEN * track.typical_size())
    if len(rows) < enough:
        return None
    seen_s = float(c.time_s[rows].mean())
    predicted, rate, std = _predict(track, rate, num_recent, seen_s)
    predicted[2] = track.rise_m(ground, predicted)
    target = _at_once(c, rows, rate, seen_s)
    state = align(model, target, centre, predicted, std)
    if state is None:
        return None
    state[2] = track.rise_m(ground, state)
    distance, _ = model.tree.nearest(undo(state, target, centre), _FIT_M)
    fit = np.isfinite(distance)
    if fit.sum() < enough:
        return None
    return state, seen_s, rows[fit], target[fit]


def _gather(
    track: Track,
    standing: Sequence[Standing],
    free: Sequence[Bool],
    space: FreeSpace,
) -> None:
    """Claim the free candidates beside or within the object that its motion does not contradict,
    before a part of it starts a track of its own."""
    shape = Shape.of(track.seen_in(standing, sorted(track.claimed)))
    for j, own in track.claimed.items():
        c = standing[j]
        there = track.place(shape.rim, track.times_s[j])
        rows = rows_inside(c.points, there.min(0) - 2 * _FIT_M, there.max(0) + 2 * _FIT_M)
        rows = rows[free[j][rows] & (c.cluster[rows] >= 0)]
        rows = np.setdiff1d(rows, own, assume_unique=True)
        in_shape = track.undo(c.points[rows], c.time_s[rows])
        belongs = np.isfinite(shape.tree.nearest(in_shape, _FIT_M)[0])
        rows = rows[belongs | shape.within_outline(in_shape)]
        rows = _not_contradicted(track, c, rows, j, space)
        track.claimed[j] = np.concatenate([own, rows])


def _claim_rings(
    track: Track, standing: Sequence[Standing], free: Sequence[Bool], space: FreeSpace
) -> None:
    """Claim the free clusters of single rings ahead of and behind the object that its motion does
    not contradict, see `densify.flow.tracking.lone_rings`. They do not place it: a ring stays where
    the rays are."""
    shape = Shape.of(track.seen_in(standing, sorted(track.claimed)))
    ahead = track.path.rate(track.times_s[next(iter(track.states))])[:2]
    found, bodies = [], []
    for j, own in track.claimed.items():
        c = standing[j]
        there = track.place(shape.rim, track.times_s[j])
        rows = rows_inside(c.points, there.min(0) - _RINGS_M, there.max(0) + _RINGS_M)
        rows = rows[free[j][rows] & (c.cluster[rows] >= 0)]
        rows = np.setdiff1d(rows, own, assume_unique=True)
        rows = rows[single_rings(c, rows, space.T_lidar_world[j], space.sensors)]
        rows = rows[in_line(shape, track.undo(c.points[rows], c.time_s[rows]), ahead)]
        rows = _not_contradicted(track, c, rows, j, space)
        found.append(rows)
        bodies.append(track.undo(c.points[rows], c.time_s[rows]))
    linked = linked_in_line(shape, bodies, ahead)
    for j, rows, together in zip(list(track.claimed), found, linked, strict=True):
        track.claimed[j] = np.concatenate([track.claimed[j], rows[together]])


def _not_contradicted(
    track: Track, c: Standing, rows: np.ndarray, j: int, space: FreeSpace
) -> np.ndarray:
    """Those rows of sweep j that no sweep close in time sees through where they are carried to."""
    for i in space.others(j):
        if space.clock.near(i, j, _NEAR_S) and len(rows):
            at_s = space.clock.time_s[i]
            carried = track.carry(c.points[rows], c.time_s[rows], at_s)
            velocity_m_s = track.velocity_m_s(carried, at_s)
            rows = rows[~space.seen_through(carried, i, velocity_m_s)]
    return rows


def _refine(track: Track, standing: Sequence[Standing], ground: HeightMap) -> None:
    """Align every sweep once more, with what others saw, if that makes the motion smoother.

    Followed sweep by sweep, an object whose other side comes into view drifts: the first shape is
    all there is to hold on to. The even sweeps are aligned with the shape that the odd ones show,
    and the other way round, so that no sweep holds on to itself.
    """
    sweeps = sorted(track.claimed)
    shapes = [track.seen_in(standing, [j for j in sweeps if j % 2 == odd]) for odd in (0, 1)]
    if not all(map(len, shapes)):
        return
    models = [Model(x) for x in shapes]
    before = dict(track.states), track.path
    for j, rows in track.claimed.items():
        at_s = track.times_s[j]
        points = track.carry(standing[j].points[rows], standing[j].time_s[rows], at_s)
        state = align(models[1 - j % 2], points, track.centre, track.path(at_s), _REFINED_STD)
        if state is not None:
            state[2] = track.rise_m(ground, state)
            track.states[j] = state
    track.smooth()
    if track.path.residual_m > before[1].residual_m:
        track.states, track.path = before


def _prove(track: Track, standing: Sequence[Standing], space: FreeSpace) -> bool:
    """Fit the smooth motion; True if the track certainly moves.

    The motion must be smooth, long enough to be told from noise, and must do away with the
    contradictions that brought the group here: where the sweeps see through its points at their
    rigid places, they must not see through them at the moved ones.
    """
    seen_s = np.ptp(list(track.times_s.values()))
    if len(track.states) < _LEAST_STATES or seen_s < _LEAST_S:
        return False
    track.smooth()
    residual_m = track.path.residual_m
    begin, end = track.path(track.path.begin_s), track.path(track.path.end_s)
    travelled = float(np.linalg.norm((end - begin)[:2]))
    gap_m = space.gap_m(track.centre, next(iter(track.states)))
    rough_m = _ROUGH_M + _ROUGH_PER_GAP * gap_m + _ROUGH_S * travelled / seen_s
    if residual_m > rough_m or travelled < max(_LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL * residual_m):
        return False
    still, moved = _contradictions(track, standing, space)
    return moved <= _MAX_CONTRADICTIONS * still


def _contradictions(
    track: Track, standing: Sequence[Standing], space: FreeSpace
) -> tuple[int, int]:
    """How many looks through the track's points the sweeps have: standing still, and moved."""
    asked = {i: rows[:: len(rows) // _NUM_ASKED + 1] for i, rows in track.claimed.items()}
    points = {i: standing[i].points[rows] for i, rows in asked.items()}
    body = {i: track.undo(points[i], standing[i].time_s[rows]) for i, rows in asked.items()}
    still = moved = 0
    for j, at_s in enumerate(space.clock.time_s):
        from_others = [i for i in space.others(j) if i in asked]
        if not from_others:
            continue
        carried = track.place(np.concatenate([body[i] for i in from_others]), at_s)
        velocity_m_s = track.velocity_m_s(carried, at_s)
        moved += int(space.seen_through(carried, j, velocity_m_s).sum())
        standing_still = np.concatenate([points[i] for i in from_others])
        still += int(space.seen_through(standing_still, j).sum())
    return still, moved
