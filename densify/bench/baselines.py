# SPDX-License-Identifier: MIT
"""Two published ways to scene flow, to compare with: rigid ICP per cluster and non-rigid ICP.

Our own short implementations, since none of this package's dependencies has them for point clouds:
made to be fair, not to be fast or complete.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import block_diag, coo_array, csc_array, identity, kron
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.geometry.linking import link
from densify.geometry.types import Float, Int

_LINK_M = 0.6
_FASTEST_M_S = 36.0
_BIN_M = 0.2
_NUM_VOTERS = 30
_ICP_REACH_M = 1.0
_ICP_STEPS = 20

STIFFNESSES = (50.0, 20.0, 8.0, 3.0)
"""Amberg et al. lower the stiffness in steps; ending softer follows the noise of what stands."""

_NUM_EDGES = 6
_NICP_REACH_M = 2.0
_NICP_STEPS = 4  # per stiffness
_NICP_SETTLED_M = 0.005
_RIDGE = 1e-6  # keeps lonely points, which have no edge, determined


def cluster_icp(source: ArrayLike, target: ArrayLike, duration_s: float) -> Float:
    """(n,3), (m,3) metres, one frame -> (n,3) flow: each cluster of the source moves rigidly.

    Clusters are linked by distance. Each is started from standing still and from the translation,
    in the plane and at most 36 m/s, that most pairs of points agree on, and aligned point to point
    (Besl and McKay, "A Method for Registration of 3-D Shapes", PAMI 1992); the start that ends
    closer wins. Cluster, histogram and ICP are the steps of Lin and Caesar, "ICP-Flow", CVPR 2024,
    without its filters and its network. duration_s: between the two, above 0.

    Raises InputError for no points or another shape.
    """
    points, goal = _cloud(source, "source"), _cloud(target, "target")
    num_clusters, cluster = link(points, _LINK_M)
    tree = cKDTree(goal)
    still = np.zeros((num_clusters, 3))
    at_rest, cost_m = _icp(points, goal, tree, cluster, still)
    farthest_m = _FASTEST_M_S * duration_s
    starts = _voted_translations(points, goal, tree, cluster, still, farthest_m)
    voted, voted_cost_m = _icp(points, goal, tree, cluster, starts)
    better = voted_cost_m < cost_m
    return np.where(better[cluster][:, None], voted, at_rest) - points


def rigid_icp(source: ArrayLike, target: ArrayLike) -> Float:
    """(n,3), (m,3) metres, one frame -> (n,3) flow: one rigid motion of everything, from rest (Besl
    and McKay, "A Method for Registration of 3-D Shapes", PAMI 1992)."""
    points, goal = _cloud(source, "source"), _cloud(target, "target")
    together = np.zeros(len(points), np.int64)
    moved, _ = _icp(points, goal, cKDTree(goal), together, np.zeros((1, 3)))
    return moved - points


def _voted_translations(
    points: Float, goal: Float, tree: cKDTree, cluster: Int, still: Float, farthest_m: float
) -> Float:
    """(C,3): the fullest bin of all differences to goal points in reach, per cluster."""
    order = np.argsort(cluster, kind="stable")
    bounds = np.searchsorted(cluster[order], np.arange(len(still) + 1))
    num_bins = max(1, round(2 * farthest_m / _BIN_M))
    edges, bin_m = np.linspace(-farthest_m, farthest_m, num_bins + 1, retstep=True)
    translations = still.copy()
    for k, (first, end) in enumerate(pairwise(bounds)):
        rows = order[first:end]
        voters = points[rows[:: -(-len(rows) // _NUM_VOTERS)]]
        found = np.asarray(tree.query_ball_point(voters, farthest_m), dtype=object)
        num_found = [len(f) for f in found]
        if sum(num_found) == 0:
            continue
        offsets = goal[np.concatenate(found).astype(int)] - np.repeat(voters, num_found, axis=0)
        level = offsets[np.abs(offsets[:, 2]) < _BIN_M]
        votes, _, _ = np.histogram2d(level[:, 0], level[:, 1], bins=(edges, edges))
        x, y = np.unravel_index(np.argmax(votes), votes.shape)
        translations[k, :2] = edges[x] + bin_m / 2, edges[y] + bin_m / 2
    return translations


def _icp(
    points: Float, goal: Float, tree: cKDTree, cluster: Int, translations: Float
) -> tuple[Float, Float]:
    """All clusters at once: (n,3) aligned points and (C,) mean distance to the goal, cut at the
    reach."""
    moved = points + translations[cluster]
    for _ in range(_ICP_STEPS):
        distance_m, near = _nearest(tree, moved, _ICP_REACH_M)
        hit = np.isfinite(distance_m)
        new = _moved_rigidly(points, goal[near[hit]], hit, cluster, moved)
        step_m = np.abs(new - moved).max()
        moved = new
        if step_m < 1e-3:
            break
    distance_m, _ = _nearest(tree, moved, _ICP_REACH_M)
    cost = np.bincount(cluster, np.minimum(distance_m, _ICP_REACH_M), len(translations))
    return moved, cost / np.bincount(cluster, minlength=len(translations))


def _moved_rigidly(points: Float, matched: Float, hit: Int, cluster: Int, moved: Float) -> Float:
    """Each cluster by the least-squares rigid motion of its points to their matches (Kabsch 1976);
    one with fewer than 3 matches stays where it was."""
    label, own = cluster[hit], points[hit]
    size = int(cluster.max()) + 1
    num = np.bincount(label, minlength=size)

    def mean(values: Float) -> Float:
        sums = np.stack([np.bincount(label, column, size) for column in values.T], axis=1)
        return sums / np.maximum(num, 1)[:, None]

    a, b = mean(own), mean(matched)
    products = (own - a[label])[:, :, None] * (matched - b[label])[:, None, :]
    U, _, Vt = np.linalg.svd(mean(products.reshape(-1, 9)).reshape(-1, 3, 3))
    Vt[:, 2] *= np.linalg.det(U @ Vt)[:, None]  # no reflections
    R = np.swapaxes(U @ Vt, 1, 2)
    turned = np.einsum("nij,nj->ni", R[cluster], points - a[cluster]) + b[cluster]
    return np.where((num >= 3)[cluster][:, None], turned, moved)


def nonrigid_icp(
    source: ArrayLike,
    target: ArrayLike,
    stiffnesses: tuple[float, ...] = STIFFNESSES,
    gamma_m: float = 1.0,
) -> Float:
    """(n,3), (m,3) metres, one frame -> (n,3) flow: each point moves by an affine map of its own,
    like its neighbours' (Amberg, Romdhani, Vetter, "Optimal Step Nonrigid ICP Algorithms for
    Surface Registration", CVPR 2007).

    stiffnesses: alpha of their equation 3 from stiff to soft; the softer the last, the freer each
    point. gamma_m: weighs differences of translation against those of rotation, shear and scale
    over a metre.

    Their mesh edges are the 6 nearest neighbours; coordinates are taken about the mean
    of each connected part, where "as alike as neighbours" means most. Correspondences farther than
    2 m have weight 0, as theirs at borders have.

    Raises InputError for no points, another shape, or stiffnesses that are not positive.
    """
    points, goal = _cloud(source, "source"), _cloud(target, "target")
    if not stiffnesses or min(stiffnesses) <= 0:
        raise InputError(f"stiffnesses: got {stiffnesses}, expected positive numbers")
    num_points = len(points)
    incidence, part = _edges(points)
    sums = np.stack([np.bincount(part, column) for column in points.T], axis=1)
    origin = (sums / np.bincount(part)[:, None])[part]
    local = np.hstack([points - origin, np.ones((num_points, 1))])  # rows of D, (n,4)
    outer = local[:, :, None] * local[:, None, :]
    stiffness = kron(incidence.T @ incidence, np.diag([1.0, 1.0, 1.0, gamma_m**2]), format="csc")
    ridge = _RIDGE * identity(4 * num_points, format="csc")
    X = np.tile(np.eye(4)[:, :3], (num_points, 1, 1))  # (n,4,3), each the identity
    tree = cKDTree(goal)
    moved = points
    for alpha in stiffnesses:
        for _ in range(_NICP_STEPS):
            distance_m, near = _nearest(tree, moved, _NICP_REACH_M)
            hit = np.isfinite(distance_m)
            goals = np.where(hit[:, None], goal[np.where(hit, near, 0)] - origin, 0.0)
            data = block_diag(outer * hit[:, None, None], format="csc")
            # Normal equations of their equation 12: (α² MᵀM ⊗ G² + DᵀW²D) X = DᵀW²U.
            left = csc_array(alpha**2 * stiffness + data + ridge)
            right = local[:, :, None] * goals[:, None, :] + _RIDGE * X
            solver = splu(left, "MMD_AT_PLUS_A", options={"SymmetricMode": True})
            X = solver.solve(right.reshape(-1, 3)).reshape(-1, 4, 3)
            new = np.einsum("ni,nij->nj", local, X) + origin
            step_m = np.abs(new - moved).max()
            moved = new
            if step_m < _NICP_SETTLED_M:
                break
    return moved - points


def _edges(points: Float) -> tuple[csc_array, Int]:
    """The (E,n) node-arc incidence matrix M, and (n,) the connected part of each point."""
    num_points = len(points)
    k = min(_NUM_EDGES + 1, num_points)
    _, found = cKDTree(points).query(points, list(range(1, k + 1)), workers=-1)
    near = np.asarray(found).ravel()
    own = np.repeat(np.arange(num_points), k)
    kept = own != near
    pairs = np.unique(np.sort(np.stack([own[kept], near[kept]], axis=1), axis=1), axis=0)
    arc = np.arange(len(pairs))
    values = np.concatenate([-np.ones(len(pairs)), np.ones(len(pairs))])
    index = (np.concatenate([arc, arc]), pairs.T.ravel())
    incidence = coo_array((values, index), shape=(len(pairs), num_points))
    joined = coo_array((np.ones(len(pairs)), pairs.T), shape=(num_points, num_points))
    _, part = connected_components(joined, directed=False)
    return csc_array(incidence), part.astype(np.int64)


def _nearest(tree: cKDTree, points: Float, reach_m: float) -> tuple[Float, Int]:
    """(n,) distance, infinite beyond the reach, and row of the nearest."""
    distance_m, row = tree.query(points, distance_upper_bound=reach_m, workers=-1)
    return np.asarray(distance_m), np.asarray(row)


def _cloud(values: ArrayLike, name: str) -> Float:
    cloud = np.asarray(values, dtype=np.float64)
    if cloud.ndim != 2 or cloud.shape[1:] != (3,) or not len(cloud):
        raise InputError(f"{name}: got shape {cloud.shape}, expected (n,3) metres, n > 0")
    return cloud
