# SPDX-License-Identifier: MIT
"""Find the rigid groups of one cloud that certainly moved to another position in another cloud."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from densify.flow.pairs.motions import Proposal, RigidMotion, Search, compare
from densify.flow.pairs.surface import SURFACE_M, PairCloud
from densify.flow.pairs.unexplained import find_unexplained, group_around, road_users
from densify.free_space.ground import HeightMap
from densify.geometry.nearest import is_near, tree_of
from densify.geometry.types import Float, Float32, Int

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
