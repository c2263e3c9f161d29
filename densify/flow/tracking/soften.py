# SPDX-License-Identifier: MIT
"""From stiff to soft: how an object bends about its rigid motion, as far as held-out sweeps
confirm it.

The smoothness is the graph Laplacian of Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or
without Learning" (3DV 2020, section 3); a rigid group is its limit of infinite stiffness. Their
data term, nearest points, pulls points onto the other sweep's scan lines. Here blurred surfaces are
compared instead: a point goes by the difference between the mean of the target around it and the
mean of its own sweep around it. The first mean is a soft correspondence (Granger, Pennec,
"Multi-scale EM-ICP", ECCV 2002), the second takes away what blur alone does at edges and in gaps.
Scan lines, narrower than the blur, pull no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.flow.objective.graph import laplacian, radius_graph
from densify.geometry.types import Float, Int

_ALPHAS = tuple(np.geomspace(100.0, 0.5, 7).tolist())  # from stiff to soft
_REACHES_M = np.geomspace(0.5, 0.25, len(_ALPHAS))  # farther targets do not pull
_BLURS_M = np.geomspace(0.2, 0.08, len(_ALPHAS))
_NODE_M = 0.07  # one node per voxel: dense parts are not stiffer than sparse ones
_NUM_NEIGHBORS, _LINK_M = 6, 0.5
_NUM_BLURRED = 8
_STEADY = 1.0  # weight of the same velocity before and after
_ANCHOR, _ANCHOR_M = 2.0, 0.02  # weight of the rigid place, and the departure that frees a point
_MAX_PRODUCTS, _RESIDUAL_DROP = 30, 0.02
_NUM_LOOKED_UP = 3
_LARGEST_M = 3.0
_MIN_PARTS, _MIN_SEEN_S, _MIN_POINTS = 5, 0.35, 20
_CAP_M = 0.3  # one stray point says no more than this
# Measured on eight streets: parts of vehicles gain up to 0.045 of the squared distance, walkers
# within 20 m mostly 0.06 to 0.4.
_MIN_GAIN, _MIN_SHARE_BETTER = 0.05, 0.75


@dataclass(frozen=True)
class Part:
    """What one sweep saw of an object.

    points: (n,3) metres, n >= 1, in the object's own frame: its rigid motion is undone, so that the
        parts of a rigid object coincide. time_s: when it was seen.
    """

    points: Float
    time_s: float


@dataclass(frozen=True)
class Softened:
    """How an object bends from part to part.

    to_next, to_previous: for each part (n,3) metres by which its points leave the rigid motion
        until the next and the previous part's time; exactly 0 for a rigid object, and where there
        is no such part. alpha: the stiffness that held-out parts confirmed, inf for rigid.
    held_out_m: for each alpha tried, inf first, the root mean square distance of held-out parts
        from where their neighbours foretell them; empty where nothing was tried.
    """

    parts: tuple[Part, ...]
    to_next: tuple[Float, ...]
    to_previous: tuple[Float, ...]
    alpha: float
    held_out_m: dict[float, float]

    def velocity_m_s(self, i: int) -> Float:
        """(n,3) of part i's points about the rigid motion: the mean of before and after."""
        velocities = [np.zeros_like(self.parts[i].points)]
        for j, moved in ((i + 1, self.to_next[i]), (i - 1, self.to_previous[i])):
            if 0 <= j < len(self.parts):
                velocities.append(moved / (self.parts[j].time_s - self.parts[i].time_s))
        mean: Float = np.mean(velocities[1:] or velocities, axis=0)
        return mean

    def carry(self, i: int, j: int) -> Float:
        """(n,3) the points of part i where they are at part j's time, by way of the parts between:
        at each a point goes on as the nearest do that came the same way."""
        at, step = self.parts[i].points, 1 if j > i else -1
        if i == j or np.isinf(self.alpha):
            return at
        onward, back = self.to_next, self.to_previous
        if step < 0:
            onward, back = back, onward
        moved = onward[i]
        for k in range(i + step, j, step):
            at = at + moved
            moved = _look_up(at, moved, self.parts[k].points, -back[k], onward[k])
        return at + moved


def soften(parts: Sequence[Part]) -> Softened:
    """The bending of one object, or none.

    parts: what each sweep saw of it, by ascending time.

    The stiffness is lowered as long as held-out parts confirm it: every second part is left out,
    the bending between its neighbours is found without it, and the share of it until the left-out
    part's time is how they foretell it. The softest stiffness is taken that foretells clearly
    better than the rigid object does, and in most parts; if there is none the object stays rigid.
    So does what is longer than 3 m, seen in fewer than 5 sweeps or for less than 0.35 s, or with
    fewer than 20 points in half of them.

    Same input, same bytes. Raises InputError for parts that are empty, not (n,3), not finite, or
    not in order of time.
    """
    parts = tuple(parts)
    _check(parts)
    still = tuple(np.zeros_like(part.points) for part in parts)
    if not _may_bend(parts):
        return Softened(parts, still, still, np.inf, {})
    squared = _held_out(parts)
    rms_m = np.sqrt(squared.mean(axis=0)).tolist()
    held_out_m = dict(zip((np.inf, *_ALPHAS), rms_m, strict=True))
    clearly = squared.mean(axis=0) < (1 - _MIN_GAIN) * squared[:, 0].mean()
    mostly = (squared < squared[:, :1]).mean(axis=0) >= _MIN_SHARE_BETTER
    confirmed = np.flatnonzero(clearly & mostly)
    if not len(confirmed):
        return Softened(parts, still, still, np.inf, held_out_m)
    softest = int(confirmed[-1]) - 1
    bending = _Bending(parts)
    for level in range(softest + 1):
        bending.bring_beyond()
        bending.refine(level)
    bent = _both_ways(parts, *bending.at_points())
    return Softened(parts, *bent, _ALPHAS[softest], held_out_m)


def _check(parts: tuple[Part, ...]) -> None:
    for i, part in enumerate(parts):
        shape = np.shape(part.points)
        if len(shape) != 2 or shape[1] != 3 or not shape[0]:
            raise InputError(
                f"parts[{i}].points: got shape {shape}, expected (n,3) with n at least 1; leave "
                f"out sweeps that did not see the object"
            )
        if not np.isfinite(part.points).all():
            raise InputError(f"parts[{i}].points: got NaN or infinite, expected finite metres")
        if not np.isfinite(part.time_s) or (i and part.time_s <= parts[i - 1].time_s):
            raise InputError(
                f"parts[{i}].time_s: got {part.time_s}, expected finite seconds that ascend from "
                f"part to part"
            )


def _may_bend(parts: tuple[Part, ...]) -> bool:
    """False for what is a vehicle, or seen too little to tell."""
    if len(parts) < _MIN_PARTS or parts[-1].time_s - parts[0].time_s < _MIN_SEEN_S:
        return False
    if np.median([len(p.points) for p in parts]) < _MIN_POINTS:
        return False
    lengths_m = [np.linalg.norm(np.ptp(p.points, axis=0)) for p in parts]
    return bool(np.median(lengths_m) < _LARGEST_M)


def _held_out(parts: tuple[Part, ...]) -> Float:
    """(held-out parts, 1 + levels) mean squared distances, those of the rigid object first.

    Concretely, ``[i, k]`` is about part i + 1 at the stiffness k - 1. Targets are the neighbours
    alone: what lies beyond them is too far in time here.
    """
    errors = np.zeros((len(parts) - 2, 1 + len(_ALPHAS)))
    for first in (0, 1):
        kept, left_out = parts[first::2], parts[first + 1 :: 2]
        bending = _Bending(kept)
        for k in range(1 + len(_ALPHAS)):
            if k:
                bending.refine(k - 1)
            for n in range(len(kept) - 1):
                foretold = bending.between(n, left_out[n].time_s)
                errors[first + 2 * n, k] = _squared_distance(left_out[n].points, foretold)
    return errors


def _squared_distance(a: Float, b: Float) -> float:
    """Mean over both of the squared distance to the other's nearest point, capped."""
    there = np.minimum(cKDTree(b).query(a)[0], _CAP_M)
    back = np.minimum(cKDTree(a).query(b)[0], _CAP_M)
    return float((there**2).mean() + (back**2).mean()) / 2


class _Bending:
    """Bends all parts at once, each to the next and to the previous one.

    A hop leads from one part to a neighbour. The nodes of all hops lie in one cloud, far apart, so
    that one search and one system of equations serve all. With the targets held, ``refine`` solves
    ``min_F  Σ w |f - target|² + Σ a |f|² + steady + alpha tr(Fᵀ L F)``, where w fades with the
    distance to the target, a holds a point to its rigid place unless it has clearly left it
    (Geman, McClure 1987), and steady punishes that velocities before and after differ.
    """

    def __init__(self, parts: tuple[Part, ...]) -> None:
        self._parts = parts
        self._nodes = [p.points[_one_per_voxel(p.points)] for p in parts]
        n = len(parts)
        self._hops = [(i, i + 1) for i in range(n - 1)] + [(i, i - 1) for i in range(1, n)]
        everything = np.concatenate(self._nodes)
        self._apart_m = float(np.ptp(everything, axis=0).max()) + 10.0
        self._start = np.cumsum([0] + [len(self._nodes[a]) for a, _ in self._hops])
        self._source = self._side_by_side([self._nodes[a] for a, _ in self._hops])
        self._laplacian = laplacian(
            radius_graph(self._source, _LINK_M, _NUM_NEIGHBORS), "row-sum-zero"
        )
        self._around = _nearest(self._source, self._source, _NUM_BLURRED)
        self._opposite = np.arange(len(self._source))
        self._steady = np.zeros((len(self._source), 1))
        self._reversed = np.zeros((len(self._source), 1))
        self._join_velocities()
        self._flow = np.zeros_like(self._source)
        self._target = self._side_by_side([self._nodes[b] for _, b in self._hops])

    def refine(self, level: int) -> None:
        """Batch for the targets anew and solve, at the stiffness of a level."""
        moved = self._source + self._flow
        blur_m, reach_m = _BLURS_M[level], _REACHES_M[level]
        near = _nearest(self._target, moved, _NUM_BLURRED)
        there, distance_m = _blurred(self._target, near, moved, blur_m)
        own, _ = _blurred(moved, self._around, moved, blur_m)
        weight = np.clip(1 - (distance_m / reach_m) ** 2, 0, 1)[:, None] ** 2  # Tukey
        left_m2 = (self._flow**2).sum(axis=1, keepdims=True)
        anchor = _ANCHOR / (1 + left_m2 / _ANCHOR_M**2) ** 2
        pull = weight * (self._flow + there - own)
        self._solve(weight + anchor + self._steady, pull, _ALPHAS[level])

    def bring_beyond(self) -> None:
        """Add to each hop's target the part after it, brought there by the flow so far: gaps and
        edges of one sweep are filled by the other."""
        flows = self._by_hop()
        targets = []
        for a, b in self._hops:
            beyond = 2 * b - a
            brought = [self._nodes[beyond] + flows[beyond, b]] if (beyond, b) in flows else []
            targets.append(np.concatenate([self._nodes[b], *brought]))
        self._target = self._side_by_side(targets)

    def between(self, i: int, time_s: float) -> Float:
        """(N,3) the nodes of part i and of the next where they are at a time between."""
        flows = self._by_hop()
        start_s, end_s = self._parts[i].time_s, self._parts[i + 1].time_s
        share = (time_s - start_s) / (end_s - start_s)
        forth = self._nodes[i] + share * flows[i, i + 1]
        return np.concatenate([forth, self._nodes[i + 1] + (1 - share) * flows[i + 1, i]])

    def at_points(self) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
        """Flow of each part (n,3) to the next and to the previous one, 0 where there is none."""
        to_next = [np.zeros_like(p.points) for p in self._parts]
        to_previous = [np.zeros_like(p.points) for p in self._parts]
        for (a, b), flow in self._by_hop().items():
            nodes, points = self._nodes[a], self._parts[a].points
            came, known_came = np.zeros_like(points), np.zeros_like(nodes)
            found = _look_up(points, came, nodes, known_came, flow)
            (to_next if b > a else to_previous)[a] = found
        return tuple(to_next), tuple(to_previous)

    def _by_hop(self) -> dict[tuple[int, int], Float]:
        return dict(zip(self._hops, np.split(self._flow, self._start[1:-1]), strict=True))

    def _side_by_side(self, clouds: Sequence[Float]) -> Float:
        return np.concatenate([c + [k * self._apart_m, 0.0, 0.0] for k, c in enumerate(clouds)])

    def _join_velocities(self) -> None:
        """Rows and weights of ``|f_next / dt_next + f_previous / dt_previous|²``, scaled to 1 for
        equal intervals."""
        number = {hop: k for k, hop in enumerate(self._hops)}
        times_s = [p.time_s for p in self._parts]
        for (a, b), k in number.items():
            other = 2 * a - b
            if (a, other) not in number:
                continue
            rows = slice(self._start[k], self._start[k + 1])
            theirs = number[a, other]
            self._opposite[rows] = np.arange(self._start[theirs], self._start[theirs + 1])
            u, v = 1 / abs(times_s[b] - times_s[a]), 1 / abs(times_s[other] - times_s[a])
            scale = 2 * _STEADY / (u * u + v * v)
            self._steady[rows], self._reversed[rows] = scale * u * u, scale * u * v

    def _solve(self, diagonal: Float, pull: Float, alpha: float) -> None:
        """Conjugate gradients from the present flow, with Jacobi's preconditioner, for the three
        axes at once."""

        def product(flow: Float) -> Float:
            bent: Float = self._laplacian @ flow
            return diagonal * flow + self._reversed * flow[self._opposite] + alpha * bent

        preconditioner = 1 / (diagonal + alpha * self._laplacian.diagonal()[:, None] + 1e-9)
        flow = self._flow
        residual = pull - product(flow)
        enough = _RESIDUAL_DROP**2 * (residual**2).sum()
        direction = conditioned = preconditioner * residual
        slope = (residual * conditioned).sum()
        for _ in range(_MAX_PRODUCTS):
            if (residual**2).sum() <= enough:
                break
            changed = product(direction)
            length = slope / (direction * changed).sum()
            flow = flow + length * direction
            residual = residual - length * changed
            conditioned = preconditioner * residual
            previous, slope = slope, (residual * conditioned).sum()
            direction = conditioned + slope / previous * direction
        self._flow = flow


def _both_ways(
    parts: tuple[Part, ...], to_next: tuple[Float, ...], to_previous: tuple[Float, ...]
) -> tuple[tuple[Float, ...], tuple[Float, ...]]:
    """The mean of the way to a neighbour and of its way back from where a point arrives."""

    def mean(a: int, b: int, onward: Float, back: Float) -> Float:
        arrived = parts[a].points + onward
        return (onward + _look_up(arrived, onward, parts[b].points, -back, -back)) / 2

    last = len(parts) - 1
    forth = [mean(i, i + 1, to_next[i], to_previous[i + 1]) for i in range(last)]
    back = [mean(i + 1, i, to_previous[i + 1], to_next[i]) for i in range(last)]
    return (*forth, to_next[last]), (to_previous[0], *back)


def _one_per_voxel(points: Float) -> Int:
    """Rows of the first point in each voxel, ascending."""
    voxel = np.floor((points - points.min(axis=0)) / _NODE_M).astype(np.int64)
    return np.sort(np.unique(voxel, axis=0, return_index=True)[1]).astype(np.int64)


def _nearest(points: Float, at: Float, num_neighbors: int) -> Int:
    """(N,k) rows of the points nearest to each of (N,3) places; k at most their number."""
    ranks = np.arange(1, min(num_neighbors, len(points)) + 1)
    return np.asarray(cKDTree(points, balanced_tree=False).query(at, ranks)[1], np.int64)


def _blurred(points: Float, near: Int, at: Float, blur_m: float) -> tuple[Float, Float]:
    """(N,3) Gaussian-weighted mean of ``points[near]`` around each place, and (N,) how far the
    nearest of them is."""
    around = points[near]
    away = around - at[:, None]
    squared = np.einsum("nki,nki->nk", away, away)
    nearest = squared.min(axis=1)
    weight = np.exp((nearest[:, None] - squared) / (2 * blur_m**2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, around), np.sqrt(nearest)


def _look_up(at: Float, came: Float, points: Float, known_came: Float, values: Float) -> Float:
    """Values of the points nearest in place and in the way they came, nearer ones weighing more.

    at, came: (N,3). points, known_came, values: (M,3). Legs that cross are told apart by the way.
    """
    known = np.hstack([points, known_came])
    asked = np.hstack([at, came])
    near = _nearest(known, asked, _NUM_LOOKED_UP)
    distance_m = np.linalg.norm(known[near] - asked[:, None], axis=2)
    weight = 1 / (distance_m + 1e-3) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nki->ni", weight, values[near])
