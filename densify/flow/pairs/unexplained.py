# SPDX-License-Identifier: MIT
"""Find the evidence of motion in two clouds: points without a counterpart in the other cloud."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from densify.flow.pairs.hypotheses import PairCloud
from densify.free_space.ground import HeightMap
from densify.geometry.linking import close_to_seeds, link
from densify.geometry.nearest import tree_of
from densify.geometry.types import Bool, Float, Float32, Int

EXPLAINED_M = 0.1  # a nearer point is a counterpart,
MIN_UNEXPLAINED = 5, 3  # in the source, in the target
_REACH_M = 0.6  # greater distances count as this distance
_MAX_EXPLAINED_M = 0.5
_NUM_SPACING = 8  # or a point within the radius of this number of neighbours
_LINK_M = 0.6
_NEAR_M = 0.4
_MIN_SHARE = 0.1  # least unexplained share of a group that is kept whole
_MAX_EXTENT_M = 20.0
_MIN_SEED_SHARE = 0.3
_MIN_POINTS = 8
_MAX_LOW_M, _MAX_HIGH_M = 3.4, 6.0  # greatest heights of a group's lowest and highest points


class Unexplained:
    """The points of a cloud without a counterpart in the other cloud, and the groups around them.

    Attributes:
        distance_m: (N,) distance to the other cloud, at most 0.6 m.
        unexplained: (N,) bool, True without a counterpart of the same scanner within the tolerance.
        firmly: (N,) bool, True if no scanner of the other cloud has a counterpart. Two scanners may
            measure the posts of a rail with different rings.
        candidates: (C,) indices of the points that belong to a group.
        group: (N,) label of the group, -1 for none.
    """

    def __init__(self, cloud: PairCloud, distance_m: Float, alone: Bool) -> None:
        self.cloud, self.distance_m = cloud, distance_m
        self.unexplained = distance_m > EXPLAINED_M
        far = np.flatnonzero(self.unexplained & (distance_m < _MAX_EXPLAINED_M))
        self.unexplained[far] = distance_m[far] > self.tolerance_m(far)
        self.firmly = self.unexplained & alone
        self.group = self._grouped()
        self.candidates = np.flatnonzero(self.group >= 0)

    @staticmethod
    def of(cloud: PairCloud, other: PairCloud) -> Unexplained:
        """Find the points of ``cloud`` without a counterpart in ``other``, and their groups."""
        rows = np.arange(len(cloud.points))
        own_m = distances_m(cloud.places(cloud.points, rows), other.tree)
        alone = own_m > EXPLAINED_M
        if cloud.lidar is not None:
            far = np.flatnonzero(alone)
            alone[far] = distances_m(cloud.points[far], tree_of(other.points)) > EXPLAINED_M
        return Unexplained(cloud, own_m, alone)

    def tolerance_m(self, rows: Int) -> Float:
        """Return for each point the greatest distance (m) at which another point is a counterpart.

        ``rows`` are indices of points of the cloud. The distance is larger in sparse regions, which
        are sparse in both clouds.
        """
        k = min(_NUM_SPACING + 1, self.cloud.even_tree.n)
        place = self.cloud.places(self.cloud.points[rows], rows)
        spacing_m = np.asarray(self.cloud.even_tree.query(place, [k])[0])[:, 0]
        return np.clip(spacing_m, EXPLAINED_M, _MAX_EXPLAINED_M)

    def groups(self, ground: HeightMap) -> list[Int]:
        """Return the point indices of each group that may be a road user, not a crown or a wall."""
        order = self.candidates[np.argsort(self.group[self.candidates], kind="stable")]
        parts = np.split(order, np.flatnonzero(np.diff(self.group[order])) + 1)
        return [
            part
            for part in parts
            if len(part) >= _MIN_POINTS
            and self.firmly[part].sum() >= MIN_UNEXPLAINED[0]
            and _may_drive(ground.above(self.cloud.points[part]))
        ]

    def _grouped(self) -> Int:
        """Return (N,) group labels, -1 for none.

        Connected points form one group if it is no longer than a vehicle and at least 10 % of it is
        unexplained. Elsewhere only the points close to unexplained points form groups.
        """
        points = self.cloud.points
        num, label = link(points, _LINK_M)
        size = np.bincount(label, minlength=num)
        share = np.bincount(label, self.unexplained, num) / np.maximum(size, 1)
        whole = (share >= _MIN_SHARE) & (_extents_m(points, label, num) <= _MAX_EXTENT_M)
        group = np.where(whole[label], label, -1)
        rest = np.flatnonzero(~whole[label])
        seed = self.unexplained[rest]
        near = rest[close_to_seeds(points[rest], seed, _NEAR_M, _MIN_SEED_SHARE)]
        group[near] = num + link(points[near], _LINK_M)[1]
        return group


def _extents_m(points: Float, label: Int, num: int) -> Float:
    """Return (num,) horizontal diagonals of the groups' bounding boxes; ``label`` is (N,)."""
    low, high = np.full((num, 2), np.inf), np.full((num, 2), -np.inf)
    np.minimum.at(low, label, points[:, :2])
    np.maximum.at(high, label, points[:, :2])
    return np.linalg.norm(high - low, axis=1)


def _may_drive(height_m: Float32) -> bool:
    """Return True if a group with these heights above the ground may be a road user."""
    low_m, high_m = np.percentile(height_m, (5, 95))
    return bool(low_m <= _MAX_LOW_M and high_m <= _MAX_HIGH_M)


def distances_m(points: Float, tree: cKDTree, workers: int = 1) -> Float:
    """Return (N,) distances to the nearest point of the tree, at most 0.6 m."""
    far = tree.query(points, distance_upper_bound=_REACH_M, workers=workers)[0]
    return np.minimum(far, _REACH_M)
