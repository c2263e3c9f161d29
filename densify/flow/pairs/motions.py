# SPDX-License-Identifier: MIT
"""Propose rigid motions of a group of points between two clouds, and judge them.

A group starts at the displacements at which most of its points come close to the other cloud (Hough
1962), and is aligned from there. A motion is judged by the likelihood ratio of both clouds: the
group moves, or it is static. Points with firing times are compared at their own times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from densify.flow.pairs.surface import SURFACE_M, PairCloud, Surface
from densify.flow.surface_matching import GATES_M, MIN_FIT, Model, apply, undo
from densify.flow.tracking.candidates import LINK_M
from densify.flow.tracking.following import PREDICTION_STD
from densify.flow.tracking.vote import FEW_POINTS, MAX_SPEED_M_S, STEP_M, DistanceField, Group
from densify.free_space.ground import HeightMap
from densify.geometry.types import Bool, Float, Int

_USUAL_S, _LONGEST_S = 0.1, 0.4  # assumed time between clouds if unknown; greatest time
MIN_MOTION_M = 0.1  # a shorter motion may be an error of registration
_NUM_STARTS, _APART_M = 5, 0.5  # displacements from the vote, and their least distance
_PER_M = 1e-3  # loss of the vote per metre: of equal displacements the shortest is taken
_REFINE_M = (0.08, 0.04, 0.02)  # steps of the refinement
_YAW_PER_M = 0.25  # rad: 4 m from the centre, a point moves by the same step
_START_M = 1.0  # standard deviation of a start
_SAME = 0.1  # greatest difference of two states that are one, m or rad
_MIN_GAIN = 10.0  # least log-likelihood ratio in each cloud: thousands of motions are tried
_BALANCE = 0.25  # least gain of the target points, relative to the source: both are one object
_MAX_MISFIT = 1.7  # greatest mean cost of the moved points
_TOGETHER_M = 0.3  # groups that differ less are parts of one object
_THIN_M, _ALONG = 0.05, 0.3  # a wall's thickness (rms), motion across
_BAR_M, _LEVEL, _ACROSS = 0.12, 0.5, 0.2  # a rail's width (rms), rise, motion across
_MAX_BAR_M, _MAX_BAR_POINTS = 0.75, 60  # length (rms) and points of a far car's back
_SLOPE_STEP_M, _SLOPE_STEPS = 2.0, 4  # of the grid that is fitted around a position
_ROUGH_M = 0.1  # a ground rougher than this has no slope


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
        return bool(np.linalg.norm(offset) < _TOGETHER_M)

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
            if state is None or any(np.abs(state - s)[[0, 1, 3]].max() < _SAME for s in states):
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
    is_plane = (height_m - away @ slope).std() <= _ROUGH_M  # not in clouds without ground points
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
