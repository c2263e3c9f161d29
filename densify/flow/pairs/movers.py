# SPDX-License-Identifier: MIT
"""Rigid groups of one cloud that certainly moved to where another cloud has them.

A point is unexplained if the other cloud has no counterpart for it where it stands. Connected
groups with many such points are aligned with the other cloud where they may have gone
(`densify.flow.pairs.hypotheses`), and move if that explains, in both clouds, what standing still
leaves unexplained.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from densify.flow.pairs.evidence import EXPLAINED_M, MIN_UNEXPLAINED, Unexplained, distances_m
from densify.flow.pairs.hypotheses import (
    Hypotheses,
    PairCloud,
    RigidMotion,
    Surface,
    thinned,
    tree_of,
)
from densify.flow.pairs.refine import refined
from densify.geometry.height_map import HeightMap
from densify.types import Bool, Float, Int

_MIN_TOGETHER, _MIN_TOGETHER_PER_M = 10, 3.5  # the farther, the more places fit by chance
_MIN_MOTION_M = 0.1
_MAX_RISE_M, _MAX_RISE = 0.12, 0.15  # and per metre
_JUDGE_POINTS = 2000
_THIN_M, _ALONG = 0.05, 0.3
_AROUND_M = 0.5
_MAX_LEFT = 0.4  # of what standing still leaves unexplained, in both clouds together
_MAX_LEFT_EACH = 0.6
_MAX_MISFIT = 0.82  # share left and mean distance in tolerances, together
_ATTACH_M = 0.3
_ATTACH_UNEXPLAINED_M = 1.0


def find_movers(
    source: PairCloud,
    target: PairCloud,
    ground: HeightMap,
    initial: Float | None = None,
    apart_s: float | None = None,
) -> tuple[list[RigidMotion], Int]:
    """The motions, and (N,) which of them each source point takes, -1 none.

    ground: under both clouds. initial: (N,3) flow; a group is also tried at the median of its
    members'. apart_s: the time between the clouds, None where unknown: what moves at up to 38 m/s
    is looked for.
    """
    with ThreadPoolExecutor(2) as pool:
        ours, theirs = pool.map(Unexplained.of, (source, target), (target, source))
    groups = ours.groups(ground)
    there = theirs.candidates
    if not groups or not len(there):
        return [], np.full(len(source.points), -1)
    hypotheses = Hypotheses.of(groups, source, target, there, initial, apart_s, ground)
    hypotheses.align(Surface(target, there))
    motions, instance = _choose(hypotheses, groups, ours, theirs)

    def refine(k: int) -> RigidMotion:
        members, timed = np.flatnonzero(instance == k), apart_s is not None
        return refined(motions[k], members, source, target, there, ground, timed)

    with ThreadPoolExecutor(2) as pool:
        motions = list(pool.map(refine, range(len(motions))))
    _attach(motions, instance, ours, theirs)
    return motions, instance


@dataclass(frozen=True, eq=False)
class _Trial:
    """What a hypothesis explains of the group, and of the target around where the group arrives.

    still: unexplained source points without the motion, left: with it. misfit: mean distance to the
    target with it, as a share of the tolerance. still_there: unexplained targets without it.
    firmly, firmly_there: those that no scanner explains. around: targets that are near. explained:
    those of them that it explains.
    own_gain_m: by how much all distances from the group to the target become shorter, gain_m: and
    those from the target around.
    """

    group: int
    motion: RigidMotion
    still: int
    firmly: int
    left: int
    misfit: float
    still_there: int
    firmly_there: int
    around: Int
    explained: Int
    own_gain_m: float
    gain_m: float

    def left_there(self, free: Bool) -> int:
        """free: (M,) targets that no other motion explains."""
        return len(self.around) - int(free[self.explained].sum())

    def proves(self, free: Bool) -> bool:
        left_there = self.left_there(free)
        still, left = self.still + self.still_there, self.left + left_there
        far_m = float(np.linalg.norm(self.motion.state[:2]))
        return (
            self.firmly >= MIN_UNEXPLAINED[0]
            and self.firmly_there >= MIN_UNEXPLAINED[1]
            and self.firmly + self.firmly_there >= _MIN_TOGETHER + _MIN_TOGETHER_PER_M * far_m
            and self.left <= _MAX_LEFT_EACH * self.still
            and left_there <= _MAX_LEFT_EACH * self.still_there
            and left <= _MAX_LEFT * still
            and left / still + self.misfit <= _MAX_MISFIT
        )


def _choose(
    hypotheses: Hypotheses, groups: list[Int], ours: Unexplained, theirs: Unexplained
) -> tuple[list[RigidMotion], Int]:
    """At most one motion per group; a target is explained once."""
    free = np.ones(len(theirs.unexplained), bool)
    trials = [t for t in _trials(hypotheses, groups, ours, theirs) if t.proves(free)]
    assigned = _assigned(trials, theirs.group)
    motions: list[RigidMotion] = []
    instance = np.full(len(ours.unexplained), -1)
    done: set[int] = set()
    for trial in sorted(trials, key=lambda t: (t not in assigned, -t.gain_m)):
        if trial.group not in done and trial.proves(free):
            done.add(trial.group)
            free[trial.explained] = False
            instance[groups[trial.group]] = len(motions)
            motions.append(trial.motion)
    return motions, instance


def _assigned(trials: list[_Trial], target_group: Int) -> list[_Trial]:
    """Each group to another group of the target, all together as well as possible: among similar
    cars in a row every one could take the next one's place, but the last finds none.

    A group that is only a part of an object may go unassigned for what it gains alone.
    """
    best: dict[tuple[int, int], _Trial] = {}
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


def _trials(
    hypotheses: Hypotheses, groups: list[Int], ours: Unexplained, theirs: Unexplained
) -> list[_Trial]:
    """Judge the hypotheses that pass a first look, in the source alone."""
    num = len(hypotheses.state)
    row, of_point = hypotheses.row, hypotheses.of_point
    place = ours.cloud.places(hypotheses.seen(hypotheses.share[of_point]), row)
    far = distances_m(place, theirs.cloud.tree, workers=-1)
    sampled, back = np.unique(row, return_inverse=True)
    tolerance_m = ours.tolerance_m(sampled)[back.ravel()]
    still, firmly = (np.bincount(of_point, of[row], num) for of in (ours.unexplained, ours.firmly))
    left = np.bincount(of_point, far > tolerance_m, num)
    length_m = np.linalg.norm(hypotheses.state[:, :2], axis=1)
    level = np.abs(hypotheses.state[:, 2]) <= _MAX_RISE_M + _MAX_RISE * length_m
    passed = level & (length_m >= _MIN_MOTION_M) & (left <= _MAX_LEFT_EACH * still)
    size = np.array([len(g) for g in groups])[hypotheses.group]
    count = np.bincount(of_point, minlength=num)
    gain_m = np.bincount(of_point, ours.distance_m[row] - far, num) * size / count
    misfit = np.bincount(of_point, far / tolerance_m, num) / count
    trials = []
    for h in np.flatnonzero(passed):
        k = int(hypotheses.group[h])
        motion = RigidMotion(hypotheses.state[h], hypotheses.centre[h], float(hypotheses.share[h]))
        if _ambiguous(ours.cloud.points[row[of_point == h]], motion.state[:3]):
            continue
        around, explained, back_m = _looked_back(motion, groups[k], ours, theirs)
        trials.append(
            _Trial(
                group=k,
                motion=motion,
                still=int(still[h]),
                firmly=int(firmly[h]),
                left=int(left[h]),
                misfit=float(misfit[h]),
                still_there=int(theirs.unexplained[around].sum()),
                firmly_there=int(theirs.firmly[around].sum()),
                around=around,
                explained=explained,
                own_gain_m=float(gain_m[h]),
                gain_m=float(gain_m[h]) + back_m,
            )
        )
    return trials


def _ambiguous(points: Float, way: Float) -> bool:
    """Whether a flat group moves along itself, or it is but a line: so does the strip of a wall
    that shows through a gap when the scanner moves, and its edge is any other's like."""
    _, scale, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    _, width_m, thickness_m = scale / np.sqrt(len(points))
    along = abs(axes[-1] @ way) < _ALONG * np.linalg.norm(way)
    return bool(thickness_m < _THIN_M and (along or width_m < _THIN_M))


def _looked_back(
    motion: RigidMotion, members: Int, ours: Unexplained, theirs: Unexplained
) -> tuple[Int, Int, float]:
    """From the target to the group where it arrives: `_Trial`'s around, explained, and by how much
    the distances become shorter (m)."""
    sample = thinned(members, _JUDGE_POINTS)
    arrived = motion.seen(ours.cloud.points[sample])
    low, high = arrived.min(0) - _AROUND_M, arrived.max(0) + _AROUND_M
    at = theirs.cloud.points
    box = thinned(np.flatnonzero(((at > low) & (at < high)).all(1)), 2 * _JUDGE_POINTS)
    tree = tree_of(ours.cloud.places(arrived, sample))
    far = distances_m(theirs.cloud.places(at[box], box), tree)
    around, far = box[far < _AROUND_M], far[far < _AROUND_M]
    explained = far <= EXPLAINED_M
    unsure = np.flatnonzero(~explained)
    thinning = np.sqrt(len(members) / len(sample))
    explained[unsure] = far[unsure] <= theirs.tolerance_m(around[unsure]) * thinning
    return around, around[explained], float((theirs.distance_m[around] - far).sum())


def _attach(
    motions: list[RigidMotion], instance: Int, ours: Unexplained, theirs: Unexplained
) -> None:
    """Give points close to a mover its motion if that explains them: those that standing still
    leaves unexplained from farther away."""
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
