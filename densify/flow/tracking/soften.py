# SPDX-License-Identifier: MIT
"""Estimate non-rigid motion: how a tracked object bends relative to its rigid motion.

The smoothness term is the graph Laplacian of Pontes, Hays, Lucey (3DV 2020, section 3). Their data
term, nearest points, pulls points onto the scan lines of the other sweep. Here a point moves by the
mean of the target around it, a soft correspondence (Granger, Pennec, "Multi-scale EM-ICP", ECCV
2002), minus the mean of its own sweep around it. The second mean removes the effect of the blur
itself at edges and in holes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from densify.flow.tracking.following import FIT_M
from densify.flow.tracking.objects import LONG_M, MIN_SPAN_S, MIN_STATES
from densify.geometry.nearest import nearest, nearest_k, tree_of
from densify.geometry.types import Float, Int

_ALPHAS = tuple(np.geomspace(100.0, 0.5, 7).tolist())  # from stiff to soft
_REACHES_M = np.geomspace(0.5, 0.25, len(_ALPHAS))  # targets farther away do not pull
_BLURS_M = np.geomspace(0.2, 0.08, len(_ALPHAS))
_NODE_M = 0.07  # one node per voxel, so that dense regions are not stiffer than sparse regions
_NUM_NEIGHBORS, _LINK_M = 6, 0.5
_NUM_BLURRED = 8
_ANCHOR, _ANCHOR_M = 2.0, 0.02  # weight of the rigid position, and distance at which it fades
_MAX_PRODUCTS, _RESIDUAL_DROP = 30, 0.02
_NUM_LOOKED_UP = 3
_MIN_POINTS = 20
# On eight streets parts of vehicles gained up to 0.045 of the squared distance, walkers within
# 20 m mostly 0.06 to 0.4.
_MIN_GAIN, _MIN_SHARE_BETTER = 0.05, 0.75


@dataclass(frozen=True)
class Snapshot:
    """The points of one object in one sweep."""

    points: Float  # (n,3) metres, n >= 1, in the object's own frame (rigid motion removed)
    time_s: float  # mean firing time of the points


@dataclass(frozen=True)
class Softened:
    """How an object bends from sweep to sweep; its points in one sweep are a `Snapshot`."""

    snapshots: tuple[Snapshot, ...]  # points of the object in each sweep, by ascending time
    # For each snapshot (n,3) metres, displacement of its points to the time of the next snapshot
    # relative to the rigid motion, object's frame; 0 for the last snapshot and for a rigid object
    to_next: tuple[Float, ...]
    # As ``to_next``, to the time of the previous snapshot; 0 for the first snapshot
    to_previous: tuple[Float, ...]
    # Weight of smoothness (stiffness) that held-out snapshots confirmed, inf for rigid
    alpha: float
    # Root mean square distance of held-out snapshots from their prediction, by the alpha tried,
    # inf first; empty if nothing was tried
    held_out_m: dict[float, float]

    def velocity_m_s(self, i: int) -> Float:
        """Return (n,3) velocities of snapshot i beyond the rigid motion, object's frame."""
        # The mean of the velocities to the next and from the previous snapshot
        velocities = [np.zeros_like(self.snapshots[i].points)]
        for j, moved in ((i + 1, self.to_next[i]), (i - 1, self.to_previous[i])):
            if 0 <= j < len(self.snapshots):
                velocities.append(moved / (self.snapshots[j].time_s - self.snapshots[i].time_s))
        return np.asarray(np.mean(velocities[1:] or velocities, axis=0))

    def carry(self, i: int, j: int) -> Float:
        """Return the (n,3) points of snapshot i at the time of snapshot j, object's frame."""
        # At each snapshot in between, a point continues like nearby points that came the same way.
        points, step = self.snapshots[i].points, 1 if j > i else -1
        if i == j or np.isinf(self.alpha):
            return points
        forward, backward = self.to_next, self.to_previous
        if step < 0:
            forward, backward = backward, forward
        moved = forward[i]
        for k in range(i + step, j, step):
            points = points + moved
            moved = _look_up(points, moved, self.snapshots[k].points, -backward[k], forward[k])
        return points + moved


def soften(snapshots: Sequence[Snapshot]) -> Softened:
    """Estimate the bending of one object from its snapshots, by ascending time.

    Every second snapshot is left out, and predicted from the bending between its neighbours. The
    softest stiffness is taken that predicts clearly better than the rigid object, in most
    snapshots. Otherwise the object stays rigid. Objects longer than 3 m, with fewer than 5
    snapshots, less than 0.35 s, or a median of fewer than 20 points per snapshot always stay rigid.
    """
    snapshots = tuple(snapshots)
    zero = tuple(np.zeros_like(p.points) for p in snapshots)
    if not _may_bend(snapshots):
        return Softened(snapshots, zero, zero, np.inf, {})
    squared = _held_out(snapshots)
    rms_m = np.sqrt(squared.mean(axis=0)).tolist()
    held_out_m = dict(zip((np.inf, *_ALPHAS), rms_m, strict=True))
    clearly = squared.mean(axis=0) < (1 - _MIN_GAIN) * squared[:, 0].mean()
    mostly = (squared < squared[:, :1]).mean(axis=0) >= _MIN_SHARE_BETTER
    confirmed = np.flatnonzero(clearly & mostly)
    if not len(confirmed):
        return Softened(snapshots, zero, zero, np.inf, held_out_m)
    softest = int(confirmed[-1]) - 1
    bending = _Bending(snapshots)
    for k in range(softest + 1):
        bending.bring_beyond()
        bending.refine(k)
    return Softened(
        snapshots, *_averaged(snapshots, *bending.at_points()), _ALPHAS[softest], held_out_m
    )


def _may_bend(snapshots: tuple[Snapshot, ...]) -> bool:
    """Return True if the object is shorter than 3 m and was observed often enough."""
    if len(snapshots) < MIN_STATES or snapshots[-1].time_s - snapshots[0].time_s < MIN_SPAN_S:
        return False
    if np.median([len(p.points) for p in snapshots]) < _MIN_POINTS:
        return False
    lengths_m = [np.linalg.norm(np.ptp(p.points, axis=0)) for p in snapshots]
    return bool(np.median(lengths_m) < LONG_M)


def _held_out(snapshots: tuple[Snapshot, ...]) -> Float:
    """Return the mean squared distance (m²) of each held-out snapshot from its prediction."""
    # errors[i, k]: snapshot i + 1 at alpha k - 1; k = 0 is rigid
    errors = np.zeros((len(snapshots) - 2, 1 + len(_ALPHAS)))
    for first in (0, 1):
        kept, left_out = snapshots[first::2], snapshots[first + 1 :: 2]
        bending = _Bending(kept)
        for k in range(1 + len(_ALPHAS)):
            if k:
                bending.refine(k - 1)
            for n in range(len(kept) - 1):
                predicted = bending.between(n, left_out[n].time_s)
                errors[first + 2 * n, k] = _squared_distance(left_out[n].points, predicted)
    return errors


def _squared_distance(a: Float, b: Float) -> float:
    """Return the mean squared, capped distance (m²) of nearest points, both ways."""
    a_to_b_m = np.minimum(nearest(tree_of(b), a)[0], FIT_M)
    b_to_a_m = np.minimum(nearest(tree_of(a), b)[0], FIT_M)
    return float((a_to_b_m**2).mean() + (b_to_a_m**2).mean()) / 2


class _Bending:
    """Solver of the flow from each snapshot to the next and to the previous one."""

    def __init__(self, snapshots: tuple[Snapshot, ...]) -> None:
        self._snapshots = snapshots
        self._nodes = [p.points[_one_per_voxel(p.points)] for p in snapshots]
        n = len(snapshots)
        # A hop leads to the next or the previous snapshot. The nodes of all hops lie side by side.
        self._hops = [(i, i + 1) for i in range(n - 1)] + [(i, i - 1) for i in range(1, n)]
        everything = np.concatenate(self._nodes)
        self._apart_m = float(np.ptp(everything, axis=0).max()) + 10.0
        self._start = np.cumsum([0] + [len(self._nodes[a]) for a, _ in self._hops])
        self._source = self._side_by_side([self._nodes[a] for a, _ in self._hops])
        self._laplacian = _laplacian(self._source)
        self._around = nearest_k(tree_of(self._source), self._source, _NUM_BLURRED)[1]
        self._steady = self._steadiness()
        self._flow = np.zeros_like(self._source)  # (nodes, 3) beyond the rigid motion
        self._target = self._side_by_side([self._nodes[b] for _, b in self._hops])

    def refine(self, k: int) -> None:
        """Find all targets again and solve for the flow, in place; alpha k = 0 is the stiffest."""
        # Minimise, for fixed targets t: Σ w |f - t|² + Σ a |f|² + steady + alpha tr(Fᵀ L F).
        # The anchor a holds a node until it clearly left the rigid position (Geman, McClure 1987).
        moved = self._source + self._flow
        neighbours = nearest_k(tree_of(self._target), moved, _NUM_BLURRED)[1]
        target_mean, distance_m = _blurred(self._target, neighbours, moved, _BLURS_M[k])
        source_mean, _ = _blurred(moved, self._around, moved, _BLURS_M[k])
        weight = np.clip(1 - (distance_m / _REACHES_M[k]) ** 2, 0, 1) ** 2  # Tukey
        anchor = _ANCHOR / (1 + (self._flow**2).sum(axis=1) / _ANCHOR_M**2) ** 2
        pull = weight[:, None] * (self._flow + target_mean - source_mean)
        matrix = diags_array(weight + anchor) + self._steady + _ALPHAS[k] * self._laplacian
        jacobi = diags_array(1 / (matrix.diagonal() + 1e-9))
        for axis in range(3):
            start, rhs = self._flow[:, axis], pull[:, axis]
            enough = _RESIDUAL_DROP * float(np.linalg.norm(rhs - matrix @ start))
            self._flow[:, axis], _ = cg(
                matrix, rhs, start, rtol=0.0, atol=enough, maxiter=_MAX_PRODUCTS, M=jacobi
            )

    def bring_beyond(self) -> None:
        """Fill holes in the target of each hop from a to b by the snapshot beyond b, moved to b."""
        flows = self._by_hop()
        targets = []
        for a, b in self._hops:
            beyond = 2 * b - a
            brought = [self._nodes[beyond] + flows[beyond, b]] if (beyond, b) in flows else []
            targets.append(np.concatenate([self._nodes[b], *brought]))
        self._target = self._side_by_side(targets)

    def between(self, i: int, time_s: float) -> Float:
        """Return the (N,3) nodes of snapshots i and i + 1, both moved to a time between them."""
        flows = self._by_hop()
        start_s, end_s = self._snapshots[i].time_s, self._snapshots[i + 1].time_s
        share = (time_s - start_s) / (end_s - start_s)
        forth = self._nodes[i] + share * flows[i, i + 1]
        return np.concatenate([forth, self._nodes[i + 1] + (1 - share) * flows[i + 1, i]])

    def at_points(self) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
        """Return the flow (n,3) of each snapshot's points to the next and the previous one."""
        to_next = [np.zeros_like(p.points) for p in self._snapshots]
        to_previous = [np.zeros_like(p.points) for p in self._snapshots]
        for (a, b), flow in self._by_hop().items():
            nodes, points = self._nodes[a], self._snapshots[a].points
            moved = _look_up(points, np.zeros_like(points), nodes, np.zeros_like(nodes), flow)
            (to_next if b > a else to_previous)[a] = moved
        return tuple(to_next), tuple(to_previous)

    def _by_hop(self) -> dict[tuple[int, int], Float]:
        return dict(zip(self._hops, np.split(self._flow, self._start[1:-1]), strict=True))

    def _side_by_side(self, clouds: Sequence[Float]) -> Float:
        return np.concatenate([c + [k * self._apart_m, 0.0, 0.0] for k, c in enumerate(clouds)])

    def _steadiness(self) -> csr_array:
        """Return the (nodes, nodes) matrix of ``|f_next / dt_next + f_before / dt_before|²``."""
        # f: displacements to the next and the previous snapshot; the sum is 0 at constant velocity
        number = {hop: k for k, hop in enumerate(self._hops)}
        times_s = [p.time_s for p in self._snapshots]
        opposite = np.arange(len(self._source))
        diagonal, crossed = np.zeros((2, len(self._source)))
        for (a, b), k in number.items():
            opposite_hop = number.get((a, 2 * a - b))
            if opposite_hop is None:
                continue
            rows = slice(self._start[k], self._start[k + 1])
            opposite[rows] = np.arange(self._start[opposite_hop], self._start[opposite_hop + 1])
            u, v = 1 / abs(times_s[b] - times_s[a]), 1 / abs(times_s[2 * a - b] - times_s[a])
            scale = 2 / (u * u + v * v)  # a weight of 1 for equal times
            diagonal[rows], crossed[rows] = scale * u * u, scale * u * v
        row = np.arange(len(opposite))
        coupling = coo_array((crossed, (row, opposite)), shape=(len(row), len(row)))
        return csr_array(diags_array(diagonal) + coupling)


def _laplacian(points: Float) -> csr_array:
    """Return the (n,n) Laplacian ``(D - W) / mean(D)`` of the neighbour graph of points (n,3)."""
    # W[i, j] = exp(-|p_i - p_j|² / 1 m²) where either is among the 6 nearest of the other
    n = len(points)
    distance_m, neighbours = nearest_k(tree_of(points), points, _NUM_NEIGHBORS + 1)
    row, rank = np.nonzero(distance_m <= _LINK_M)
    weights = coo_array(
        (np.exp(-(distance_m[row, rank] ** 2)), (row, neighbours[row, rank])), shape=(n, n)
    ).tocsr()
    weights = weights.maximum(weights.T)
    degree = weights.sum(axis=1)
    return csr_array((diags_array(degree) - weights) / degree.mean())


def _averaged(
    snapshots: tuple[Snapshot, ...], to_next: tuple[Float, ...], to_previous: tuple[Float, ...]
) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """Average each flow with the reversed flow back from the snapshot where its points arrive."""

    def mean(a: int, b: int, flow: Float, reverse: Float) -> Float:
        arrived = snapshots[a].points + flow
        return (flow + _look_up(arrived, flow, snapshots[b].points, -reverse, -reverse)) / 2

    last = len(snapshots) - 1
    forth = [mean(i, i + 1, to_next[i], to_previous[i + 1]) for i in range(last)]
    back = [mean(i + 1, i, to_previous[i + 1], to_next[i]) for i in range(last)]
    return (*forth, to_next[last]), (to_previous[0], *back)


def _one_per_voxel(points: Float) -> Int:
    """Return the ascending rows of the first point in each voxel of 0.07 m."""
    voxel = np.floor((points - points.min(axis=0)) / _NODE_M).astype(np.int64)
    return np.sort(np.unique(voxel, axis=0, return_index=True)[1]).astype(np.int64)


def _blurred(points: Float, neighbours: Int, at: Float, blur_m: float) -> tuple[Float, Float]:
    """Return (N,3) Gaussian means of ``points[near[i]]`` around ``at[i]``, nearest distances."""
    around = points[neighbours]
    away = around - at[:, None]
    squared = np.einsum("nki,nki->nk", away, away)
    nearest = squared.min(axis=1)
    weight = np.exp((nearest[:, None] - squared) / (2 * blur_m**2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, around), np.sqrt(nearest)


def _look_up(
    points: Float, moved: Float, known_points: Float, known_moved: Float, values: Float
) -> Float:
    """Interpolate values (M,3) of known points with similar position and last displacement."""
    known, queries = np.hstack([known_points, known_moved]), np.hstack([points, moved])
    neighbours = nearest_k(tree_of(known), queries, _NUM_LOOKED_UP)[1]
    distance_m = np.linalg.norm(known[neighbours] - queries[:, None], axis=2)
    weight = 1 / (distance_m + 1e-3) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, values[neighbours])
