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
_MIN_SEED_SHARE = 0.4
_MAX_SPEED_M_S = 38.0
_VOTE_STEP_M = 0.2  # per sweep
_VOTE_REACH_M = 0.6
_VOTE_POINTS = 60
_MAX_MODEL_POINTS = 1500
_GATES_M = (0.8, 0.5, 0.3, 0.2, 0.2)
_SURFACE_M = 0.05  # noise of a surface point
_FIT_M = 0.3
_MISSES_ALLOWED = 1
_MAX_CONTRADICTIONS = 0.2  # of those that standing still leaves


@dataclass
class Track:
    """One rigid object in the window.

    centre: (3,) about which it turns, key frame. states: sweep index -> (4,) x y z displacement (m)
    and yaw (rad) since the sweep it started in. smooth: (4, degree+1) polynomials of the states in
    time, highest power first. claimed: sweep index -> candidate rows that belong to it.
    """

    centre: Float
    start: int
    states: dict[int, Float] = field(default_factory=dict)
    claimed: dict[int, np.ndarray] = field(default_factory=dict)
    smooth: Float = field(default_factory=lambda: np.zeros((4, 1)))
    residual_m: float = np.inf

    def state(self, time_s: float) -> Float:
        """(4,) of the smooth motion."""
        return np.array([np.polyval(p, time_s) for p in self.smooth])

    def carry(self, points: Float, from_s: float, to_s: float) -> Float:
        """(N,3) points of the object at one time -> at another, key frame."""
        return _apply(self.state(to_s), _undo(self.state(from_s), points, self.centre), self.centre)


def follow_groups(
    candidates: Sequence[Candidates], space: FreeSpace, time_s: Float, key_index: int
) -> list[Track]:
    """All proven moving objects of the window.

    time_s: (W,) of the sweeps, ascending, relative to the key.
    """
    fields = [DistanceField.of(c.points) for c in candidates]
    trees = [cKDTree(c.points) for c in candidates]
    free = [np.ones(len(c.points), bool) for c in candidates]  # not yet part of a track
    untried = [np.ones(len(c.points), bool) for c in candidates]
    tracks = []
    for i in sorted(range(len(candidates)), key=lambda i: (abs(i - key_index), i)):
        for members in _groups_to_start(candidates[i]):
            members = members[free[i][members] & untried[i][members]]
            if len(members) < _MIN_POINTS:
                continue
            start_points = candidates[i].points[members]
            velocity = _vote(start_points, i, fields, time_s)
            track = _follow(start_points, i, velocity, candidates, trees, free, time_s)
            proven = _prove(track, candidates, space, time_s)
            for j, rows in track.claimed.items():
                untried[j][rows] = False
                if proven:
                    free[j][rows] = False
            untried[i][members] = False
            if proven:
                tracks.append(track)
    return tracks


def _groups_to_start(c: Candidates) -> list[np.ndarray]:
    """Members of the clusters that are mostly seeds, largest first."""
    size = np.bincount(c.cluster, minlength=c.num_clusters)
    seeds = np.bincount(c.cluster, c.seed, minlength=c.num_clusters)
    good = np.flatnonzero((size >= _MIN_POINTS) & (seeds >= _MIN_SEED_SHARE * size))
    return [np.flatnonzero(c.cluster == k) for k in good[np.argsort(-size[good], kind="stable")]]


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
    sample = points[:: max(1, len(points) // _VOTE_POINTS)]
    around = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(fields)]
    step_s = float(np.median(np.diff(time_s)))
    coarse = 2 * _VOTE_STEP_M / step_s

    def best(velocities: Float) -> Float:
        cost = np.zeros(len(velocities))
        for j in around:
            shift = velocities * (time_s[j] - time_s[i])
            cost += fields[j](sample + shift[:, None, :]).mean(1)
        return velocities[np.argmin(cost + 1e-3 * np.linalg.norm(velocities, axis=1))]

    n = int(_MAX_SPEED_M_S / coarse)
    rough = best(_grid(n) * coarse)
    return best(rough + _grid(3) * coarse / 3)


def _grid(n: int) -> Float:
    span = np.arange(-n, n + 1.0)
    x, y = np.meshgrid(span, span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def _follow(
    start_points: Float,
    start: int,
    velocity: Float,
    candidates: Sequence[Candidates],
    trees: Sequence[cKDTree],
    free: Sequence[Bool],
    time_s: Float,
) -> Track:
    """Forwards, then backwards, with everything seen so far as the model."""
    centre = start_points.mean(0)
    track = Track(centre, start)
    track.states[start] = np.zeros(4)
    model = _Model(start_points)
    rate = np.append(velocity, 0.0)
    own = trees[start].query_ball_point(start_points, 0.05)
    track.claimed[start] = np.unique(np.concatenate([np.asarray(o, int) for o in own]))
    for direction in (1, -1):
        misses, j = 0, start + direction
        while 0 <= j < len(candidates) and misses <= _MISSES_ALLOWED:
            predicted = _predict(track, rate, time_s, j)
            found = _find(model, predicted, centre, candidates[j].points, trees[j], free[j])
            if found is None:
                misses += 1
            else:
                misses = 0
                state, rows = found
                track.states[j], track.claimed[j] = state, rows
                model.add(_undo(state, candidates[j].points[rows], centre))
            j += direction
    return track


def _predict(track: Track, rate: Float, time_s: Float, j: int) -> Float:
    """From the states nearest in time: constant velocity."""
    known = sorted(track.states, key=lambda k: abs(k - j))[:4]
    nearest = known[0]
    if len(known) > 1:
        t = time_s[known] - time_s[j]
        rate = np.polyfit(t, np.stack([track.states[k] for k in known]), 1)[0]
    return track.states[nearest] + rate * (time_s[j] - time_s[nearest])


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
    model: _Model, predicted: Float, centre: Float, points: Float, tree: cKDTree, free: Bool
) -> tuple[Float, np.ndarray] | None:
    """Align one sweep's candidates with the model: (state, rows that fit), or None."""
    expected = _apply(predicted, model.points, centre)
    low, high = expected.min(0) - _GATES_M[0], expected.max(0) + _GATES_M[0]
    rows = np.flatnonzero(free & ((points > low) & (points < high)).all(1))
    if len(rows) < 5:
        return None
    target = points[rows]
    state = predicted.copy()
    prior = 1 / np.array([0.3, 0.3, 0.08, 0.06]) ** 2
    for gate in _GATES_M:
        for _ in range(2):
            m = _undo(state, target, centre)
            distance, nearest = model.nearest(m, gate)
            near = np.isfinite(distance)
            if near.sum() < 5:
                return None
            step = _gauss_newton(
                m[near],
                model.points[nearest[near]],
                model.information[nearest[near]],
                distance[near],
                gate,
                centre,
                prior,
                predicted - state,
                state[3],
            )
            state = state + step
    distance, _ = model.nearest(_undo(state, target, centre), _FIT_M)
    fit = np.isfinite(distance)
    if fit.sum() < 5:
        return None
    return state, rows[fit]


def _gauss_newton(m, q, information, distance, gate, centre, prior, to_prediction, yaw):  # type: ignore
    """One robust step of the state: dxyz and dyaw."""
    weight = (1 - (distance / gate) ** 2) ** 2
    weight = weight * min(1.0, 60 / len(m))  # neighbours on a surface do not err independently
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    J = np.zeros((len(m), 3, 4))
    J[:, :, :3] = -R.T
    arm = m - centre
    J[:, 0, 3], J[:, 1, 3] = arm[:, 1], -arm[:, 0]
    r = m - q
    JA = np.einsum("nik,nij->nkj", J, information * weight[:, None, None])
    H = np.einsum("nkj,njl->kl", JA, J) + np.diag(prior)
    g = np.einsum("nkj,nj->k", JA, r) - prior * to_prediction
    return -np.linalg.solve(H, g)


def _prove(track: Track, candidates: Sequence[Candidates], space: FreeSpace, time_s: Float) -> bool:
    """Fit the smooth motion; True if the track certainly moves.

    The motion must be smooth, long enough to be told from noise, and must do away with the
    contradictions that brought the group here: where the sweeps see through its points at their
    rigid places, they must not see through them at the moved ones.
    """
    seen = sorted(track.states)
    if len(seen) < 3:
        return False
    t = time_s[seen]
    states = np.stack([track.states[j] for j in seen])
    degree = 2 if len(seen) >= 5 else 1
    track.smooth = np.polyfit(t, states, degree).T
    fitted = np.stack([track.state(x) for x in t])
    freedom = len(seen) / (len(seen) - degree - 0.5)
    residual = np.linalg.norm((states - fitted)[:, :2], axis=1)
    track.residual_m = float(np.sqrt((residual**2).mean() * freedom))
    travelled = float(np.linalg.norm((fitted[-1] - fitted[0])[:2]))
    step_m = travelled / (seen[-1] - seen[0])
    range_m = float(np.linalg.norm(track.centre[:2]))
    if track.residual_m > 0.04 + 0.0015 * range_m + 0.03 * step_m or travelled < max(
        0.35, 8 * track.residual_m
    ):
        return False
    still, moved = _contradictions(track, candidates, space, time_s)
    return moved <= _MAX_CONTRADICTIONS * still


def _contradictions(
    track: Track, candidates: Sequence[Candidates], space: FreeSpace, time_s: Float
) -> tuple[int, int]:
    """How many looks through the track's points the sweeps have: standing still, and moved."""
    still = moved = 0
    for i, rows in track.claimed.items():
        points = candidates[i].points[rows]
        points = points[:: len(points) // 60 + 1]
        for j in range(len(candidates)):
            if j != i:
                still += int(space.seen_through(points, j).sum())
                carried = track.carry(points, time_s[i], time_s[j])
                moved += int(space.seen_through(carried, j).sum())
    return still, moved


def _apply(state: Float, points: Float, centre: Float) -> Float:
    c, s = np.cos(state[3]), np.sin(state[3])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return (points - centre) @ R.T + centre + state[:3]


def _undo(state: Float, points: Float, centre: Float) -> Float:
    c, s = np.cos(state[3]), np.sin(state[3])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return (points - centre - state[:3]) @ R + centre
