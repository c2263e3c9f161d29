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
from scipy.spatial import cKDTree

from densify.flow.pairs.hypotheses import (
    Hypotheses,
    PairCloud,
    RigidMotion,
    Surface,
    thinned,
    tree_of,
)
from densify.kernels.linking import link
from densify.types import Bool, Float, Int

_REACH_M = 0.6  # a distance beyond it counts as this
_EXPLAINED_M = 0.1  # a nearer point is a counterpart,
_MAX_EXPLAINED_M = 0.5
_NUM_SPACING = 8  # or one within the radius of so many neighbours
_LINK_M = 0.6
_NEAR_M = 0.4
_MIN_SHARE = 0.2  # unexplained, of a group taken as a whole
_MAX_EXTENT_M = 20.0
_MIN_SEED_SHARE = 0.3
_MIN_POINTS = 8
_MIN_UNEXPLAINED = 5, 3  # in the source, in the target
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
    initial: Float | None = None,
    apart_s: float | None = None,
) -> tuple[list[RigidMotion], Int]:
    """The motions, and (N,) which of them each source point takes, -1 none.

    initial: (N,3) flow; a group is also tried at the median of its members'. apart_s: the time
    between the clouds, None where unknown: what moves at up to 38 m/s is looked for.
    """
    with ThreadPoolExecutor(2) as pool:
        ours, theirs = pool.map(_Unexplained.of, (source, target), (target, source))
    groups = ours.groups()
    if not groups or not len(theirs.candidates):
        return [], np.full(len(source.points), -1)
    hypotheses = Hypotheses.of(groups, source, target, theirs.candidates, initial, apart_s)
    hypotheses.align(Surface(target, theirs.candidates))
    motions, instance = _choose(hypotheses, groups, ours, theirs)
    _attach(motions, instance, ours, theirs)
    return motions, instance


class _Unexplained:
    """Which points of a cloud the other one does not explain, and the groups they form.

    distance_m: (N,) to the other cloud, at most the reach. unexplained: (N,). candidates: (C,)
    rows that belong to a group. group: (N,) its label, -1 none.
    """

    def __init__(self, cloud: PairCloud, distance_m: Float) -> None:
        self.cloud, self.distance_m = cloud, distance_m
        self.unexplained = np.zeros(len(distance_m), bool)
        far = np.flatnonzero(distance_m > _EXPLAINED_M)
        self.unexplained[far] = distance_m[far] > self.tolerance_m(far)
        self.group = self._grouped()
        self.candidates = np.flatnonzero(self.group >= 0)

    @staticmethod
    def of(cloud: PairCloud, other: PairCloud) -> _Unexplained:
        rows = np.arange(len(cloud.points))
        return _Unexplained(cloud, _distance_m(cloud.places(cloud.points, rows), other.tree))

    def tolerance_m(self, rows: Int) -> Float:
        """How far from a point a counterpart may be: what is sparse in one cloud is in both."""
        k = min(_NUM_SPACING + 1, self.cloud.even_tree.n)
        place = self.cloud.places(self.cloud.points[rows], rows)
        spacing_m = np.asarray(self.cloud.even_tree.query(place, [k])[0])[:, 0]
        return np.clip(spacing_m, _EXPLAINED_M, _MAX_EXPLAINED_M)

    def groups(self) -> list[Int]:
        """Members of those that are worth a try, by label."""
        order = self.candidates[np.argsort(self.group[self.candidates], kind="stable")]
        parts = np.split(order, np.flatnonzero(np.diff(self.group[order])) + 1)
        return [
            part
            for part in parts
            if len(part) >= _MIN_POINTS and self.unexplained[part].sum() >= _MIN_UNEXPLAINED[0]
        ]

    def _grouped(self) -> Int:
        """What is connected is one group if it is no longer than a vehicle and much of it is
        unexplained; elsewhere only what is close to unexplained points that are not alone."""
        points = self.cloud.points
        num, label = link(points, _LINK_M)
        size = np.bincount(label, minlength=num)
        share = np.bincount(label, self.unexplained, num) / np.maximum(size, 1)
        whole = (share >= _MIN_SHARE) & (_extents_m(points, label, num) <= _MAX_EXTENT_M)
        group = np.where(whole[label], label, -1)
        rest = np.flatnonzero(~whole[label])
        seeds = rest[self.unexplained[rest]]
        if not len(seeds):
            return group
        tree = tree_of(points[rest])
        num_near = tree.query_ball_point(points[seeds], _NEAR_M, return_length=True)
        num_seeds = tree_of(points[seeds]).query_ball_point(
            points[seeds], _NEAR_M, return_length=True
        )
        seeds = seeds[num_seeds >= _MIN_SEED_SHARE * num_near]
        if len(seeds):
            far, _ = tree_of(points[seeds]).query(points[rest], distance_upper_bound=_NEAR_M)
            near = rest[np.isfinite(far)]
            group[near] = num + link(points[near], _LINK_M)[1]
        return group


@dataclass(frozen=True, eq=False)
class _Trial:
    """What a hypothesis explains of the group, and of the target around where the group arrives.

    still: unexplained source points without the motion, left: with it. misfit: mean distance to the
    target with it, as a share of the tolerance. still_there: unexplained
    targets without it. around: targets that are near. explained: those of them that it explains.
    own_gain_m: by how much all distances from the group to the target become shorter, gain_m: and
    those from the target around.
    """

    group: int
    motion: RigidMotion
    still: int
    left: int
    misfit: float
    still_there: int
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
            self.still >= _MIN_UNEXPLAINED[0]
            and self.still_there >= _MIN_UNEXPLAINED[1]
            and still >= _MIN_TOGETHER + _MIN_TOGETHER_PER_M * far_m
            and self.left <= _MAX_LEFT_EACH * self.still
            and left_there <= _MAX_LEFT_EACH * self.still_there
            and left <= _MAX_LEFT * still
            and left / still + self.misfit <= _MAX_MISFIT
        )


def _choose(
    hypotheses: Hypotheses, groups: list[Int], ours: _Unexplained, theirs: _Unexplained
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
    hypotheses: Hypotheses, groups: list[Int], ours: _Unexplained, theirs: _Unexplained
) -> list[_Trial]:
    """Judge the hypotheses that pass a first look, in the source alone."""
    num = len(hypotheses.state)
    row, of_point = hypotheses.row, hypotheses.of_point
    place = ours.cloud.places(hypotheses.seen(hypotheses.share[of_point]), row)
    far = _distance_m(place, theirs.cloud.tree, workers=-1)
    sampled, back = np.unique(row, return_inverse=True)
    tolerance_m = ours.tolerance_m(sampled)[back.ravel()]
    still = np.bincount(of_point, ours.unexplained[row], num)
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
        still_there, around, explained, back_m = _looked_back(motion, groups[k], ours, theirs)
        trials.append(
            _Trial(
                group=k,
                motion=motion,
                still=int(still[h]),
                left=int(left[h]),
                misfit=float(misfit[h]),
                still_there=still_there,
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
    motion: RigidMotion, members: Int, ours: _Unexplained, theirs: _Unexplained
) -> tuple[int, Int, Int, float]:
    """From the target to the group where it arrives: `_Trial`'s still_there, around, explained, and
    by how much the distances become shorter (m)."""
    sample = thinned(members, _JUDGE_POINTS)
    arrived = motion.seen(ours.cloud.points[sample])
    low, high = arrived.min(0) - _AROUND_M, arrived.max(0) + _AROUND_M
    at = theirs.cloud.points
    box = thinned(np.flatnonzero(((at > low) & (at < high)).all(1)), 2 * _JUDGE_POINTS)
    tree = tree_of(ours.cloud.places(arrived, sample))
    far = _distance_m(theirs.cloud.places(at[box], box), tree)
    around, far = box[far < _AROUND_M], far[far < _AROUND_M]
    explained = far <= _EXPLAINED_M
    unsure = np.flatnonzero(~explained)
    thinning = np.sqrt(len(members) / len(sample))
    explained[unsure] = far[unsure] <= theirs.tolerance_m(around[unsure]) * thinning
    still_there = int(theirs.unexplained[around].sum())
    return (
        still_there,
        around,
        around[explained],
        float((theirs.distance_m[around] - far).sum()),
    )


def _attach(
    motions: list[RigidMotion], instance: Int, ours: _Unexplained, theirs: _Unexplained
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
    moved_m = _distance_m(ours.cloud.places(arrived, others), theirs.cloud.tree)
    fits = moved_m <= ours.tolerance_m(others)
    instance[others[fits]] = mine[fits]


def _extents_m(points: Float, label: Int, num: int) -> Float:
    """(num,) diagonals of the groups' bounding boxes in the plane."""
    low, high = np.full((num, 2), np.inf), np.full((num, 2), -np.inf)
    np.minimum.at(low, label, points[:, :2])
    np.maximum.at(high, label, points[:, :2])
    return np.linalg.norm(high - low, axis=1)


def _distance_m(points: Float, tree: cKDTree, workers: int = 1) -> Float:
    far = tree.query(points, distance_upper_bound=_REACH_M, workers=workers)[0]
    return np.minimum(far, _REACH_M)
