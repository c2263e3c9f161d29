# SPDX-License-Identifier: MIT
"""Groups of candidates followed through the window as rigid objects, and the proof that they move.

A track is a group's accumulated shape (its model) and one planar rigid motion per sweep. It starts
from the velocity that most sweeps agree on, is followed both ways by aligning each sweep with the
model (Segal et al., "Generalized-ICP", RSS 2009, with yaw as the only rotation), is smoothed by a
quadratic in time, and counts only if that smooth motion explains what was measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from densify.flow.evidence import Candidates, FreeSpace
from densify.types import Bool, Float

_MIN_POINTS = 8
_PER_SWEEP_AWAY = 0.7  # a start one sweep farther from the key needs as many more points
_MIN_SEED_SHARE = 0.4
_MAX_SPEED_M_S = 38.0
_VOTE_STEP_M = 0.2  # per sweep
_VOTE_REACH_M = 0.6
_VOTE_POINTS = 60
_MAX_MODEL_POINTS = 1500
_GATES_M = (0.8, 0.5, 0.3, 0.2, 0.2)
_SURFACE_M = 0.05  # noise of a surface point
_FIT_M = 0.3
_MIN_FIT = 5  # points
_MANY_POINTS = 100  # more do not place a sweep better
_MAX_WEIGHT = 60.0
_PREDICTION_STD = np.array([0.3, 0.3, 0.08, 0.06])  # m, m, m, rad
_STEADY = np.array([1.0, 1.0, 0.5, 0.9])  # of a rate lasts: slopes and turns level out
_NUM_ASKED = 60
_MISSES_ALLOWED = 1
_MAX_CONTRADICTIONS = 0.3  # of those that standing still leaves


@dataclass
class Track:
    """One rigid object in the window.

    centre: (3,) about which it turns, key frame. states: sweep index -> (4,) x y z displacement (m)
    and yaw (rad) since the sweep it started in. times_s: sweep index -> when that sweep saw it,
    which is not the sweep's reference time. smooth: (4, degree+1) polynomials of the states in
    time, highest power first. claimed: sweep index -> candidate rows that belong to it.
    """

    centre: Float
    states: dict[int, Float] = field(default_factory=dict)
    times_s: dict[int, float] = field(default_factory=dict)
    claimed: dict[int, np.ndarray] = field(default_factory=dict)
    smooth: Float = field(default_factory=lambda: np.zeros((4, 1)))
    residual_m: float = np.inf

    def carry(self, points: Float, from_s: float | Float, to_s: float | Float) -> Float:
        """(N,3) points of the object at one time -> at another, key frame; one time or one each."""
        return _apply(
            self._state(to_s), _undo(self._state(from_s), points, self.centre), self.centre
        )

    def _state(self, time_s: float | Float) -> Float:
        """(..., 4) of the smooth motion."""
        return np.stack([np.polyval(p, time_s) for p in self.smooth], axis=-1)

    def add(self, j: int, state: Float, time_s: float, rows: np.ndarray) -> None:
        """What sweep j saw of the object."""
        self.states[j], self.times_s[j], self.claimed[j] = state, time_s, rows

    def seen_at(self, j: int, sweep_time_s: Float) -> float:
        """When sweep j sees, or would see, the object."""
        nearest = min(self.times_s, key=lambda k: (abs(k - j), k))
        return float(sweep_time_s[j] + self.times_s[nearest] - sweep_time_s[nearest])


def follow_groups(
    candidates: Sequence[Candidates], space: FreeSpace, sweep_time_s: Float, key_index: int
) -> list[Track]:
    """All proven moving objects of the window.

    sweep_time_s: (W,) reference times of the sweeps, ascending, relative to the key.
    """
    fields = [DistanceField.of(c.points) for c in candidates]
    free = [np.ones(len(c.points), bool) for c in candidates]  # not yet part of a track
    untried = [np.ones(len(c.points), bool) for c in candidates]
    tracks = []
    for i, group in _groups_to_start(candidates, key_index):
        members = group[free[i][group] & untried[i][group]]
        if len(members) < _MIN_POINTS:
            continue
        velocity = _vote(candidates[i].points[members], i, fields, sweep_time_s)
        track = _follow(members, i, velocity, candidates, free, sweep_time_s)
        proven = _prove(track, candidates, space, sweep_time_s)
        for j, rows in track.claimed.items():
            untried[j][rows] = False
            if proven:
                free[j][rows] = False
        if proven:
            tracks.append(track)
    return tracks


def _groups_to_start(
    candidates: Sequence[Candidates], key_index: int
) -> list[tuple[int, np.ndarray]]:
    """Sweep and members of the clusters that are mostly seeds, the best start first: what is seen
    well makes a good model, and from the middle of the window a track has the shortest ways."""
    groups = []
    for i, c in enumerate(candidates):
        size = np.bincount(c.cluster, minlength=c.num_clusters)
        seeds = np.bincount(c.cluster, c.seed, minlength=c.num_clusters)
        good = np.flatnonzero((size >= _MIN_POINTS) & (seeds >= _MIN_SEED_SHARE * size))
        groups += [(i, np.flatnonzero(c.cluster == k)) for k in good]
    return sorted(groups, key=lambda g: -len(g[1]) * _PER_SWEEP_AWAY ** abs(g[0] - key_index))


@dataclass(frozen=True)
class DistanceField:
    """Distance to the nearest candidate on a voxel grid, 1 beyond the reach, as a share of it."""

    share: np.ndarray
    low: Float

    @staticmethod
    def of(points: Float) -> DistanceField:
        step, reach = _VOTE_STEP_M, _VOTE_REACH_M
        if not len(points):
            return DistanceField(np.ones((1, 1, 1), np.float32), np.zeros(3))
        low = points.min(0) - 2 * reach
        shape = tuple(np.ceil((points.max(0) + 2 * reach - low) / step).astype(int) + 1)
        share = np.ones(shape, np.float32)
        occupied = np.unique(((points - low) / step).astype(np.int32), axis=0)
        n = int(np.ceil(reach / step))
        span = np.arange(-n, n + 1)
        offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
        far = np.linalg.norm(offsets, axis=1) * step / reach
        for offset, d in zip(offsets[far < 1], far[far < 1], strict=True):
            at = tuple((occupied + offset).T)
            share[at] = np.minimum(share[at], d)
        return DistanceField(share, low)

    def __call__(self, points: Float) -> Float:
        at = ((points - self.low) * (1 / _VOTE_STEP_M)).astype(np.int32)
        inside = ((at >= 0) & (at < self.share.shape)).all(-1)
        at[~inside] = 0
        return np.where(inside, self.share[at[..., 0], at[..., 1], at[..., 2]], 1.0)


def _vote(points: Float, i: int, fields: Sequence[DistanceField], time_s: Float) -> Float:
    """(3,) m/s in the plane: where the group went in the two sweeps before and after, at once."""
    around = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(fields)]
    step_s = float(np.median(np.diff(time_s)))
    coarse = 2 * _VOTE_STEP_M / step_s

    def best(velocities: Float, num_points: int) -> Float:
        sample = points[:: len(points) // num_points + 1]
        cost = np.zeros(len(velocities))
        for j in around:
            shift = velocities * (time_s[j] - time_s[i])
            cost += fields[j](sample + shift[:, None, :]).mean(1)
        return velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))]

    n = int(_MAX_SPEED_M_S / coarse)
    rough = best(_grid(n) * coarse, _VOTE_POINTS)
    # Only the ends of a long flat side tell how fast it slides: now with more points.
    return best(rough + _grid(6) * coarse / 3, 10 * _VOTE_POINTS)


def _grid(n: int) -> Float:
    span = np.arange(-n, n + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def _follow(
    members: np.ndarray,
    start: int,
    velocity: Float,
    candidates: Sequence[Candidates],
    free: Sequence[Bool],
    sweep_time_s: Float,
) -> Track:
    """Forwards, then backwards, with everything seen so far as the model."""
    here = candidates[start]
    rate = np.append(velocity, 0.0)
    seen_s = float(here.time_s[members].mean())
    points = _at_once(here, members, rate, seen_s)
    track = Track(points.mean(0))
    track.add(start, np.zeros(4), seen_s, members)
    model = _Model(points)
    for direction in (1, -1):
        misses, j = 0, start + direction
        while 0 <= j < len(candidates) and misses <= _MISSES_ALLOWED:
            found = _find(
                model, track, rate, candidates[j], free[j], track.seen_at(j, sweep_time_s)
            )
            if found is None:
                misses += 1
            else:
                misses = 0
                state, seen_s, rows, points = found
                track.add(j, state, seen_s, rows)
                model.add(_undo(state, points, track.centre))
            j += direction
    return track


def _at_once(c: Candidates, rows: np.ndarray, rate: Float, time_s: float) -> Float:
    """(N,3) candidates of one sweep, seen one after the other, where they all were at one time."""
    return c.points[rows] + (time_s - c.time_s[rows])[:, None] * rate[:3]


def _predict(track: Track, rate: Float, time_s: float) -> tuple[Float, Float]:
    """State and its rate, from the states nearest in time: constant velocity."""
    known = sorted(track.states, key=lambda k: (abs(track.times_s[k] - time_s), k))[:4]
    nearest = known[0]
    if len(known) > 1:
        t = [track.times_s[k] - time_s for k in known]
        rate = np.polyfit(t, np.stack([track.states[k] for k in known]), 1)[0] * _STEADY
    return track.states[nearest] + rate * (time_s - track.times_s[nearest]), rate


class _Model:
    """An object's accumulated points with the inverse covariance of the surface around each."""

    def __init__(self, points: Float) -> None:
        self.points = points
        self._prepare()

    def add(self, points: Float) -> None:
        points = np.concatenate([self.points, points])
        if len(points) > _MAX_MODEL_POINTS:
            points = points[:: len(points) // _MAX_MODEL_POINTS + 1]
        self.points = points
        self._prepare()

    def nearest(self, points: Float, within_m: float) -> tuple[Float, np.ndarray]:
        """Distance to the nearest model point, inf beyond ``within_m``, and its index."""
        distance, index = self._tree.query(points, distance_upper_bound=within_m)
        return np.asarray(distance), np.asarray(index)

    def _prepare(self) -> None:
        self._tree = cKDTree(self.points)
        k = min(12, len(self.points))
        _, near = self._tree.query(self.points, k)
        x = self.points[np.reshape(near, (len(self.points), k))]
        x = x - x.mean(1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", x, x) / k
        scale = np.trace(covariance, axis1=1, axis2=2)[:, None, None] / 3
        noise = _SURFACE_M**2 * np.eye(3)
        # Capped along the surface: far along it a point still tells a little.
        self.information = np.linalg.inv(covariance + noise + 0.02 * scale * np.eye(3))


def _find(
    model: _Model, track: Track, rate: Float, c: Candidates, free: Bool, about_s: float
) -> tuple[Float, float, np.ndarray, Float] | None:
    """Align one sweep's candidates with the model.

    about_s: roughly when the sweep saw the object. Returns the state, when it held, the rows that
    fit and where those points were at that time; None where too few fit.
    """
    centre = track.centre
    expected = _apply(_predict(track, rate, about_s)[0], model.points, centre)
    low, high = expected.min(0) - _GATES_M[0], expected.max(0) + _GATES_M[0]
    rows = np.flatnonzero(free & ((c.points > low) & (c.points < high)).all(1))
    if len(rows) < _MIN_FIT:
        return None
    seen_s = float(c.time_s[rows].mean())
    predicted, rate = _predict(track, rate, seen_s)
    target = _at_once(c, rows, rate, seen_s)
    state = predicted.copy()
    for gate in _GATES_M:
        for _ in range(2):
            m = _undo(state, target, centre)
            distance, nearest = model.nearest(m, gate)
            near = np.isfinite(distance)
            if near.sum() < _MIN_FIT:
                return None
            matched = nearest[near]
            state = state + _gauss_newton(
                m[near] - centre,
                m[near] - model.points[matched],
                model.information[matched] * _robust(distance[near] / gate)[:, None, None],
                state[3],
                predicted - state,
            )
    distance, _ = model.nearest(_undo(state, target, centre), _FIT_M)
    fit = np.isfinite(distance)
    if fit.sum() < _MIN_FIT:
        return None
    return state, seen_s, rows[fit], target[fit]


def _robust(distance: Float) -> Float:
    """Tukey's weights of distances as shares of the gate, all together at most ``_MAX_WEIGHT``:
    neighbours on a surface do not err independently."""
    weight: Float = (1 - distance**2) ** 2
    return weight * min(1.0, _MAX_WEIGHT / len(weight))


def _gauss_newton(
    arm: Float, residual: Float, information: Float, yaw: float, to_prediction: Float
) -> Float:
    """(4,) step of the state that lowers the weighted residuals and stays near the prediction.

    arm: (N,3) of the points about the centre, residual: (N,3) to the model, both in the model's
    orientation. information: (N,3,3).
    """
    prior = 1 / _PREDICTION_STD**2
    J = np.zeros((len(arm), 3, 4))
    J[:, :, :3] = -_turned(np.eye(3), -yaw).T
    J[:, 0, 3], J[:, 1, 3] = arm[:, 1], -arm[:, 0]
    JA = np.einsum("nik,nij->nkj", J, information)
    H = np.einsum("nkj,njl->kl", JA, J) + np.diag(prior)
    g = np.einsum("nkj,nj->k", JA, residual) - prior * to_prediction
    return -np.linalg.solve(H, g)


def _prove(
    track: Track, candidates: Sequence[Candidates], space: FreeSpace, sweep_time_s: Float
) -> bool:
    """Fit the smooth motion; True if the track certainly moves.

    The motion must be smooth, long enough to be told from noise, and must do away with the
    contradictions that brought the group here: where the sweeps see through its points at their
    rigid places, they must not see through them at the moved ones.
    """
    seen = sorted(track.states)
    if len(seen) < 3:
        return False
    t = np.array([track.times_s[j] for j in seen])
    states = np.stack([track.states[j] for j in seen])
    weight = np.sqrt([min(len(track.claimed[j]), _MANY_POINTS) for j in seen])
    degree = 2 if len(seen) >= 5 else 1
    track.smooth = np.polyfit(t, states, degree, w=weight).T
    fitted = np.stack([np.polyval(p, t) for p in track.smooth], axis=1)
    freedom = len(seen) / (len(seen) - degree - 0.5)
    residual = np.linalg.norm((states - fitted)[:, :2], axis=1)
    mean_square = np.average(residual**2, weights=weight**2)
    track.residual_m = float(np.sqrt(mean_square * freedom))
    travelled = float(np.linalg.norm((fitted[-1] - fitted[0])[:2]))
    step_m = travelled / (seen[-1] - seen[0])
    range_m = float(np.linalg.norm(track.centre[:2]))
    if track.residual_m > 0.04 + 0.0015 * range_m + 0.03 * step_m or travelled < max(
        0.35, 8 * track.residual_m
    ):
        return False
    still, moved = _contradictions(track, candidates, space, sweep_time_s)
    return moved <= _MAX_CONTRADICTIONS * still


def _contradictions(
    track: Track, candidates: Sequence[Candidates], space: FreeSpace, sweep_time_s: Float
) -> tuple[int, int]:
    """How many looks through the track's points the sweeps have: standing still, and moved."""
    still = moved = 0
    for i, rows in track.claimed.items():
        rows = rows[:: len(rows) // _NUM_ASKED + 1]
        points, seen_s = candidates[i].points[rows], candidates[i].time_s[rows]
        for j in range(len(candidates)):
            if j != i:
                there_s = sweep_time_s[j]
                carried = track.carry(points, seen_s, there_s)
                velocity = (track.carry(carried, there_s, there_s + 0.01) - carried) / 0.01
                still += int(space.seen_through(points, j).sum())
                moved += int(space.seen_through(carried, j, velocity).sum())
    return still, moved


def _apply(state: Float, points: Float, centre: Float) -> Float:
    """(4,) or (N,4), (N,3) -> (N,3) the object's points in that state."""
    return _turned(points - centre, state[..., 3]) + centre + state[..., :3]


def _undo(state: Float, points: Float, centre: Float) -> Float:
    """Inverse of `_apply`."""
    return _turned(points - centre - state[..., :3], -state[..., 3]) + centre


def _turned(arms: Float, yaw: float | Float) -> Float:
    """(N,3), () or (N,) -> (N,3) about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = arms.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)
