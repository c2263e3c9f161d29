# SPDX-License-Identifier: MIT
"""Test whether the motion of a group explains the differences between two clouds.

Nearest points alone cannot decide, because the rings of a scanner hit other parts of an object
after it has moved. Each promising motion is refined until the object's surfaces are thin
(`densify.flow.pairs.refine`). It is judged by the points that it explains, and by the thickness of
the surfaces relative to their thickness without motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from densify.flow.pairs.hypotheses import Hypotheses, RigidMotion, thinned
from densify.flow.pairs.refine import Refined
from densify.flow.pairs.unexplained import EXPLAINED_M, MIN_UNEXPLAINED, Unexplained, distances_m
from densify.geometry.nearest import tree_of
from densify.geometry.types import Bool, Float, Int

_MIN_TOGETHER, _MIN_TOGETHER_PER_M = 10, 3.5  # farther away, more positions fit by chance
_MIN_MOTION_M = 0.1
_MAX_RISE_M, _MAX_RISE = 0.12, 0.15  # greatest rise, and per metre of motion
_SAME_M, _SAME_RAD = 0.25, 0.06
_LOOK_POINTS, _JUDGE_POINTS = 150, 2000
_THIN_M, _ALONG = 0.05, 0.3
_BAR_M, _LEVEL, _ACROSS = 0.12, 0.5, 0.2  # a rail's width (rms), rise, motion across
_MAX_BAR_M, _MAX_BAR_POINTS = 0.75, 60  # length (rms) and points of a far car's back
_AROUND_M = 0.5
_MAX_LEFT = 0.4  # share of the points unexplained at rest that may stay so, both clouds
_MAX_LEFT_EACH, _MAX_LEFT_START = 0.6, 0.75  # in each cloud; before a motion is refined
_MAX_MISFIT = 0.82  # sum of the unexplained share and the mean distance in tolerances
_MAX_MISFIT_THIN = 1.2  # for thin surfaces, which are
_THIN_SURFACES_M, _THIN_OF_STANDING = 0.075, 0.65  # as thin as this, in m and relative to rest
_MAX_OF_STANDING = 0.82  # relative thickness, if much stays unexplained


@dataclass(frozen=True, eq=False)
class Trial:
    """The evidence for a motion of a group, in the source and around its position in the target.

    A point is unexplained if the other cloud has no counterpart (see `Unexplained`).

    Attributes:
        group: Index of the group.
        refined: Motion with the thickness of its surfaces.
        still: Number of source points, in a sample, unexplained if the group is static.
        firmly: Number of source points, of the whole group, that no scanner explains if static.
        left: Number of source points, in the same sample, unexplained if the group moves.
        misfit: Mean distance to the target with the motion, as a share of the tolerance.
        still_there: Number of target points unexplained if the group is static.
        firmly_there: Number of target points that no scanner explains if the group is static.
        around: Indices of the target points close to the moved group.
        explained: Indices of those target points in ``around`` that the motion explains.
        own_gain_m: Decrease of the sum of distances from the group's points to the target.
        gain_m: ``own_gain_m`` plus the decrease for the target points around.
    """

    group: int
    refined: Refined
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

    @staticmethod
    def of(
        group: int, members: Int, refined: Refined, ours: Unexplained, theirs: Unexplained
    ) -> Trial:
        """Gather the evidence for a motion of one group, by nearest points.

        Args:
            group: Index of the group.
            members: Indices of its points in the source.
            ours: Evidence in the source cloud without motion.
            theirs: Evidence in the target cloud without motion.
        """
        sample = thinned(members, _LOOK_POINTS)
        place = ours.cloud.places(refined.motion.seen(ours.cloud.points[sample]), sample)
        far, tolerance_m = distances_m(place, theirs.cloud.tree), ours.tolerance_m(sample)
        around, explained, back_m = _looked_back(refined.motion, members, ours, theirs)
        own_gain_m = float((ours.distance_m[sample] - far).mean() * len(members))
        return Trial(
            group=group,
            refined=refined,
            still=int(ours.unexplained[sample].sum()),
            firmly=int(ours.firmly[members].sum()),
            left=int((far > tolerance_m).sum()),
            misfit=float((far / tolerance_m).mean()),
            still_there=int(theirs.unexplained[around].sum()),
            firmly_there=int(theirs.firmly[around].sum()),
            around=around,
            explained=explained,
            own_gain_m=own_gain_m,
            gain_m=own_gain_m + back_m,
        )

    def after(self, found: Refined, settled: Trial) -> Trial:
        """Return the trial of a refined motion ``found``, given this trial of the first motion.

        Its evidence is taken before refinement (``self``) or after it (``settled``), whichever fits
        better. Rings aligned with each other fit well, but hold the motion back.
        """
        here, there = (t._off(len(t.around) - len(t.explained)) for t in (self, settled))
        return replace(self, refined=found) if here < there else settled

    def left_there(self, free: Bool) -> int:
        """Return the number of target points around that stay unexplained.

        Args:
            free: (M,) True for target points that no other motion explains.
        """
        return len(self.around) - int(free[self.explained].sum())

    def may_prove(self) -> bool:
        """Return True if the motion explains enough, provided that its surfaces are thin."""
        far_m = float(np.linalg.norm(self.refined.motion.state[:2]))
        return (
            self.firmly >= MIN_UNEXPLAINED[0]
            and self.firmly_there >= MIN_UNEXPLAINED[1]
            and self.firmly + self.firmly_there >= _MIN_TOGETHER + _MIN_TOGETHER_PER_M * far_m
            and self.left <= _MAX_LEFT_START * self.still
            and self._off(len(self.around) - len(self.explained)) <= _MAX_MISFIT_THIN
        )

    def proves(self, free: Bool) -> bool:
        """Return True if the motion is confirmed.

        Thin surfaces lower the share of points that must be explained. If the surfaces are as thin
        without motion, nearly all points must be explained.

        Args:
            free: (M,) True for target points that no other motion explains.
        """
        left_there = self.left_there(free)
        off = self._off(left_there)
        if (
            not self.may_prove()
            or self.left > _MAX_LEFT_EACH * self.still
            or off > _MAX_MISFIT_THIN
        ):
            return False
        thickness_m, of_standing = self.refined.thickness_m, self.refined.of_standing
        if thickness_m is not None and of_standing is not None:
            if of_standing > _MAX_OF_STANDING and 2 * off > _MAX_MISFIT:
                return False
            if of_standing <= _THIN_OF_STANDING and thickness_m <= _THIN_SURFACES_M:
                return True
        return (
            left_there <= _MAX_LEFT_EACH * self.still_there
            and self.left + left_there <= _MAX_LEFT * (self.still + self.still_there)
            and off <= _MAX_MISFIT
        )

    def _off(self, left_there: int) -> float:
        # A sample of many points may have no unexplained ones.
        return (self.left + left_there) / max(self.still + self.still_there, 1) + self.misfit


def promising(
    hypotheses: Hypotheses, ours: Unexplained, theirs: Unexplained
) -> list[tuple[int, RigidMotion]]:
    """Return (group index, motion) for the hypotheses that pass a first test in the source cloud.

    Among nearly equal motions of a group, the motion with the smallest misfit is taken.
    """
    num = len(hypotheses.state)
    row, of_point, state = hypotheses.row, hypotheses.of_point, hypotheses.state
    place = ours.cloud.places(hypotheses.seen(hypotheses.share[of_point]), row)
    far = distances_m(place, theirs.cloud.tree, workers=-1)
    sampled, back = np.unique(row, return_inverse=True)
    tolerance_m = ours.tolerance_m(sampled)[back.ravel()]
    still = np.bincount(of_point, ours.unexplained[row], num)
    left = np.bincount(of_point, far > tolerance_m, num)
    misfit = np.bincount(of_point, far / tolerance_m, num)
    length_m = np.linalg.norm(state[:, :2], axis=1)
    level = np.abs(state[:, 2]) <= _MAX_RISE_M + _MAX_RISE * length_m
    passed = level & (length_m >= _MIN_MOTION_M) & (left <= _MAX_LEFT_START * still)
    found: dict[int, list[Float]] = {}
    chosen = []
    for h in np.flatnonzero(passed)[np.argsort(misfit[passed], kind="stable")]:
        k = int(hypotheses.group[h])
        off = [np.abs(other - state[h]) for other in found.get(k, [])]
        if any(o[:2].max() < _SAME_M and o[3] < _SAME_RAD for o in off):
            continue
        if _ambiguous(ours.cloud.points[row[of_point == h]], state[h, :3]):
            continue
        found.setdefault(k, []).append(state[h])
        share = float(hypotheses.share[h])
        chosen.append((k, RigidMotion(state[h], hypotheses.centre[h], share)))
    return chosen


def _ambiguous(points: Float, way: Float) -> bool:
    """Return True if the group, moved by ``way`` (3,), could be another part of the same surface.

    A flat group that moves along itself may be a part of a wall, observed through a hole. A level
    bar may be any part of a rail, unless it moves across itself and has the size of a far car's
    back.
    """
    _, scale, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    length_m, width_m, thickness_m = scale / np.sqrt(len(points))
    far_m = np.linalg.norm(way)
    if width_m < _BAR_M and abs(axes[0, 2]) < _LEVEL:
        far_car = len(points) < _MAX_BAR_POINTS and length_m < _MAX_BAR_M
        return bool(not far_car or abs(axes[0] @ way) > _ACROSS * far_m)
    along = abs(axes[-1] @ way) < _ALONG * far_m
    return bool(thickness_m < _THIN_M and (along or width_m < _THIN_M))


def _looked_back(
    motion: RigidMotion, members: Int, ours: Unexplained, theirs: Unexplained
) -> tuple[Int, Int, float]:
    """Return the evidence in the target at the position of the moved group.

    Returns:
        ``around`` and ``explained`` of `Trial`, and the decrease (m) of the sum of distances from
            points around.
    """
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
