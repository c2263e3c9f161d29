# SPDX-License-Identifier: MIT
"""Estimate non-rigid motion: how a tracked object bends relative to its rigid motion.

The smoothness term is the graph Laplacian of Pontes, Hays, Lucey (3DV 2020, section 3). Their data
term, nearest points, pulls points onto scan lines. Here a point moves by the mean of the target
around it, a soft correspondence (Granger, Pennec, "Multi-scale EM-ICP", ECCV 2002), minus the mean
of its own sweep, which removes the effect of the blur at edges and in holes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from densify.flow.graph import knn_graph
from densify.flow.tracking.following import FIT_M
from densify.flow.tracking.objects import LONG_M, MIN_SPAN_S, MIN_STATES
from densify.geometry.nearest import nearest, nearest_k, thinned, tree_of
from densify.geometry.types import Float, Int

# Levels from stiff to soft: weight of smoothness, greatest distance of a target that pulls, and
# standard deviation of the blur
_ALPHAS = tuple(np.geomspace(100.0, 0.5, 7).tolist())
_REACHES_M = np.geomspace(0.5, 0.25, len(_ALPHAS))
_BLURS_M = np.geomspace(0.2, 0.08, len(_ALPHAS))
# One node per voxel: otherwise dense regions would be stiffer than sparse regions.
_NODE_M = 0.07
_NUM_BLURRED = 8  # neighbours that are averaged by a blur
_ANCHOR, _ANCHOR_M = 2.0, 0.02  # weight of the rigid position, and distance at which it fades
_MAX_PRODUCTS, _RESIDUAL_DROP = 30, 0.02  # limits of the linear solver


@dataclass(frozen=True)
class Snapshot:
    """The points of one object in one sweep."""

    points: Float  # (n,3) metres, n >= 1, in the object's own frame (rigid motion removed)
    time_s: float  # mean firing time of the points


@dataclass(frozen=True)
class Softened:
    """The non-rigid motion of one object between the sweeps that see it."""

    snapshots: tuple[Snapshot, ...]  # points of the object in each sweep, by ascending time
    # hops[a, b] is (n,3) in metres: the displacement of the points of snapshot a to the time of its
    # neighbour b, relative to the rigid motion, in the object's frame. Empty for a rigid object.
    hops: dict[tuple[int, int], Float]
    # Weight of smoothness (stiffness) that held-out snapshots confirmed, inf for rigid
    alpha: float
    # Root mean square distance of held-out snapshots from their prediction, by the alpha tried,
    # inf first; empty if nothing was tried
    held_out_m: dict[float, float]

    def velocity_m_s(self, i: int) -> Float:
        """Return velocities (n,3), m/s, of snapshot i without the rigid motion, object's frame."""
        # The result is the mean of the velocities to the next and from the previous snapshot. To
        # the previous snapshot both displacement and duration have the opposite sign.
        velocities = []
        for j in (i + 1, i - 1):
            if (i, j) in self.hops:
                duration_s = self.snapshots[j].time_s - self.snapshots[i].time_s
                velocities.append(self.hops[i, j] / duration_s)
        if not velocities:
            return np.zeros_like(self.snapshots[i].points)
        return np.asarray(np.mean(velocities, axis=0))

    def carry(self, i: int, j: int) -> Float:
        """Return the points (n,3) of snapshot i at the time of snapshot j, object's frame."""
        points = self.snapshots[i].points
        if i == j or np.isinf(self.alpha):
            return points
        step = 1 if j > i else -1
        # At each snapshot in between, a point continues like the nearby points of that snapshot
        # which arrived by a similar displacement: a hand that passes the hip moves on as a hand.
        displacement = self.hops[i, i + step]
        for k in range(i + step, j, step):
            points = points + displacement
            arrived_by, onward = -self.hops[k, k - step], self.hops[k, k + step]
            displacement = _interpolate(
                points, displacement, self.snapshots[k].points, arrived_by, onward
            )
        return points + displacement


def soften(snapshots: Sequence[Snapshot]) -> Softened:
    """Estimate how one object bends, from its points in each sweep by ascending time.

    Every second snapshot is held out, and predicted from its neighbours' bending. The softest
    stiffness is taken that lowers the mean squared error of the rigid object by more than 5 %, and
    is better in at least 75 % of the snapshots. Objects of 3 m or longer (median), with fewer than
    5 snapshots, within less than 0.35 s, or with a median of fewer than 20 points stay rigid.
    """
    snapshots = tuple(snapshots)
    if not _may_bend(snapshots):
        return Softened(snapshots, {}, np.inf, {})
    squared_m2 = _held_out_errors(snapshots)
    rms_m = np.sqrt(squared_m2.mean(axis=0)).tolist()
    held_out_m = dict(zip((np.inf, *_ALPHAS), rms_m, strict=True))
    rigid_m2 = squared_m2[:, 0]
    # On eight streets parts of vehicles gained up to 4.5 %, walkers within 20 m mostly 6 to 40 %.
    is_clearly_better = squared_m2.mean(axis=0) < 0.95 * rigid_m2.mean()
    is_mostly_better = (squared_m2 < squared_m2[:, :1]).mean(axis=0) >= 0.75
    confirmed = np.flatnonzero(is_clearly_better & is_mostly_better)
    if not len(confirmed):
        return Softened(snapshots, {}, np.inf, held_out_m)
    softest = int(confirmed[-1]) - 1  # column 0 is the rigid object
    # Now all snapshots are used, from the stiffest level down to the confirmed level.
    solver = _FlowSolver(snapshots)
    for level in range(softest + 1):
        solver.fill_targets()
        solver.refine(level)
    return Softened(snapshots, solver.at_points(), _ALPHAS[softest], held_out_m)


def _may_bend(snapshots: tuple[Snapshot, ...]) -> bool:
    """Return True if the object is shorter than 3 m and was observed often enough."""
    if len(snapshots) < MIN_STATES or snapshots[-1].time_s - snapshots[0].time_s < MIN_SPAN_S:
        return False
    if np.median([len(snapshot.points) for snapshot in snapshots]) < 20:
        return False
    lengths_m = [np.linalg.norm(np.ptp(snapshot.points, axis=0)) for snapshot in snapshots]
    return bool(np.median(lengths_m) < LONG_M)


def _held_out_errors(snapshots: tuple[Snapshot, ...]) -> Float:
    """Return the mean squared distances (m²) of held-out snapshots from their predictions."""
    # Row i belongs to snapshot i + 1: the first and the last snapshot cannot be predicted. Column 0
    # is the rigid object, column k has alpha k - 1.
    squared_m2 = np.zeros((len(snapshots) - 2, 1 + len(_ALPHAS)))
    # Snapshots with even index predict those with odd index, and the other way round.
    for parity in (0, 1):
        used = snapshots[parity::2]
        held_out = snapshots[parity + 1 :: 2]
        solver = _FlowSolver(used)
        for column in range(1 + len(_ALPHAS)):
            if column > 0:
                solver.refine(level=column - 1)
            for n in range(len(used) - 1):
                predicted = solver.between(n, held_out[n].time_s)
                error_m2 = _mean_squared_m2(held_out[n].points, predicted)
                squared_m2[parity + 2 * n, column] = error_m2
    return squared_m2


def _mean_squared_m2(points: Float, predicted: Float) -> float:
    """Return the mean squared, capped distance (m²) of nearest points, in both directions."""
    to_predicted_m = np.minimum(nearest(tree_of(predicted), points)[0], FIT_M)
    to_points_m = np.minimum(nearest(tree_of(points), predicted)[0], FIT_M)
    return float((to_predicted_m**2).mean() + (to_points_m**2).mean()) / 2


class _FlowSolver:
    """Solver of the flow of nodes (points thinned by voxels) to the next and previous snapshot."""

    def __init__(self, snapshots: tuple[Snapshot, ...]) -> None:
        """Prepare all that depends on the nodes alone, for snapshots by ascending time."""
        self._snapshots = snapshots
        self._nodes = []
        for snapshot in snapshots:
            order = np.arange(len(snapshot.points))
            rows = thinned(snapshot.points, order, _NODE_M, max_per_cell=1)
            self._nodes.append(snapshot.points[rows])
        # A hop (a, b) leads from snapshot a to the next or the previous snapshot b.
        last = len(snapshots) - 1
        self._hops = [(a, a + 1) for a in range(last)] + [(a, a - 1) for a in range(1, last + 1)]
        # All hops are solved at once. Their nodes are shifted apart along x by 10 m more than the
        # object's extent, farther than a blur reaches: only neighbours of the same hop count.
        extent_m = float(np.ptp(np.concatenate(self._nodes), axis=0).max())
        self._shift_m = extent_m + 10.0
        # Index of the first node of each hop, and after the last hop the number of all nodes
        self._begins = np.cumsum([0] + [len(self._nodes[a]) for a, _ in self._hops])
        self._source = self._side_by_side([self._nodes[a] for a, _ in self._hops])
        self._target = self._side_by_side([self._nodes[b] for _, b in self._hops])
        # (nodes, 3) flow of each node relative to the rigid motion, which `refine` updates
        self._flow = np.zeros_like(self._source)
        # The following matrices depend on the source nodes only, and serve all levels. On a surface
        # 6 neighbours surround a node. Beyond 0.5 m they would be of another part of the object.
        weights = knn_graph(self._source, num_neighbors=6, within_m=0.5)
        degree = weights.sum(axis=1)
        self._laplacian = csr_array((diags_array(degree) - weights) / degree.mean())
        self._neighbours = nearest_k(tree_of(self._source), self._source, _NUM_BLURRED)[1]
        self._velocity_penalty = self._velocity_penalty_matrix()

    def refine(self, level: int) -> None:
        """Match all nodes, and update their flow at ``_ALPHAS[level]``; level 0 is the stiffest."""
        # With fixed target flows t and weights w the flow F of rows f minimises
        #   Σ w |f - t|² + Σ a |f|² + velocity penalty + alpha tr(Fᵀ L F)
        # The anchor a holds a node until it clearly left the rigid position (Geman, McClure 1987).
        target_flow, weight = self._match(level)
        anchor = _ANCHOR / (1 + (self._flow**2).sum(axis=1) / _ANCHOR_M**2) ** 2
        smoothness = _ALPHAS[level] * self._laplacian
        matrix = diags_array(weight + anchor) + self._velocity_penalty + smoothness
        self._solve(matrix, weight[:, None] * target_flow)

    def _match(self, level: int) -> tuple[Float, Float]:
        """Return the flow (nodes, 3) of each node to its target, and weights (nodes,), 0 to 1."""
        moved = self._source + self._flow
        neighbours = nearest_k(tree_of(self._target), moved, _NUM_BLURRED)[1]
        target_mean, distance_m = _blur(self._target, neighbours, moved, _BLURS_M[level])
        # At an edge or beside a hole, a mean is biased towards the inside. The mean of the object's
        # own nodes has the same bias, hence the difference of both has none.
        source_mean, _ = _blur(moved, self._neighbours, moved, _BLURS_M[level])
        weight = np.clip(1 - (distance_m / _REACHES_M[level]) ** 2, 0, 1) ** 2  # Tukey
        return self._flow + target_mean - source_mean, weight

    def _solve(self, matrix: csr_array, right_side: Float) -> None:
        """Solve ``matrix`` · flow = ``right_side`` roughly, in place, by conjugate gradients."""
        jacobi = diags_array(1 / (matrix.diagonal() + 1e-9))
        for axis in range(3):
            start, right = self._flow[:, axis], right_side[:, axis]
            residual = right - matrix @ start
            # Matches are provisional: a full solution is not needed.
            tolerance = _RESIDUAL_DROP * float(np.linalg.norm(residual))
            self._flow[:, axis], _ = cg(
                matrix, right, start, rtol=0.0, atol=tolerance, maxiter=_MAX_PRODUCTS, M=jacobi
            )

    def fill_targets(self) -> None:
        """Fill holes in the target of each hop (a, b) by the snapshot after b, moved to b."""
        flows = self._by_hop()
        targets = []
        for a, b in self._hops:
            clouds = [self._nodes[b]]
            following = 2 * b - a  # the snapshot after b in the direction of the hop
            if (following, b) in flows:
                clouds.append(self._nodes[following] + flows[following, b])
            targets.append(np.concatenate(clouds))
        self._target = self._side_by_side(targets)

    def between(self, i: int, time_s: float) -> Float:
        """Return the nodes (N,3) of snapshots i and i + 1, both moved to a time between them."""
        flows = self._by_hop()
        begin_s, end_s = self._snapshots[i].time_s, self._snapshots[i + 1].time_s
        share = (time_s - begin_s) / (end_s - begin_s)
        earlier = self._nodes[i] + share * flows[i, i + 1]
        later = self._nodes[i + 1] + (1 - share) * flows[i + 1, i]
        return np.concatenate([earlier, later])

    def at_points(self) -> dict[tuple[int, int], Float]:
        """Return the flow (n,3) of the points of each hop, metres, by (a, b)."""
        points = [snapshot.points for snapshot in self._snapshots]
        flows = {}
        for (a, b), flow in self._by_hop().items():
            # With equal displacements, 0, the nearest nodes are chosen by position alone.
            zero, node_zero = np.zeros_like(points[a]), np.zeros_like(self._nodes[a])
            flows[a, b] = _interpolate(points[a], zero, self._nodes[a], node_zero, flow)
        # Each flow is averaged with the reversed flow of the points where it arrives.
        averaged = {}
        for (a, b), flow in flows.items():
            reverse = -flows[b, a]
            reversed_flow = _interpolate(points[a] + flow, flow, points[b], reverse, reverse)
            averaged[a, b] = (flow + reversed_flow) / 2
        return averaged

    def _by_hop(self) -> dict[tuple[int, int], Float]:
        """Return the flow (n,3) of the nodes of each hop, metres, by (a, b)."""
        return dict(zip(self._hops, np.split(self._flow, self._begins[1:-1]), strict=True))

    def _side_by_side(self, clouds: Sequence[Float]) -> Float:
        """Return the clouds (n,3) of all hops as one array, each shifted to a place along x."""
        return np.concatenate(
            [cloud + [k * self._shift_m, 0.0, 0.0] for k, cloud in enumerate(clouds)]
        )

    def _velocity_penalty_matrix(self) -> csr_array:
        """Return the (nodes, nodes) matrix of ``|f_next / dt_next + f_before / dt_before|²``."""
        # At constant velocity both displacements have opposite signs, and the sum is 0. The square
        # has a term f² / dt² for each hop (the diagonal), and a mixed term (the coupling).
        hop_numbers = {hop: k for k, hop in enumerate(self._hops)}
        times_s = [snapshot.time_s for snapshot in self._snapshots]
        row = np.arange(len(self._source))
        # Row of the same node in the hop to the other side. A node without such a hop has its own
        # row, with weight 0.
        opposite_row = row.copy()
        diagonal, coupling = np.zeros((2, len(row)))
        for (a, b), k in hop_numbers.items():
            opposite_b = 2 * a - b
            opposite_k = hop_numbers.get((a, opposite_b))
            if opposite_k is None:
                continue
            hop = slice(self._begins[k], self._begins[k + 1])
            opposite_row[hop] = row[self._begins[opposite_k] : self._begins[opposite_k + 1]]
            rate = 1 / abs(times_s[b] - times_s[a])
            opposite_rate = 1 / abs(times_s[opposite_b] - times_s[a])
            # The mean weight of both hops is 1, for any times.
            scale = 2 / (rate * rate + opposite_rate * opposite_rate)
            diagonal[hop] = scale * rate * rate
            coupling[hop] = scale * rate * opposite_rate
        mixed = coo_array((coupling, (row, opposite_row)), shape=(len(row), len(row)))
        return csr_array(diags_array(diagonal) + mixed)


def _blur(points: Float, neighbours: Int, positions: Float, blur_m: float) -> tuple[Float, Float]:
    """Return the Gaussian means (N,3) of each position's neighbours, and nearest distances (N,)."""
    neighbour_points = points[neighbours]
    offset = neighbour_points - positions[:, None]
    squared = np.einsum("nki,nki->nk", offset, offset)
    nearest_squared = squared.min(axis=1)
    # Relative to the nearest neighbour, whose weight is 1: the sum is never 0.
    weight = np.exp((nearest_squared[:, None] - squared) / (2 * blur_m**2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, neighbour_points), np.sqrt(nearest_squared)


def _interpolate(
    points: Float,
    displacement: Float,
    sample_points: Float,
    sample_displacement: Float,
    values: Float,
) -> Float:
    """Return the values (N,3) at points, from M samples of similar position and displacement."""
    samples = np.hstack([sample_points, sample_displacement])
    queries = np.hstack([points, displacement])
    neighbours = nearest_k(tree_of(samples), queries, 3)[1]
    distance_m = np.linalg.norm(samples[neighbours] - queries[:, None], axis=2)
    weight = 1 / (distance_m + 1e-3) ** 2  # 1 mm avoids a division by 0
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, values[neighbours])
