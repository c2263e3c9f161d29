# SPDX-License-Identifier: MIT
"""Find the rigid groups of one cloud that certainly moved to another position in another cloud.

The rings of a scanner hit other parts of an object after it has moved. A point therefore costs
nothing anywhere along a surface of the other cloud, a normal distribution fitted to neighbours
thinned until they span several rings (Biber, Straßer, "The Normal Distributions Transform", IROS
2003). A vote proposes displacements (Hough 1962), from which the group is aligned. The likelihood
ratio of both clouds judges if it moves. Firing times, where known, place the points.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

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

_SURFACE_M = 1.0  # greatest distance of a neighbour that spans the surface at a position
MISSING = 3.0  # cost of a point without surface, and greatest cost
_NOISE_M = 0.1  # standard deviation of a point and of level ground; a closer point is a counterpart
_THINNING_M = 0.15  # voxel in which one point is kept, because points are denser along rings


@dataclass(frozen=True)
class PairCloud:
    """The N points of a cloud above the ground."""

    points: Float  # (N,3) metres
    # (N,) share of the motion at the firing time: 0 at the reference time of the source, 1 at that
    # of the target
    share: Float

    @cached_property
    def strips(self) -> Strips:
        """Index of the points for box queries."""
        return Strips(self.points)

    @cached_property
    def _is_kept(self) -> Bool:
        """(N,) True for the only point that is kept in its voxel of 0.15 m."""
        is_kept = np.zeros(len(self.points), bool)
        is_kept[thinned(self.points, np.arange(len(is_kept)), _THINNING_M, 1)] = True
        return is_kept

    def thin(self, rows: Int) -> Int:
        """Return the given rows (K,) that are kept by thinning, at most one in each voxel."""
        return rows[self._is_kept[rows]]

    def rows_around(self, points: Float) -> Int:
        """Return the thinned rows in the box around points (K,3), or within 1 m of this box."""
        if not len(points):
            return np.zeros(0, np.int64)
        low, high = points.min(axis=0) - _SURFACE_M, points.max(axis=0) + _SURFACE_M
        return self.thin(self.strips.rows_inside(low, high))


def surface_cost(surface: Float, points: Float) -> Float:
    """Return half the squared Mahalanobis distances (N,) of points from a surface, at most 3.

    The surface at each of the ``points`` (N,3) is a normal distribution (mean m, covariance S) of
    the nearest points in ``surface`` (M,3). A point p costs (p - m)ᵀ S⁻¹ (p - m) / 2.
    """
    cost = np.full(len(points), MISSING)
    if len(surface) < 3:
        return cost
    ranks = np.arange(1, min(NUM_NEAR, len(surface)) + 1)
    distance_m, neighbour = tree_of(surface).query(points, ranks, distance_upper_bound=_SURFACE_M)
    exists = np.isfinite(distance_m)
    on_surface = np.flatnonzero(exists.sum(axis=1) >= 3)  # three points span a plane
    exists = exists[on_surface]
    neighbour = np.where(exists, np.asarray(neighbour)[on_surface], 0)
    # Normal distribution of the neighbours that exist; others have weight 0
    weight = exists / exists.sum(axis=1, keepdims=True)
    centred = surface[neighbour]
    mean = np.einsum("nk,nki->ni", weight, centred)
    centred -= mean[:, None]
    scatter = centred.transpose(0, 2, 1) @ (weight[..., None] * centred)
    covariance = scatter + _NOISE_M**2 * np.eye(3)
    offset = points[on_surface] - mean
    scaled_offset = np.linalg.solve(covariance, offset[..., None])[..., 0]
    squared = np.einsum("ni,ni->n", offset, scaled_offset)
    cost[on_surface] = np.minimum(squared / 2, MISSING)
    return cost


def _find_unexplained(cloud: PairCloud, other_cloud: PairCloud) -> Bool:
    """Return the (N,) mask of points without a surface or point of the other cloud near."""
    unmatched = np.flatnonzero(~is_near(tree_of(other_cloud.points), cloud.points, _NOISE_M))
    surface = other_cloud.points[other_cloud.thin(np.arange(len(other_cloud.points)))]
    unexplained = np.zeros(len(cloud.points), bool)
    # A cost of 1.5 is a distance of 1.7 standard deviations from the surface.
    unexplained[unmatched] = surface_cost(surface, cloud.points[unmatched]) > MISSING / 2
    return unexplained


def _group_around(points: Float, unexplained: Bool) -> Int:
    """Return the (N,) labels of the groups of points that may be moving, -1 for none.

    Points linked by steps of up to 0.6 m form one group if it is no longer than a vehicle, 20 m. In
    longer groups, such as walls, only points close to ``unexplained`` points form groups.
    """
    num_groups, group = link(points, LINK_M)
    low = np.full((num_groups, 2), np.inf)
    np.minimum.at(low, group, points[:, :2])
    high = np.full((num_groups, 2), -np.inf)
    np.maximum.at(high, group, points[:, :2])
    # The diagonal of a vehicle is at most 20 m.
    is_vehicle_sized = np.linalg.norm(high - low, axis=1) <= 20.0
    long_rows = np.flatnonzero(~is_vehicle_sized[group])
    _, cluster = cluster_around(points[long_rows], unexplained[long_rows])
    # Groups have labels below num_groups, hence labels from num_groups on are free for clusters.
    label = group.copy()
    label[long_rows] = np.where(cluster >= 0, num_groups + cluster, -1)
    return label


def _find_road_users(group: Int, unexplained: Bool, height_m: Float32) -> list[Int]:
    """Return the ascending rows of each group that may be a road user, not a treetop or a wall.

    Such a group has at least 8 points, 5 of them unexplained. Its lowest points (5th percentile)
    are at most 3.4 m above the ground, its highest points (95th percentile) at most 6 m.
    """
    rows = np.flatnonzero(group >= 0)
    rows = rows[np.argsort(group[rows], kind="stable")]
    begins = np.flatnonzero(np.diff(group[rows])) + 1  # where the label changes
    users = []
    for members in np.split(rows, begins):
        if len(members) >= MIN_POINTS and unexplained[members].sum() >= MIN_FIT:
            # Percentiles, because single points may be of something else
            low_m, high_m = np.percentile(height_m[members], (5, 95))
            # Treetops usually begin higher than 3.4 m, and facades end higher than 6 m.
            if low_m <= 3.4 and high_m <= 6.0:
                users.append(members)
    return users


# Time between the clouds that is assumed if the time is unknown, and the longest one searched
_USUAL_S, _LONGEST_S = 0.1, 0.4
MIN_MOTION_M = _NOISE_M  # a shorter motion, or difference, may be an error of registration
_APART_M = 0.5  # least distance between displacements from the vote
_MIN_GAIN = 10.0  # least log-likelihood ratio in each cloud: thousands of motions are tried
_MAX_MISFIT = 1.7  # greatest mean cost of the moved points
_WALL_M, _RAIL_M = 0.05, 0.12  # greatest thickness of a wall, and width of a rail (RMS)


@dataclass(frozen=True)
class RigidMotion:
    """The motion of an object from the source's reference time to the target's."""

    state: Float  # (4,) displacement x, y, z (m) and yaw (rad) about ``centre``
    centre: Float  # (3,) centre of the rotation, in the frame of the clouds

    def place(self, points: Float, share: float | Float) -> Float:
        """Return points (N,3) of the source's reference time, moved by one or (N,) shares."""
        return apply(self.state * np.reshape(share, (-1, 1)), points, self.centre)

    def undo(self, points: Float, share: float | Float) -> Float:
        """Return points (N,3) moved back to the source's reference time, the inverse of `place`."""
        return undo(self.state * np.reshape(share, (-1, 1)), points, self.centre)

    def at_start(self, cloud: PairCloud, rows: Int) -> Float:
        """Return the points ``rows`` (K,) of a cloud, moved to the source's reference time."""
        return self.undo(cloud.points[rows], cloud.share[rows])


@dataclass(frozen=True, eq=False)
class Proposal:
    """A motion of a group, and the evidence for it in both clouds."""

    group: int  # index of the group
    motion: RigidMotion  # motion of the group
    source_gain: float  # log-likelihood ratio of the source points, moved against static
    misfit: float  # mean `surface_cost` of the moved points
    rows: Int  # (K,) indices of the target points near the group, moved or static
    target_gain: Float  # (K,) log-likelihood ratios of these points

    @property
    def gain(self) -> float:
        """The log-likelihood ratio of moved against static, summed over the points of both clouds.

        Target points that fit a static object better count as 0.
        """
        # Target points on parts that the object showed only later would bias the motion.
        return self.source_gain + float(np.maximum(self.target_gain, 0.0).sum())

    def moves_like(self, other_proposal: Proposal) -> bool:
        """Return True if the motion of the other proposal, at this group, is nearly the same."""
        centre = self.motion.centre[None]
        offset = self.motion.place(centre, 1.0) - other_proposal.motion.place(centre, 1.0)
        return bool(np.linalg.norm(offset) < FIT_M)

    def moves(self, free: Bool | None = None) -> bool:
        """Return True if the group certainly moves.

        Target points that another motion explains have ``free`` (K,) False, and count only against
        the motion. None means that all are free.
        """
        counted_gain = self.target_gain
        if free is not None:
            counted_gain = self.target_gain[free | (self.target_gain < 0)]
        # Both clouds show the same object: the target's gain is a quarter of the source's at least.
        min_gain = max(_MIN_GAIN, self.source_gain / 4)
        is_explained = self.source_gain > _MIN_GAIN and counted_gain.sum() > min_gain
        return bool(is_explained and self.misfit < _MAX_MISFIT)


def judge(
    group: int, members: Int, motion: RigidMotion, source: PairCloud, target: PairCloud
) -> Proposal:
    """Judge one motion of a group by the evidence for it in both clouds.

    Source points are compared with the target. Target points are compared with the source, in which
    only the group moves: points that stay at its old position count against the motion.
    ``members`` (K,) are the rows of the group's points in the source.
    """
    static = replace(motion, state=np.zeros(4))
    members = source.thin(members)
    static_cost, static_rows = cost_on_target(source, members, target, static)
    moved_cost, moved_rows = cost_on_target(source, members, target, motion)
    rows = np.union1d(static_rows, moved_rows)
    points = target.points[rows]
    # If the group moves, a target point lies on the moved group or on the rest of the source.
    source_rows = source.rows_around(points)
    rest_rows = np.setdiff1d(source_rows, members, assume_unique=True)
    group_cost = surface_cost(motion.at_start(source, members), motion.at_start(target, rows))
    rest_cost = surface_cost(source.points[rest_rows], points)
    target_moved_cost = np.minimum(group_cost, rest_cost)
    target_static_cost = surface_cost(source.points[source_rows], points)
    return Proposal(
        group=group,
        motion=motion,
        source_gain=float((static_cost - moved_cost).sum()),
        misfit=float(moved_cost.sum()) / max(len(moved_cost), 1),
        rows=rows,
        target_gain=target_static_cost - target_moved_cost,
    )


def cost_on_target(
    source: PairCloud, members: Int, target: PairCloud, motion: RigidMotion
) -> tuple[Float, Int]:
    """Return the costs of source points ``members`` (K,) on the target's surfaces.

    Both clouds are moved back to the source's reference time, each point from its own share of the
    motion.

    Returns:
        The (K,) costs, 0 to 3, and the rows of the thinned target points that, moved back, are in
            the box around the source points or within 1 m of this box.
    """
    members_at_start = motion.at_start(source, members)
    # The target is measured over some time. The members cannot be far from the positions that they
    # have at the first or at the last of its firing times, hence only target points there can fit.
    end_shares = target.share.min(), target.share.max()
    positions = [motion.place(members_at_start, share) for share in end_shares]
    rows = target.rows_around(np.concatenate(positions))
    target_at_start = motion.at_start(target, rows)
    is_close = _in_box(target_at_start, members_at_start, _SURFACE_M)
    return surface_cost(target_at_start[is_close], members_at_start), rows[is_close]


@dataclass(frozen=True)
class _Search:
    """Search for the motions of groups of source points in the target."""

    source: PairCloud  # points above the ground
    target: PairCloud  # points of the other cloud above the ground
    movable: Bool  # (M,) True for target points that may be moving
    ground: HeightMap  # height of the ground
    apart_s: float | None  # time between the clouds, None if unknown
    # (N,3) flow of the source points, at whose median a group also starts, or None
    initial: Float | None

    def proposals(self, group: int, members: Int) -> list[Proposal]:
        """Return the motions that both clouds clearly support for a group of source points.

        Motions below 0.1 m or along a wall or a rail are left out.
        """
        points = self.source.points[members]
        vote_radius_m = MAX_SPEED_M_S * min(self.apart_s or _USUAL_S, _LONGEST_S)
        max_motion_m, initial_flow = vote_radius_m, None
        if self.initial is not None:
            # The initial flow may be longer than any displacement that is voted for.
            initial_flow = np.median(self.initial[members], axis=0)
            max_motion_m = max(vote_radius_m, float(np.linalg.norm(initial_flow)) + _APART_M)
        margin_m = np.array([max_motion_m, max_motion_m, 0.0]) + LINK_M  # motions are horizontal
        rows = self.target.strips.rows_inside(points.min(0) - margin_m, points.max(0) + margin_m)
        rows = rows[self.movable[rows]]
        if not len(rows):
            return []
        slope = _slope_of(self.ground, points.mean(axis=0))
        displacements = self._vote(members, rows, slope, vote_radius_m)
        if initial_flow is not None:
            displacements = [initial_flow, *displacements]
        proposals = []
        for motion in self._aligned_motions(displacements, members, rows, slope):
            moved_m = np.linalg.norm(motion.state[:2])
            is_in_range = MIN_MOTION_M < moved_m <= max_motion_m
            if is_in_range and not _is_ambiguous(points, motion.state[:3]):
                proposal = judge(group, members, motion, self.source, self.target)
                if proposal.moves():
                    proposals.append(proposal)
        return proposals

    def _aligned_motions(
        self, displacements: list[Float], members: Int, rows: Int, slope: Float
    ) -> list[RigidMotion]:
        """Return the different motions, one per start, that align members with target rows."""
        centre = self.source.points[members].mean(axis=0)
        motions = list[RigidMotion]()
        for displacement in displacements:
            start = RigidMotion(np.append(displacement, 0.0), centre)
            state = self._align(start, members, rows)
            if state is None or any(_are_alike(state, earlier.state) for earlier in motions):
                continue
            state[2] = state[:2] @ slope  # rise in z: the group stays on the ground
            motions.append(RigidMotion(state, centre))
        return motions

    def refine(self, proposal: Proposal, members: Int) -> Proposal:
        """Return the proposal with the most likely motion near that of a proposal.

        Alignment is biased towards positions at which scan lines match scan lines. The likelihood
        is not. A pattern search raises the likelihood (Hooke, Jeeves, JACM 1961).
        """
        slope = _slope_of(self.ground, proposal.motion.centre)
        # Axes (x, y, z, yaw) along and across the motion, and about the vertical, where 1/4 rad
        # moves a point 4 m from the centre by 1 m
        x, y = proposal.motion.state[:2] / np.linalg.norm(proposal.motion.state[:2])
        axes = np.array([[x, y, 0, 0], [-y, x, 0, 0], [0, 0, 0, 1 / 4]])
        for step_m in (0.08, 0.04, 0.02):
            # Steps are taken as long as one of them raises the gain.
            previous = None
            while previous is not proposal:
                previous = proposal
                for axis in (*axes, *-axes):
                    state = proposal.motion.state + step_m * axis
                    state[2] = state[:2] @ slope
                    motion = replace(proposal.motion, state=state)
                    trial = judge(proposal.group, members, motion, self.source, self.target)
                    proposal = max(proposal, trial, key=lambda candidate: candidate.gain)
        return proposal

    def _vote(self, members: Int, rows: Int, slope: Float, radius_m: float) -> list[Float]:
        """Return five displacements (3,) that bring most members near target points ``rows``."""
        group = Group.of(self.source.points[members], self.source.share[members])
        group = group.thinned(FEW_POINTS)
        field = DistanceField.of(self.target.points[rows], self.target.share[rows])
        # All displacements along the ground within the radius
        steps = np.arange(-(radius_m // STEP_M), radius_m // STEP_M + 1) * STEP_M
        displacements = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        displacements = displacements[np.hypot(*displacements.T) <= radius_m]
        displacements = np.column_stack([displacements, displacements @ slope])
        nearness = np.zeros((len(displacements), len(group.points)), np.uint8)
        field.raise_nearness(nearness, group, displacements)
        # Of displacements with nearly equal nearness the shortest wins.
        score = nearness.mean(axis=1) / 255 - 1e-3 * np.linalg.norm(displacements, axis=1)
        # The best displacement, then the best of those at least 0.5 m away from it, and so on
        voted = []
        for _ in range(5):
            voted.append(displacements[np.argmax(score)])
            score[np.linalg.norm(displacements - voted[-1], axis=1) < _APART_M] = -1.0
        return voted

    def _align(self, start: RigidMotion, members: Int, rows: Int) -> Float | None:
        """Return the state (4,) that aligns members with target points, None for few matches."""
        model = Model(start.at_start(self.source, self.source.thin(members)))
        target_points = start.at_start(self.target, self.target.thin(rows))
        is_close = _in_box(target_points, model.points, GATES_M[0])
        arrived = start.place(target_points[is_close], 1.0)
        if len(arrived) < MIN_FIT:
            return None
        # Standard deviations of 1 m, so that the vote hardly constrains the alignment
        std = np.append([1.0, 1.0], PREDICTION_STD[2])
        return model.align(arrived, start.centre, start.state, std)


def _are_alike(state: Float, other_state: Float) -> bool:
    """Return True if two states (4,) differ by less than 0.1 m in x and y, and 0.1 rad in yaw."""
    x, y, _, yaw = np.abs(state - other_state)  # z follows from x and y
    return bool(max(x, y, yaw) < MIN_MOTION_M)


def _in_box(points: Float, inner: Float, slack_m: float) -> Bool:
    """Return the (N,) mask of points in the box around ``inner``, or within a slack of the box."""
    if not len(inner):
        return np.zeros(len(points), bool)
    inside = (points > inner.min(axis=0) - slack_m) & (points < inner.max(axis=0) + slack_m)
    return np.asarray(inside.all(axis=1))


def _slope_of(ground: HeightMap, position: Float) -> Float:
    """Return the slope (2,), rise per metre, of the ground around a position (3,), 0 if uneven."""
    steps = np.arange(-8.0, 9.0, 2.0)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    height_m = ground.under(position[:2] + offset)
    # Least squares: the grid is symmetric, hence both axes are independent.
    height_m -= height_m.mean()
    slope: Float = offset.T @ height_m / (offset**2).sum(axis=0)
    # A cloud without ground points has no plane ground.
    is_plane = (height_m - offset @ slope).std() <= _NOISE_M
    return slope if is_plane else np.zeros(2)


def _is_ambiguous(points: Float, displacement: Float) -> bool:
    """Return True if a static wall or rail, seen at another part, could explain a displacement."""
    # The singular vectors are the axes of the points, from the longest to the shortest. The third
    # is the normal of a wall.
    _, scale, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    length_m, width_m, thickness_m = scale / np.sqrt(len(points))  # RMS along the three axes
    moved_m = np.linalg.norm(displacement)
    if width_m < _RAIL_M and abs(axes[0, 2]) < 0.5:  # level: inclined by less than 30 degrees
        # Any motion may lead to another part of a rail. The back of a far car looks alike: a line
        # of few points, at most 2.6 m long (0.75 m RMS). Its motion is ambiguous only along the
        # line, where more than 0.2 of the motion (12 degrees from perpendicular) is too much.
        is_far_car = len(points) < 60 and length_m < 0.75
        return bool(not is_far_car or abs(axes[0] @ displacement) > 0.2 * moved_m)
    # A motion within 17 degrees of a wall may lead to another part of it, of a line any motion.
    is_along_wall = abs(axes[-1] @ displacement) < 0.3 * moved_m
    return bool(thickness_m < _WALL_M and (is_along_wall or width_m < _WALL_M))


def find_movers(
    source: PairCloud,
    target: PairCloud,
    height_m: Float32,
    ground: HeightMap,
    apart_s: float | None = None,
    initial: Float | None = None,
) -> tuple[list[RigidMotion], Int]:
    """Find the groups of source points that certainly move, and their motions.

    Args:
        source: N points above the ground.
        target: M points of the other cloud above the ground, in the same frame.
        height_m: (N,) height of the source points above the ground.
        ground: Height of the ground in the frame of the clouds. Groups stay on it as they move.
        apart_s: Time between the clouds, None if unknown: then 0.1 s is assumed. The search covers
            speeds up to 38 m/s over at most 0.4 s.
        initial: (N,3) flow in metres, or None. The search of a group also starts at the median flow
            of its members.

    Returns:
        The K motions, and (N,) int, the index of each source point's motion, -1 for static.
    """
    # All groups propose motions. The best consistent motions are chosen and refined.
    clouds = source, target
    with ThreadPoolExecutor(2) as pool:
        unexplained = list(pool.map(_find_unexplained, clouds, clouds[::-1]))
        points = [cloud.points for cloud in clouds]
        group, target_group = pool.map(_group_around, points, unexplained)
        members = _find_road_users(group, unexplained[0], height_m)
        search = _Search(source, target, target_group >= 0, ground, apart_s, initial)
        proposals = list(chain(*pool.map(search.proposals, range(len(members)), members)))
        chosen = _select_motions(proposals, len(target.points))
        chosen_members = [members[proposal.group] for proposal in chosen]
        refined = list(pool.map(search.refine, chosen, chosen_members))
    instance = np.full(len(source.points), -1)
    for k, proposal in enumerate(refined):
        instance[members[proposal.group]] = k
    for k, proposal in enumerate(refined):
        _claim_fitting_points(k, proposal.motion, instance, source, target)
    return [proposal.motion for proposal in refined], instance


def _select_motions(proposals: list[Proposal], num_targets: int) -> list[Proposal]:
    """Choose at most one proposal per group; one motion only explains a target point."""
    chosen: dict[int, Proposal] = {}
    explained_by = np.full(num_targets, -1)  # index in ``chosen``
    for i in np.argsort(-_gain_with_neighbours(proposals), kind="stable"):
        proposal = proposals[i]
        # A target point is evidence for a second motion only if both motions are alike: two
        # scanners see one object at two positions, and its two groups may share target points.
        differs = [not proposal.moves_like(earlier) for earlier in chosen.values()]
        # The last entry, at index -1, is for points that no motion explains.
        free = ~np.array([*differs, False])[explained_by[proposal.rows]]
        if proposal.group not in chosen and proposal.moves(free):
            explained_by[proposal.rows[proposal.target_gain > 0]] = len(chosen)
            chosen[proposal.group] = proposal
    return list(chosen.values())


def _gain_with_neighbours(proposals: list[Proposal]) -> Float:
    """Return the (P,) gains of proposals, each plus those of groups within 5 m that move alike."""
    # Two scanners see one car at two positions. A motion of half the speed could move the car from
    # the second position to the first one, but would not fit the group at the first position.
    centres = np.array([proposal.motion.centre for proposal in proposals]).reshape(-1, 3)
    total = np.zeros(len(proposals))
    for i, proposal in enumerate(proposals):
        gains = dict[int, float]()  # best gain of each group
        for j in np.flatnonzero(np.linalg.norm(centres - centres[i], axis=1) < 5.0):
            neighbour = proposals[j]
            if neighbour.moves_like(proposal):
                gains[neighbour.group] = max(neighbour.gain, gains.get(neighbour.group, 0.0))
        total[i] = sum((gains | {proposal.group: proposal.gain}).values())
    return total


def _claim_fitting_points(
    k: int, motion: RigidMotion, instance: Int, source: PairCloud, target: PairCloud
) -> None:
    """Assign static points within 1 m of group k to this group if they fit its motion better."""
    members = source.points[instance == k]
    low, high = members.min(axis=0) - _SURFACE_M, members.max(axis=0) + _SURFACE_M
    rows = source.strips.rows_inside(low, high)
    rows = rows[instance[rows] < 0]
    rows = rows[is_near(tree_of(members), source.points[rows], _SURFACE_M)]
    if len(rows):
        static = RigidMotion(np.zeros(4), motion.centre)
        static_cost, _ = cost_on_target(source, rows, target, static)
        moved_cost, _ = cost_on_target(source, rows, target, motion)
        instance[rows[moved_cost < static_cost]] = k
