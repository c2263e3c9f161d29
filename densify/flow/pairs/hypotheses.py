# SPDX-License-Identifier: MIT
"""Propose motions of groups of points between two clouds, and align the groups there.

A group starts at the few displacements that most of its points vote for (Hough 1962). From there it
is aligned with the surfaces of the other cloud (Segal et al., "Generalized-ICP", RSS 2009, with yaw
as the only rotation). All groups are aligned at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from densify.flow.surface_matching import (
    GATES_M,
    MAX_WEIGHT,
    NUM_NEAR,
    apply,
    surface_information,
)
from densify.free_space.ground import HeightMap
from densify.geometry.nearest import nearest_k, tree_of
from densify.geometry.types import Float, Int

_EVEN_M = 0.06
_MAX_SPEED_M_S = 38.0
_USUAL_S, _LONGEST_S = 0.1, 0.4  # assumed time between clouds if unknown; greatest time
_VOTE_STEP_M = 0.2
_VOTE_SLACK_M = 0.3  # vertical tolerance of a vote
_VOTE_POINTS, _VOTE_TARGETS = 60, 800
_NUM_VOTED = 5
_APART_M = 0.5
_ALIGN_POINTS = 150
_PRECISION = 1 / np.array([1.0, 1.0, 0.01, 0.06]) ** 2  # prior: m from the start state, rad from 0
_FROM_START = np.array([1.0, 1.0, 1.0, 0.0])
_SLOPE_STEP_M, _SLOPE_STEPS = 2.0, 4  # of the grid that is fitted around a position
_ROUGH_M = 0.1  # a ground rougher than this has no slope


@dataclass(frozen=True)
class PairCloud:
    """The N points of a cloud above the ground.

    Attributes:
        points: (N,3) metres.
        lag: (N,) firing time after the cloud's reference time, as a share of the time between the
            clouds; 0 if unknown.
        lidar: (N,) number of the scanner of each point; None for a single scanner.
    """

    points: Float
    lag: Float
    lidar: Int | None = None

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of `places` of the points."""
        return tree_of(self.places(self.points, np.arange(len(self.points))))

    @cached_property
    def even_tree(self) -> cKDTree:
        """Search tree of one point per 0.06 m voxel: points are denser along scan lines."""
        places = self.places(self.points, np.arange(len(self.points)))
        return tree_of(places[one_per_voxel(places, _EVEN_M)])

    def places(self, points: Float, rows: Int) -> Float:
        """Return search coordinates (N,3) or (N,4) that keep different scanners far apart.

        Each scanner measures an object at another time.

        Args:
            points: (N,3) metres, for example moved points of the cloud.
            rows: (N,) rows of these points in the cloud, which tell their scanners.
        """
        if self.lidar is None:
            return points
        return np.column_stack([points, 1e4 * self.lidar[rows]])


@dataclass(frozen=True)
class RigidMotion:
    """The motion of an object from the source's reference time to the target's.

    Attributes:
        state: (4,) displacement x, y, z (m) and yaw (rad) about ``centre``.
        centre: (3,) centre of the rotation, in the frame of the clouds.
        seen_share: Share of the motion between the measurements in source and target, about 1.
    """

    state: Float
    centre: Float
    seen_share: float

    def seen(self, points: Float) -> Float:
        """Return (N,3) points, moved from their measured position in the source to the target's."""
        return self.carry(points, self.seen_share)

    def carry(self, points: Float, share: float | Float) -> Float:
        """Return (N,3) points of the object, moved by a share of the motion or by (N,) shares."""
        return apply(self.state * np.reshape(share, (-1, 1)), points, self.centre)


class Surface:
    """M points of the target, with the inverse covariance (M,3,3) of the surface around each."""

    def __init__(self, target: PairCloud, rows: Int) -> None:
        self.points, self.lag = target.points[rows], target.lag[rows]
        self.tree = tree_of(target.places(self.points, rows))
        tree = self.tree if target.lidar is None else tree_of(self.points)
        _, near = nearest_k(tree, self.points, NUM_NEAR)
        self.information = surface_information(self.points, near)


@dataclass
class Hypotheses:
    """Motions to try: H hypotheses with P sample points in all.

    Attributes:
        group: (H,) index of the group that moves.
        state: (H,4) displacement and yaw, see `RigidMotion`.
        centre: (H,3) centre of the rotation, see `RigidMotion`.
        row: (P,) rows of the sample points in the source.
        of_point: (P,) index of the hypothesis of each sample point.
        share: (H,) share of the motion between the group's measurements in source and target.
    """

    source: PairCloud
    group: Int
    state: Float
    centre: Float
    row: Int
    of_point: Int
    share: Float

    @staticmethod
    def of(
        groups: list[Int],
        source: PairCloud,
        target: PairCloud,
        candidates: Int,
        initial: Float | None,
        apart_s: float | None,
        ground: HeightMap,
    ) -> Hypotheses:
        """Return every group's hypotheses: at voted displacements, at rest, at ``initial``.

        All displacements follow the slope of the ground.

        Args:
            groups: Indices in ``source`` of each group's points.
            candidates: Indices in ``target`` of points that may be moving.
            initial: (N,3) flow of the source points, at whose median a group also starts, or None.
            apart_s: Time between the clouds, None if unknown.
        """
        group, state, centre, row = [], [], [], []
        there = target.points[candidates]
        num_steps = _num_vote_steps(apart_s)
        for k, members in enumerate(groups):
            sample = thinned(members, _ALIGN_POINTS)
            starts = _vote(source.points[thinned(members, _VOTE_POINTS)], there, num_steps)
            if initial is not None:
                starts = np.vstack([starts, np.median(initial[members], axis=0)])
            middle = source.points[sample].mean(0)
            starts[:, 2] = starts[:, :2] @ slope_of(ground, middle)
            for start in starts:
                group.append(k)
                state.append(np.append(start, 0.0))
                centre.append(middle)
                row.append(sample)
        of_point = np.repeat(np.arange(len(row)), [len(r) for r in row])
        return Hypotheses(
            source,
            np.array(group),
            np.array(state),
            np.array(centre),
            np.concatenate(row),
            of_point,
            np.ones(len(row)),
        )

    def seen(self, share: Float) -> Float:
        """Return the (P,3) sample points, each moved by a share (P,) of its hypothesis's motion."""
        state = self.state[self.of_point] * share[:, None]
        return apply(state, self.source.points[self.row], self.centre[self.of_point])

    def align(self, surface: Surface) -> None:
        """Align all hypotheses by Gauss-Newton steps, changing state and share in place.

        A match spans the time from its measurement in the source to the one in the target.
        """
        start = self.state.copy()
        lag = self.source.lag[self.row]
        for gate_m in GATES_M:
            place = self.source.places(self.seen(self.share[self.of_point]), self.row)
            far, index = surface.tree.query(place, distance_upper_bound=gate_m, workers=-1)
            far, index = np.asarray(far), np.asarray(index)
            near = np.flatnonzero(np.isfinite(far))
            match, h = index[near], self.of_point[near]
            share = self.share[self.of_point]
            share[near] = 1 + surface.lag[match] - lag[near]
            weight = (1 - (far[near] / gate_m) ** 2) ** 2
            count = np.bincount(h, minlength=len(self.state))
            weight *= np.minimum(1.0, MAX_WEIGHT / np.maximum(count, 1))[h]
            seen = self.seen(share)[near]
            self.state = self.state - _step(
                seen - surface.points[match],
                seen - self.centre[h] - self.state[h, :3] * share[near, None],
                share[near],
                surface.information[match] * weight[:, None, None],
                h,
                _PRECISION * (self.state - start * _FROM_START),
            )
            matched = count > 0
            total = np.bincount(h, share[near], len(count))
            self.share[matched] = total[matched] / count[matched]


def _step(
    residual: Float, arm: Float, share: Float, information: Float, of_point: Int, prior: Float
) -> Float:
    """Return the (H,4) Gauss-Newton steps of all hypotheses, to be subtracted from the states.

    Args:
        residual: (K,3) vectors, metres, of K matches from the target's point to the moved point.
        arm: (K,3) vectors from the moved centre of rotation to the moved point.
        share: (K,) share of the motion that the point has made.
        information: (K,3,3) inverse covariance of the target's surface, 1/m².
        of_point: (K,) index of the hypothesis.
        prior: (H,4) gradient of the prior.
    """
    J = np.zeros((len(arm), 3, 4))
    J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = 1.0
    J[:, 0, 3], J[:, 1, 3] = -arm[:, 1], arm[:, 0]
    J *= share[:, None, None]
    JA = np.einsum("nik,nij->nkj", J, information)
    rows = np.concatenate([(JA @ J).reshape(-1, 16), (JA @ residual[..., None])[..., 0]], axis=1)
    total = np.stack([np.bincount(of_point, column, len(prior)) for column in rows.T], axis=1)
    H = total[:, :16].reshape(-1, 4, 4) + np.diag(_PRECISION)
    g = total[:, 16:] + prior
    return np.asarray(np.linalg.solve(H, g[..., None])[..., 0], np.float64)


def _num_vote_steps(apart_s: float | None) -> int:
    """Return the number of vote steps (0.2 m) that the fastest object may travel."""
    apart_s = _USUAL_S if apart_s is None else min(apart_s, _LONGEST_S)
    return max(1, round(_MAX_SPEED_M_S * apart_s / _VOTE_STEP_M))


def _vote(points: Float, there: Float, n: int) -> Float:
    """Return the (S,3) displacements, zero first, that bring most points close to the other cloud.

    Each point votes for all displacements of up to n steps of 0.2 m that bring it there.

    ``points`` (N,3) are a group, ``there`` (M,3) the other cloud.
    """
    zero = np.zeros((1, 3))
    span_m = np.array([n * _VOTE_STEP_M, n * _VOTE_STEP_M, _VOTE_SLACK_M])
    around = ((there > points.min(0) - span_m) & (there < points.max(0) + span_m)).all(1)
    there = there[thinned(np.flatnonzero(around), _VOTE_TARGETS)]
    if not len(there):
        return zero
    way = there - points[:, None, :]
    cell = np.rint(way[..., :2] / _VOTE_STEP_M).astype(np.int64) + n
    inside = ((cell >= 1) & (cell <= 2 * n - 1)).all(-1) & (np.abs(way[..., 2]) < _VOTE_SLACK_M)
    voter = np.nonzero(inside)[0]
    ballot = np.zeros((len(points), 2 * n + 1, 2 * n + 1), np.float32)
    ballot[voter, cell[inside][:, 0], cell[inside][:, 1]] = 1.0
    for axis in (1, 2):  # a position one cell away gets half a vote
        ballot = np.maximum(
            ballot, 0.5 * np.maximum(np.roll(ballot, 1, axis), np.roll(ballot, -1, axis))
        )
    x, y = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    place = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) * _VOTE_STEP_M
    length_m = np.linalg.norm(place, axis=1)
    score = ballot.mean(0, dtype=np.float64).ravel() - 1e-3 * length_m
    score[length_m > n * _VOTE_STEP_M] = -1
    starts = [zero]
    for _ in range(_NUM_VOTED):
        best = place[np.argmax(score)]
        starts.append(best[None])
        score[np.linalg.norm(place - best, axis=1) < _APART_M] = -1
    return np.concatenate(starts)


def slope_of(ground: HeightMap, place: Float) -> Float:
    """Return the slope (2,) of the ground along x and y, around a position (3,).

    It is 0 where the height map is not plane, because clouds may come without ground points.
    """
    steps = np.arange(-_SLOPE_STEPS, _SLOPE_STEPS + 1) * _SLOPE_STEP_M
    arm = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    height_m = ground.under(place[:2] + arm)
    height_m -= height_m.mean()
    slope: Float = arm.T @ height_m / (arm**2).sum(axis=0)
    return slope if (height_m - arm @ slope).std() <= _ROUGH_M else np.zeros(2)


def one_per_voxel(places: Float, side_m: float) -> Int:
    """Return the indices of the first point in each cube of side ``side_m``.

    ``places`` (N,3) or (N,4) are search coordinates of the points, from `PairCloud.places`.
    """
    voxel = np.floor(places / side_m).astype(np.int64)
    key = voxel @ np.array([1, 1 << 20, 1 << 40, 7][: voxel.shape[1]])
    return np.sort(np.unique(key, return_index=True)[1])


def thinned(rows: Int, num: int) -> Int:
    """Return at most ``num`` of the rows, evenly spaced."""
    return rows[:: (len(rows) - 1) // num + 1] if len(rows) else rows
