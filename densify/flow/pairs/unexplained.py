# SPDX-License-Identifier: MIT
"""Find the evidence of motion in two clouds: points without a counterpart in the other cloud."""

from __future__ import annotations

import numpy as np

from densify.flow.pairs.surface import MISSING, PairCloud, Surface
from densify.flow.tracking.candidates import LINK_M, cluster_around
from densify.geometry.nearest import is_near, link, tree_of
from densify.geometry.types import Bool, Float, Float32, Int

_EXPLAINED_M = 0.1  # a closer point is a counterpart
_MAX_EXTENT_M = 20.0  # horizontal diagonal of the longest vehicle
_MIN_POINTS, _MIN_UNEXPLAINED = 8, 5  # of a group
_MAX_LOW_M, _MAX_HIGH_M = 3.4, 6.0  # greatest heights of a group's lowest and highest points


def find_unexplained(cloud: PairCloud, other_cloud: PairCloud) -> Bool:
    """Return (N,) True for points of ``cloud`` without a counterpart in ``other_cloud``.

    A counterpart is a point of the other cloud within 0.1 m, or one of its surfaces.
    """
    unmatched = np.flatnonzero(~is_near(tree_of(other_cloud.points), cloud.points, _EXPLAINED_M))
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
        if len(members) >= _MIN_POINTS and unexplained[members].sum() >= _MIN_UNEXPLAINED:
            low_m, high_m = np.percentile(height_m[members], (5, 95))
            if low_m <= _MAX_LOW_M and high_m <= _MAX_HIGH_M:
                users.append(members)
    return users
