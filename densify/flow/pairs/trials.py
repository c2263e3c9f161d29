# SPDX-License-Identifier: MIT
"""The test of a group's motion between two clouds: does it explain what differs?

Nearest points alone cannot tell. The rings of a scanner lie elsewhere on an object that has moved.
Each promising motion is refined until the object's surfaces are thin (`densify.flow.pairs.refine`).
Its doubt is a product: what it leaves unexplained in both clouds, times the surfaces' thickness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from densify.flow.pairs.hypotheses import (
    EXPLAINED_M,
    REACH_M,
    SAMPLE,
    Hypotheses,
    RigidMotion,
    thinned,
)
from densify.flow.pairs.refine import THIN_M
from densify.flow.pairs.unexplained import Unexplained, distances_m
from densify.geometry.nearest import tree_of
from densify.geometry.types import Bool, Float, Int

_MAX_DOUBT_M = 0.05
_MIN_FIRMLY = 2.0  # unexplained points; per metre as many more: the farther, the more places fit
_JUDGE_POINTS = 2000  # fewer make the counterparts of near objects too far apart
_ALONG = 0.3
_BAR_M = 0.12  # width (rms) of a rail


@dataclass(frozen=True, eq=False)
class Trial:
    """The evidence for a motion of a group, in the group and around its place in the target.

    group: its number. unexplained: source points of a sample, and targets around, without a
    counterpart if the group is static. left: those of the sample with the motion. misfit: mean
    distance to the target with it, as a share of the tolerance. firmly: points that no scanner
    explains, in the cloud that has fewer. around: targets that are near. explained: those of them
    that it explains. gain_m: by how much all distances, from the group and from the targets around,
    become shorter. thickness_m: of the object's surfaces.
    """

    group: int
    motion: RigidMotion
    unexplained: int
    firmly: int
    left: int
    misfit: float
    around: Int
    explained: Int
    gain_m: float
    thickness_m: float

    @staticmethod
    def of(
        group: int, members: Int, motion: RigidMotion, ours: Unexplained, theirs: Unexplained
    ) -> Trial:
        """Judge the motion of the source's ``members`` by nearest points alone."""
        sample = thinned(members, SAMPLE)
        place = ours.cloud.places(motion.seen(ours.cloud.points[sample]), sample)
        far, tolerance_m = distances_m(place, theirs.cloud.tree), ours.tolerance_m(sample)
        around, explained, back_m = _looked_back(motion, members, ours, theirs)
        own_gain_m = float((ours.distance_m[sample] - far).mean() * len(members))
        return Trial(
            group=group,
            motion=motion,
            unexplained=int(ours.unexplained[sample].sum() + theirs.unexplained[around].sum()),
            firmly=int(min(ours.firmly[members].sum(), theirs.firmly[around].sum())),
            left=int((far > tolerance_m).sum()),
            misfit=float((far / tolerance_m).mean()),
            around=around,
            explained=explained,
            gain_m=own_gain_m + back_m,
            thickness_m=np.inf,
        )

    def may_prove(self) -> bool:
        """Return True if it moves, and so many points differ that it hardly fits by chance."""
        length_m = float(np.linalg.norm(self.motion.state[:2]))
        return length_m >= EXPLAINED_M and self.firmly >= _MIN_FIRMLY * (1 + length_m)

    def worth(self, free: Bool) -> float:
        """Return by how many metres the motion brings the clouds closer, less its doubt; 0 where it
        is not confirmed. free: (M,) targets that no other motion explains."""
        left = self.left + len(self.around) - int(free[self.explained].sum())
        doubt_m = self._off(left) * self.thickness_m
        return self.gain_m * max(0.0, 1 - doubt_m / _MAX_DOUBT_M)

    def after(self, settled: Trial, thickness_m: float) -> Trial:
        """Return the trial of the refined motion. It is judged by nearest points before or after
        the refinement, whichever fits better: rings drawn onto each other fit, but hold back."""
        here, there = (t._off(t.left + len(t.around) - len(t.explained)) for t in (self, settled))
        better = self if here < there else settled
        return replace(better, motion=settled.motion, thickness_m=thickness_m)

    def _off(self, left: int) -> float:
        # A sample of many points may hold none that are unexplained.
        return left / max(self.unexplained, 1) + self.misfit


def promising(
    hypotheses: Hypotheses, ours: Unexplained, theirs: Unexplained
) -> list[tuple[int, RigidMotion]]:
    """Return the groups and motions that explain anything in the source; of several that are the
    same the one that fits best."""
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
    passed = (length_m >= EXPLAINED_M) & (left < still)
    found: dict[int, list[Float]] = {}
    chosen = []
    for h in np.flatnonzero(passed)[np.argsort(misfit[passed], kind="stable")]:
        k, place_m = int(hypotheses.group[h]), state[h, :2]
        if any(np.abs(other - place_m).max() < EXPLAINED_M for other in found.get(k, [])):
            continue
        if _ambiguous(ours.cloud.points[row[of_point == h]], state[h, :3]):
            continue
        found.setdefault(k, []).append(place_m)
        share = float(hypotheses.share[h])
        chosen.append((k, RigidMotion(state[h], hypotheses.centre[h], share)))
    return chosen


def _ambiguous(points: Float, way: Float) -> bool:
    """Return True if the group cannot be told from another part of the same surface.

    A flat group that moves along itself may be the strip of a wall seen through a gap, and a bar
    any piece of a rail.
    """
    _, scale, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    _, width_m, thickness_m = scale / np.sqrt(len(points))
    along_m = _ALONG * np.linalg.norm(way)
    if width_m < _BAR_M and abs(axes[0] @ way) > along_m:
        return True
    return bool(thickness_m < THIN_M and abs(axes[-1] @ way) < along_m)


def _looked_back(
    motion: RigidMotion, members: Int, ours: Unexplained, theirs: Unexplained
) -> tuple[Int, Int, float]:
    """Return what the target tells of the group where it arrives: `Trial`'s around, explained, and
    by how much the distances become shorter (m)."""
    sample = thinned(members, _JUDGE_POINTS)
    arrived = motion.seen(ours.cloud.points[sample])
    low, high = arrived.min(0) - REACH_M, arrived.max(0) + REACH_M
    at = theirs.cloud.points
    box = thinned(np.flatnonzero(((at > low) & (at < high)).all(1)), 2 * _JUDGE_POINTS)
    tree = tree_of(ours.cloud.places(arrived, sample))
    far = distances_m(theirs.cloud.places(at[box], box), tree)
    around, far = box[far < REACH_M], far[far < REACH_M]
    explained = far <= EXPLAINED_M
    unsure = np.flatnonzero(~explained)
    thinning = np.sqrt(len(members) / len(sample))
    explained[unsure] = far[unsure] <= theirs.tolerance_m(around[unsure]) * thinning
    return around, around[explained], float((theirs.distance_m[around] - far).sum())
