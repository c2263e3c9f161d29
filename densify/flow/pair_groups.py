# SPDX-License-Identifier: MIT
"""Find the rigid groups of one cloud that certainly moved to another position in another cloud.

The rings of a scanner hit other parts of an object after it has moved. Therefore a point may lie
anywhere along a surface of the other cloud, but not off it: the neighbours of a position are
thinned until they span several rings, and a normal distribution is fitted to them (Biber, Straßer,
"The Normal Distributions Transform", IROS 2003). A group starts at the displacements at which most
of its points come close to the other cloud (Hough 1962), and is aligned from there. A motion is
judged by the likelihood ratio of both clouds: the group moves, or it is static. Points with firing
times are compared at their own times.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from densify.flow.surface_matching import GATES_M, MIN_FIT, NUM_NEAR, Model, apply, undo
from densify.flow.tracking.candidates import LINK_M, Strips, cluster_around
from densify.flow.tracking.following import (
    FEW_POINTS,
    FIT_M,
    MAX_SPEED_M_S,
    MIN_POINTS,
    PREDICTION_STD,
    STEP_M,
    DistanceField,
    Group,
)
from densify.free_space.ground import HeightMap
from densify.geometry.nearest import is_near, link, thinned, tree_of
from densify.geometry.types import Bool, Float, Float32, Int

SURFACE_M = 1.0
"""Greatest distance of a neighbour that spans the surface at a position."""
MISSING = 3.0
"""Cost of a point without surface, and greatest cost."""
_MIN_NEIGHBORS = 3
_NOISE_M = 0.1  # of a point, of a motion, and of level ground; a closer point is a counterpart
_EVEN_M = 0.15  # voxel in which one point is kept, because points are denser along rings


@dataclass(frozen=True)
class PairCloud:
    """The N points of a cloud above the ground."""

    points: Float  # (N,3) metres
    # (N,) share of the motion at the firing time: 0 at the source's reference time, 1 at the
    # target's
    share: Float

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)

    @cached_property
    def _even(self) -> Bool:
        even = np.zeros(len(self.points), bool)
        even[thinned(self.points, np.arange(len(even)), _EVEN_M, 1)] = True
        return even

    def evenly(self, rows: Int) -> Int:
        """Return the rows that are the only ones kept in their voxel of 0.15 m."""
        return rows[self._even[rows]]

    def rows_around(self, points: Float) -> Int:
        """Return the even rows in the box around points (K,3), or within `SURFACE_M` of it."""
        if not len(points):
            return np.zeros(0, np.int64)
        low, high = points.min(axis=0) - SURFACE_M, points.max(axis=0) + SURFACE_M
        return self.evenly(self.strips.rows_inside(low, high))


class Surface:
    """The surfaces around the given points (M,3)."""

    def __init__(self, points: Float) -> None:
        self._points, self._tree = points, tree_of(points)

    def cost(self, points: Float) -> Float:
        """Return (N,) costs of points (N,3), 0 to 3: half their squared Mahalanobis distances."""
        cost, num = np.full(len(points), MISSING), min(NUM_NEAR, self._tree.n)
        if num < _MIN_NEIGHBORS:
            return cost
        ranks = np.arange(1, num + 1)
        away_m, row = self._tree.query(points, ranks, distance_upper_bound=SURFACE_M)
        exists = np.isfinite(away_m)
        enough = np.flatnonzero(exists.sum(axis=1) >= _MIN_NEIGHBORS)
        exists, row = exists[enough], np.asarray(row)[enough]
        weight = exists / exists.sum(axis=1, keepdims=True)
        arms = self._points[np.where(exists, row, 0)]
        mean = np.einsum("nk,nki->ni", weight, arms)
        arms -= mean[:, None]
        covariance = arms.transpose(0, 2, 1) @ (weight[..., None] * arms) + _NOISE_M**2 * np.eye(3)
        off = points[enough] - mean
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
        cost[enough] = np.minimum(squared / 2, MISSING)
        return cost


_MAX_EXTENT_M = 20.0  # horizontal diagonal of the longest vehicle
_MAX_LOW_M, _MAX_HIGH_M = 3.4, 6.0  # greatest heights of a group's lowest and highest points


def find_unexplained(cloud: PairCloud, other_cloud: PairCloud) -> Bool:
    """Return (N,) True for points of ``cloud`` without a counterpart in ``other_cloud``.

    A counterpart is a point of the other cloud within 0.1 m, or one of its surfaces.
    """
    unmatched = np.flatnonzero(~is_near(tree_of(other_cloud.points), cloud.points, _NOISE_M))
    surface = Surface(other_cloud.points[other_cloud.evenly(np.arange(len(other_cloud.points)))])
    unexplained = np.zeros(len(cloud.points), bool)
    unexplained[unmatched] = surface.cost(cloud.points[unmatched]) > MISSING / 2
    return unexplained


def group_around(points: Float, unexplained: Bool) -> Int:
    """Return (N,) labels of the groups of points (N,3) that may be moving, -1 for none.

    Connected points form one group if it is no longer than a vehicle. In longer groups only the
    points close to unexplained points form groups.
    """
    num, label = link(points, LINK_M)
    low, high = np.full((num, 2), np.inf), np.full((num, 2), -np.inf)
    np.minimum.at(low, label, points[:, :2])
    np.maximum.at(high, label, points[:, :2])
    whole = np.linalg.norm(high - low, axis=1) <= _MAX_EXTENT_M
    group, long_rows = label.copy(), np.flatnonzero(~whole[label])
    _, cluster = cluster_around(points[long_rows], unexplained[long_rows])
    group[long_rows] = np.where(cluster >= 0, num + cluster, -1)
    return group


def road_users(group: Int, unexplained: Bool, height_m: Float32) -> list[Int]:
    """Return the rows of each group that may be a road user, not a crown or a wall.

    All arrays are (N,). ``group`` is -1 for none, ``height_m`` is above the ground.
    """
    rows = np.flatnonzero(group >= 0)
    rows = rows[np.argsort(group[rows], kind="stable")]
    groups = np.split(rows, np.flatnonzero(np.diff(group[rows])) + 1)
    users = []
    for members in groups:
        if len(members) >= MIN_POINTS and unexplained[members].sum() >= MIN_FIT:
            low_m, high_m = np.percentile(height_m[members], (5, 95))
            if low_m <= _MAX_LOW_M and high_m <= _MAX_HIGH_M:
                users.append(members)
    return users


_USUAL_S, _LONGEST_S = 0.1, 0.4  # assumed time between clouds if unknown; greatest time
MIN_MOTION_M = 0.1  # a shorter motion, or difference of two, may be an error of registration
_NUM_STARTS, _APART_M = 5, 0.5  # displacements from the vote, and their least distance
_PER_M = 1e-3  # loss of the vote per metre: of equal displacements the shortest is taken
_REFINE_M = (0.08, 0.04, 0.02)  # steps of the refinement
_YAW_PER_M = 0.25  # rad: 4 m from the centre, a point moves by the same step
_START_M = 1.0  # standard deviation of a start
_MIN_GAIN = 10.0  # least log-likelihood ratio in each cloud: thousands of motions are tried
_BALANCE = 0.25  # least gain of the target points, relative to the source: both are one object
_MAX_MISFIT = 1.7  # greatest mean cost of the moved points
_THIN_M, _ALONG = 0.05, 0.3  # a wall's thickness (rms), motion across
_BAR_M, _LEVEL, _ACROSS = 0.12, 0.5, 0.2  # a rail's width (rms), rise, motion across
_MAX_BAR_M, _MAX_BAR_POINTS = 0.75, 60  # length (rms) and points of a far car's back
_SLOPE_STEP_M, _SLOPE_STEPS = 2.0, 4  # of the grid that is fitted around a position


@dataclass(frozen=True)
class RigidMotion:
    """The motion of an object from the source's reference time to the target's."""

    state: Float  # (4,) displacement x, y, z (m) and yaw (rad) about ``centre``
    centre: Float  # (3,) centre of the rotation, in the frame of the clouds

    def place(self, points: Float, share: float | Float) -> Float:
        """Return (N,3) points moved from the source's reference time, by a share or (N,) shares."""
        return apply(self.state * np.reshape(share, (-1, 1)), points, self.centre)

    def undo(self, points: Float, share: float | Float) -> Float:
        """Return (N,3) points moved back to the source's reference time, the inverse of `place`."""
        return undo(self.state * np.reshape(share, (-1, 1)), points, self.centre)

    def at_start(self, cloud: PairCloud, rows: Int) -> Float:
        """Return the (K,3) points ``rows`` of a cloud at the source's reference time."""
        return self.undo(cloud.points[rows], cloud.share[rows])


@dataclass(frozen=True, eq=False)
class Proposal:
    """A motion of a group, and the evidence for it in both clouds."""

    group: int  # index of the group
    motion: RigidMotion  # motion of the group
    source_gain: float  # log-likelihood ratio of the source points, moved against static
    misfit: float  # mean cost of the moved points (see `Surface.cost`)
    rows: Int  # (K,) indices of the target points near the group, moved or static
    target_gain: Float  # (K,) log-likelihood ratios of these points

    @property
    def gain(self) -> float:
        """The log-likelihood ratio of both clouds, without target points that fit static better."""
        # They would pull the motion: an object shows other parts after it has moved.
        return self.source_gain + float(np.maximum(self.target_gain, 0.0).sum())

    def goes_with(self, proposal: Proposal) -> bool:
        """Return True if the motion of ``proposal``, at this group, is nearly the same."""
        centre = self.motion.centre[None]
        offset = self.motion.place(centre, 1.0) - proposal.motion.place(centre, 1.0)
        return bool(np.linalg.norm(offset) < FIT_M)

    def moves(self, free: Bool | None = None) -> bool:
        """Return True if the group certainly moves.

        free: (K,) True for target points that no other motion explains. None for all.
        """
        counted = (
            self.target_gain if free is None else self.target_gain[free | (self.target_gain < 0)]
        )
        min_gain = max(_MIN_GAIN, _BALANCE * self.source_gain)
        gains_enough = self.source_gain > _MIN_GAIN and counted.sum() > min_gain
        return bool(gains_enough and self.misfit < _MAX_MISFIT)


def judge(
    group: int, members: Int, motion: RigidMotion, source: PairCloud, target: PairCloud
) -> Proposal:
    """Return the evidence that the source points ``members`` move together, against static ones.

    Source points are compared with the target. Target points are compared with the source, in which
    only the group moves: points that stay at its old position count against the motion.
    """
    static = replace(motion, state=np.zeros(4))
    members = source.evenly(members)
    cost_static, near_static = compare(source, members, target, static)
    cost_moved, near_moved = compare(source, members, target, motion)
    rows = np.union1d(near_static, near_moved)
    points = target.points[rows]
    rows_around = source.rows_around(points)
    static_rows = np.setdiff1d(rows_around, members, assume_unique=True)
    target_cost = Surface(motion.at_start(source, members)).cost(motion.at_start(target, rows))
    target_cost = np.minimum(target_cost, Surface(source.points[static_rows]).cost(points))
    target_gain = Surface(source.points[rows_around]).cost(points) - target_cost
    gain = float((cost_static - cost_moved).sum())
    return Proposal(group, motion, gain, float(cost_moved.mean()), rows, target_gain)


def compare(
    source: PairCloud, members: Int, target: PairCloud, motion: RigidMotion
) -> tuple[Float, Int]:
    """Compare source points ``members`` (N,), which make a motion, with the target's surfaces.

    Return the (N,) costs, and the indices of the target points that come close to the source points
    when they are moved back.
    """
    at_start = motion.at_start(source, members)
    ends = [motion.place(at_start, limit(target.share)) for limit in (np.min, np.max)]
    rows = target.rows_around(np.concatenate(ends))
    back = motion.at_start(target, rows)
    close = _in_box(back, at_start, SURFACE_M)
    return Surface(back[close]).cost(at_start), rows[close]


@dataclass(frozen=True)
class Search:
    """Search for motions of groups of source points."""

    source: PairCloud  # points above the ground
    target: PairCloud  # points of the other cloud above the ground
    movable: Bool  # (M,) True for target points that may be moving
    ground: HeightMap  # height of the ground
    apart_s: float | None  # time between the clouds, None if unknown
    # (N,3) flow of the source points, at whose median a group also starts, or None
    initial: Float | None

    def proposals(self, group: int, members: Int) -> list[Proposal]:
        """Return the motions by which the points ``members`` may move, with their evidence."""
        points = self.source.points[members]
        centre = points.mean(axis=0)
        reach_m = MAX_SPEED_M_S * min(self.apart_s or _USUAL_S, _LONGEST_S)
        limit_m, starts = reach_m, []
        if self.initial is not None:
            starts = [np.median(self.initial[members], axis=0)]
            limit_m = max(reach_m, float(np.linalg.norm(starts[0])) + _APART_M)
        room_m = np.array([limit_m, limit_m, 0.0]) + LINK_M
        rows = self.target.strips.rows_inside(points.min(0) - room_m, points.max(0) + room_m)
        rows = rows[self.movable[rows]]
        if not len(rows):
            return []
        slope = _slope_of(self.ground, centre)
        starts += self._vote(members, rows, slope, reach_m)
        judged, states = list[Proposal](), list[Float]()
        for start in starts:
            state = self._align(RigidMotion(np.append(start, 0.0), centre), members, rows)
            if state is None or any(
                np.abs(state - s)[[0, 1, 3]].max() < MIN_MOTION_M for s in states
            ):
                continue
            states.append(state)
            state[2] = state[:2] @ slope
            moved_m = np.linalg.norm(state[:2])
            if MIN_MOTION_M < moved_m <= limit_m and not _ambiguous(points, state[:3]):
                motion = RigidMotion(state, centre)
                judged.append(judge(group, members, motion, self.source, self.target))
        return [proposal for proposal in judged if proposal.moves()]

    def refine(self, proposal: Proposal, members: Int) -> Proposal:
        """Return the proposal with the most likely motion nearby, by a pattern search.

        Hooke, Jeeves, JACM 1961. The alignment holds rings on rings, the likelihood does not.
        """
        slope = _slope_of(self.ground, proposal.motion.centre)
        x, y = proposal.motion.state[:2] / np.linalg.norm(proposal.motion.state[:2])
        axes = np.array([[x, y, 0, 0], [-y, x, 0, 0], [0, 0, 0, _YAW_PER_M]])
        for step_m in _REFINE_M:
            previous = None
            while previous is not proposal:
                previous = proposal
                for axis in (*axes, *-axes):
                    state = proposal.motion.state + step_m * axis
                    state[2] = state[:2] @ slope
                    motion = replace(proposal.motion, state=state)
                    trial = judge(proposal.group, members, motion, self.source, self.target)
                    proposal = max(proposal, trial, key=lambda p: p.gain)
        return proposal

    def _vote(self, members: Int, rows: Int, slope: Float, reach_m: float) -> list[Float]:
        """Return displacements (3,) that bring most members close to the target points ``rows``."""
        source, target = self.source, self.target
        group = Group.of(source.points[members], source.share[members]).thinned(FEW_POINTS)
        field = DistanceField.of(target.points[rows], target.share[rows])
        steps = np.arange(-(reach_m // STEP_M), reach_m // STEP_M + 1) * STEP_M
        displacements = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        displacements = displacements[np.hypot(*displacements.T) <= reach_m]
        displacements = np.column_stack([displacements, displacements @ slope])
        nearness = np.zeros((len(displacements), len(group.points)), np.uint8)
        field.raise_to(nearness, group, displacements)
        score = nearness.mean(axis=1) / 255 - _PER_M * np.linalg.norm(displacements, axis=1)
        voted = []
        for _ in range(_NUM_STARTS):
            voted.append(displacements[np.argmax(score)])
            score[np.linalg.norm(displacements - voted[-1], axis=1) < _APART_M] = -1.0
        return voted

    def _align(self, start: RigidMotion, members: Int, rows: Int) -> Float | None:
        """Return the state (4,) that aligns members with target rows, None for too few matches."""
        model = Model(start.at_start(self.source, self.source.evenly(members)))
        back = start.at_start(self.target, self.target.evenly(rows))
        arrived = start.place(back[_in_box(back, model.points, GATES_M[0])], 1.0)
        if len(arrived) < MIN_FIT:
            return None
        std = np.append([_START_M, _START_M], PREDICTION_STD[2])
        return model.align(arrived, start.centre, start.state, std)


def _in_box(points: Float, inner: Float, slack_m: float) -> Bool:
    """Return (N,) True for points in the box around the points ``inner``, or close to it."""
    if not len(inner):
        return np.zeros(len(points), bool)
    inside = (points > inner.min(axis=0) - slack_m) & (points < inner.max(axis=0) + slack_m)
    return np.asarray(inside.all(axis=1))


def _slope_of(ground: HeightMap, position: Float) -> Float:
    """Return the slope (2,) of the ground around a position (3,), 0 where it is not plane."""
    steps = np.arange(-_SLOPE_STEPS, _SLOPE_STEPS + 1) * _SLOPE_STEP_M
    away = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    height_m = ground.under(position[:2] + away)
    height_m -= height_m.mean()
    slope: Float = away.T @ height_m / (away**2).sum(axis=0)
    is_plane = (height_m - away @ slope).std() <= _NOISE_M  # not in clouds without ground points
    return slope if is_plane else np.zeros(2)


def _ambiguous(points: Float, displacement: Float) -> bool:
    """Return True if the moved group could be another part of the same wall or rail."""
    _, scale, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    length_m, width_m, thickness_m = scale / np.sqrt(len(points))
    moved_m = np.linalg.norm(displacement)
    if width_m < _BAR_M and abs(axes[0, 2]) < _LEVEL:  # a rail, or the back of a far car
        far_car = len(points) < _MAX_BAR_POINTS and length_m < _MAX_BAR_M
        return bool(not far_car or abs(axes[0] @ displacement) > _ACROSS * moved_m)
    along = abs(axes[-1] @ displacement) < _ALONG * moved_m
    return bool(thickness_m < _THIN_M and (along or width_m < _THIN_M))


_BESIDE_M = 5.0  # groups closer than this may be parts of one object


def find_movers(
    source: PairCloud,
    target: PairCloud,
    height_m: Float32,
    ground: HeightMap,
    apart_s: float | None = None,
    initial: Float | None = None,
) -> tuple[list[RigidMotion], Int]:
    """Return the motions of the moving groups, and (N,) the index of each source point's, or -1.

    Args:
        height_m: (N,) height of the source points above the ground.
        apart_s: Time between the clouds, None if unknown. The search covers up to 38 m/s.
        initial: (N,3) flow. A group also starts at the median flow of its members.
    """
    clouds = source, target
    with ThreadPoolExecutor(2) as pool:
        unexplained = list(pool.map(find_unexplained, clouds, clouds[::-1]))
        label, target_label = pool.map(group_around, (c.points for c in clouds), unexplained)
        groups = road_users(label, unexplained[0], height_m)
        search = Search(source, target, target_label >= 0, ground, apart_s, initial)
        of_groups = pool.map(search.proposals, range(len(groups)), groups)
        chosen = _choose([p for proposals in of_groups for p in proposals], len(target.points))
        refined = list(pool.map(search.refine, chosen, [groups[p.group] for p in chosen]))
    instance = np.full(len(source.points), -1)
    for k, proposal in enumerate(refined):
        instance[groups[proposal.group]] = k
    for k, proposal in enumerate(refined):
        _attach(k, proposal.motion, instance, source, target)
    return [proposal.motion for proposal in refined], instance


def _choose(proposals: list[Proposal], num_targets: int) -> list[Proposal]:
    """Return at most one proposal per group; a target point is explained by one motion only."""
    chosen: dict[int, Proposal] = {}
    explained_by = np.full(num_targets, -1)  # index in ``chosen``
    for i in np.argsort(-_gain_with_neighbours(proposals), kind="stable"):
        proposal = proposals[i]
        # Two scanners see one object at two positions, hence its groups may share target points.
        differs = [not proposal.goes_with(earlier) for earlier in chosen.values()]
        free = ~np.array([*differs, False])[explained_by[proposal.rows]]
        if proposal.group not in chosen and proposal.moves(free):
            explained_by[proposal.rows[proposal.target_gain > 0]] = len(chosen)
            chosen[proposal.group] = proposal
    return list(chosen.values())


def _gain_with_neighbours(proposals: list[Proposal]) -> Float:
    """Return the (P,) gain of each proposal and the groups beside it that may go with it."""
    # A car that two scanners see at two positions could also go half as fast, from the second
    # position to the first one, but its other appearance could not.
    centres = np.array([p.motion.centre for p in proposals]).reshape(-1, 3)
    total = np.zeros(len(proposals))
    for i, proposal in enumerate(proposals):
        gains = dict[int, float]()
        for j in np.flatnonzero(np.linalg.norm(centres - centres[i], axis=1) < _BESIDE_M):
            neighbour = proposals[j]
            if neighbour.goes_with(proposal):
                gains[neighbour.group] = max(neighbour.gain, gains.get(neighbour.group, 0.0))
        total[i] = sum((gains | {proposal.group: proposal.gain}).values())
    return total


def _attach(
    k: int, motion: RigidMotion, instance: Int, source: PairCloud, target: PairCloud
) -> None:
    """Assign source points within 1 m that fit the motion better than static to group k."""
    members = source.points[instance == k]
    low, high = members.min(axis=0) - SURFACE_M, members.max(axis=0) + SURFACE_M
    rows = source.strips.rows_inside(low, high)
    rows = rows[instance[rows] < 0]
    rows = rows[is_near(tree_of(members), source.points[rows], SURFACE_M)]
    if len(rows):
        static = RigidMotion(np.zeros(4), motion.centre)
        cost_static, cost_moved = (compare(source, rows, target, m)[0] for m in (static, motion))
        instance[rows[cost_moved < cost_static]] = k
