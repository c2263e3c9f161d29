# SPDX-License-Identifier: MIT
"""Find the rigid groups of one cloud that certainly moved to another position in another cloud.

A point is unexplained if the other cloud has no counterpart at its position. Connected groups with
many unexplained points are aligned with the other cloud at several candidate positions
(`densify.flow.pairs.hypotheses`). A group moves if its motion explains points, in both clouds, that
stay unexplained if the group is static.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from densify.flow.pairs.hypotheses import (
    Hypotheses,
    PairCloud,
    RigidMotion,
    Surface,
)
from densify.flow.pairs.refine import Refined, refined
from densify.flow.pairs.trials import Trial, promising
from densify.flow.pairs.unexplained import Unexplained, distances_m
from densify.free_space.ground import HeightMap
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int

_CLOSE_BY_M = 1.0
_ATTACH_M = 0.3
_ATTACH_UNEXPLAINED_M = 1.0


def find_movers(
    source: PairCloud,
    target: PairCloud,
    ground: HeightMap,
    initial: Float | None = None,
    apart_s: float | None = None,
) -> tuple[list[RigidMotion], Int]:
    """Return the motions of the groups of points that move from the source to the target.

    Args:
        initial: (N,3) flow. A group also starts at the median flow of its members.
        apart_s: Time between the clouds, None if unknown. The search covers up to 38 m/s.

    Returns:
        The motions, and (N,) the index of each source point's motion, -1 for static points.
    """
    with ThreadPoolExecutor(2) as pool:
        ours, theirs = pool.map(Unexplained.of, (source, target), (target, source))
    groups = ours.groups(ground)
    there = theirs.candidates
    if not groups or not len(there):
        return [], np.full(len(source.points), -1)
    hypotheses = Hypotheses.of(groups, source, target, there, initial, apart_s, ground)
    hypotheses.align(Surface(target, there))

    timed = apart_s is not None

    def tried(start: tuple[int, RigidMotion]) -> Trial | None:
        k, motion = start
        trial = Trial.of(k, groups[k], Refined(motion), ours, theirs)
        if not trial.may_prove():
            return None
        found = refined(motion, groups[k], source, target, there, ground, timed)
        if found.motion is motion:
            return replace(trial, refined=found)
        return trial.after(found, Trial.of(k, groups[k], found, ours, theirs))

    starts = promising(hypotheses, ours, theirs)
    with ThreadPoolExecutor(2) as pool:
        trials = [trial for trial in pool.map(tried, starts) if trial is not None]
    motions, instance = _choose(trials, groups, ours, theirs)
    _attach(motions, instance, ours, theirs)
    return motions, instance


def _choose(
    trials: list[Trial], groups: list[Int], ours: Unexplained, theirs: Unexplained
) -> tuple[list[RigidMotion], Int]:
    """Choose at most one motion per group; each target point is explained by at most one motion.

    Args:
        trials: Tested motions of the groups.
        groups: Indices of each group's source points.

    Returns:
        The motions, and (N,) the index of each source point's motion, -1 for none.
    """
    free = np.ones(len(theirs.unexplained), bool)
    trials = _thinnest([t for t in trials if t.proves(free)])
    assigned = _assigned(trials, theirs.group)
    motions: list[RigidMotion] = []
    instance = np.full(len(ours.unexplained), -1)
    done: set[int] = set()
    for trial in sorted(trials, key=lambda t: (t not in assigned, -t.gain_m)):
        if trial.group not in done and trial.proves(free):
            done.add(trial.group)
            free[trial.explained] = False
            instance[groups[trial.group]] = len(motions)
            motions.append(trial.refined.motion)
    return motions, instance


def _thinnest(trials: list[Trial]) -> list[Trial]:
    """Drop trials whose surfaces are thicker than with another motion of the group within 1 m.

    Nearest points cannot decide, because a moved object fits them ring to ring.
    """
    kept = []
    for trial in trials:
        others_m = [
            t.refined.thickness_m
            for t in trials
            if t.group == trial.group
            and t.refined.thickness_m is not None
            and np.abs(t.refined.motion.state - trial.refined.motion.state)[:2].max() < _CLOSE_BY_M
        ]
        if trial.refined.thickness_m is None or trial.refined.thickness_m <= min(others_m):
            kept.append(trial)
    return kept


def _assigned(trials: list[Trial], target_group: Int) -> list[Trial]:
    """Return the trials of an assignment of source groups to target groups with the greatest gain.

    In a row of similar cars, each could take the place of the next car, but the last would find no
    place. A group that is only a part of an object may stay unassigned and counts its own gain.
    """
    best: dict[tuple[int, int], Trial] = {}
    for trial in trials:
        there = target_group[trial.explained]
        key = trial.group, int(np.bincount(there[there >= 0] + 1, minlength=1).argmax())
        if key not in best or trial.gain_m > best[key].gain_m:
            best[key] = trial
    rows, columns = (sorted({key[i] for key in best}) for i in (0, 1))
    gain_m = np.zeros((len(rows), len(columns) + len(rows)))
    for (group, column), trial in best.items():
        i = rows.index(group)
        gain_m[i, columns.index(column)] = trial.gain_m
        gain_m[i, len(columns) + i] = max(gain_m[i, len(columns) + i], trial.own_gain_m)
    pairs = zip(*linear_sum_assignment(gain_m, maximize=True), strict=True)
    chosen = [(rows[i], columns[j]) for i, j in pairs if j < len(columns)]
    return [best[key] for key in chosen if key in best]


def _attach(
    motions: list[RigidMotion], instance: Int, ours: Unexplained, theirs: Unexplained
) -> None:
    """Assign further source points to a moving group nearby whose motion explains them.

    Points without a counterpart in the target may be up to 1 m away, others 0.3 m. A motion
    explains a point if the moved point has a counterpart in the target.

    Args:
        motions: Motion of each moving group.
        instance: (N,) index in ``motions`` of each source point, -1 for none; changed in place.
        ours: The N source points, and which of them lack a counterpart in the target.
        theirs: The target points, and which of them lack a counterpart in the source.
    """
    points = ours.cloud.points
    members, others = np.flatnonzero(instance >= 0), np.flatnonzero(instance < 0)
    if not len(members) or not len(others):
        return
    low, high = (
        points[members].min(0) - _ATTACH_UNEXPLAINED_M,
        points[members].max(0) + _ATTACH_UNEXPLAINED_M,
    )
    others = others[((points[others] > low) & (points[others] < high)).all(1)]
    far, nearest = tree_of(points[members]).query(
        points[others], distance_upper_bound=_ATTACH_UNEXPLAINED_M, workers=-1
    )
    reach_m = np.where(ours.unexplained[others], _ATTACH_UNEXPLAINED_M, _ATTACH_M)
    close = np.flatnonzero(far < reach_m)
    others, mine = others[close], instance[members[np.asarray(nearest)[close]]]
    arrived = points[others]
    for k in np.unique(mine):
        arrived[mine == k] = motions[k].seen(points[others[mine == k]])
    moved_m = distances_m(ours.cloud.places(arrived, others), theirs.cloud.tree)
    fits = moved_m <= ours.tolerance_m(others)
    instance[others[fits]] = mine[fits]
