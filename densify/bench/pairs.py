# SPDX-License-Identifier: MIT
"""Pairs of sweeps, and the methods that take two clouds to scene flow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from densify.bench.baselines import cluster_icp, nonrigid_icp
from densify.bench.windows import Window
from densify.config import Config
from densify.config.errors import InputError
from densify.flow.objective.graph import knn_graph, laplacian
from densify.flow.objective.solvers import SolverSettings, solve
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry.types import Bool, Float, FlowField, Int, RegisteredSweep

NUM_NEIGHBORS = 50
"""k of the paper's graph; no pair is smaller."""

_ALPHA = 10.0  # the paper's
_MOVES_M_S = 0.5  # Chodosh et al., WACV 2024: a point is dynamic from here
_NUM_CARRIED = 3
_SEED = 0


class GivenSweep(NamedTuple):
    """A registered sweep as the methods get it. points: (N,3) world. above: (N,) above the ground.
    drawn: rows of ``points[above]`` that the slow methods see."""

    registered: RegisteredSweep
    points: Float
    above: Bool
    drawn: Int


class Trace(NamedTuple):
    """A solver's energies, m², and when each was known, seconds since its start."""

    energies: tuple[float, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True)
class Pair:
    """A sweep and its neighbour towards the key.

    source, target: (n,3), (m,3) world, what is above the ground. drawn, target_drawn: what of it is
    drawn. duration_s: negative if backwards.
    """

    here: GivenSweep
    there: GivenSweep

    @cached_property
    def source(self) -> Float:
        return self.here.points[self.here.above]

    @cached_property
    def target(self) -> Float:
        return self.there.points[self.there.above]

    @cached_property
    def drawn(self) -> Float:
        return self.source[self.here.drawn]

    @cached_property
    def target_drawn(self) -> Float:
        return self.target[self.there.drawn]

    @property
    def duration_s(self) -> float:
        return (self.there.registered.sweep.stamp_ns - self.here.registered.sweep.stamp_ns) * 1e-9

    @cached_property
    def _laplacian(self) -> csr_array:
        return laplacian(knn_graph(self.drawn, NUM_NEIGHBORS))

    def energy(self, flow: Float) -> float:
        """The paper's E (m²) of the flow (n,3) at the drawn points; the definition, without the
        solvers' code."""
        drawn = flow[self.here.drawn]
        moved = self.drawn + drawn
        forward_m, _ = cKDTree(self.target_drawn).query(moved, workers=-1)
        backward_m, _ = cKDTree(moved).query(self.target_drawn, workers=-1)
        smoothness = np.sum(drawn * (self._laplacian @ drawn))
        return float(np.sum(forward_m**2) + np.sum(backward_m**2) + _ALPHA * smoothness)

    def carried(self, drawn_flow: Float) -> Float:
        """(n,3) from the flow of the drawn points: each takes that of the nearest three, weighed by
        inverse distance."""
        if len(self.drawn) == len(self.source):
            return drawn_flow
        k = min(_NUM_CARRIED, len(self.drawn))
        distance_m, near = cKDTree(self.drawn).query(self.source, list(range(1, k + 1)), workers=-1)
        weight = 1 / (np.asarray(distance_m) + 1e-6)
        weight /= weight.sum(axis=1, keepdims=True)
        return np.einsum("nk,nkj->nj", weight, drawn_flow[near])

    def as_field(self, flow: Float) -> FlowField:
        """Flow of the whole sweep in its lidar frame from (n,3), world: the ground stands still,
        and what was measured before or after the reference time moves as it does afterwards."""
        registered, above = self.here.registered, self.here.above
        field = FlowField.zero(len(above))
        field.displacement[above] = flow @ registered.T_world_lidar[:3, :3]
        field.moving[above] = np.linalg.norm(flow, axis=1) >= _MOVES_M_S * abs(self.duration_s)
        offset_ns = registered.sweep.offset_ns
        if offset_ns is None:
            return field
        late = -offset_ns[:, None] * 1e-9 / self.duration_s
        return replace(field, to_reference=late * field.displacement)


def pairs_of(window: Window, max_points: int) -> dict[int, Pair]:
    """Pairs by the frame of the source: every sweep but the key's with its neighbour towards the
    key.

    max_points: drawn of each sweep, 0 for all. Raises InputError for a sweep with too few points.
    """
    rng = np.random.default_rng(_SEED)
    clouds = {}
    for registered in window.stretch.sweeps:
        frame = registered.frame
        above = window.above[frame]
        num_above = int(above.sum())
        if num_above <= NUM_NEIGHBORS:
            raise InputError(
                f"frame {frame}: {num_above} points stand above the ground, expected more than "
                f"{NUM_NEIGHBORS}; choose another key"
            )
        count = num_above if max_points == 0 else min(max_points, num_above)
        drawn = np.sort(rng.permutation(num_above)[:count])
        clouds[frame] = GivenSweep(registered, window.points(frame), above, drawn)
    others = [frame for frame in window.frames if frame != window.key]
    return {f: Pair(clouds[f], clouds[window.towards_key(f)]) for f in others}


def flow_of_pair(method: str, pair: Pair, config: Config) -> tuple[FlowField, Trace | None]:
    """One method on two clouds: flow of the whole source sweep in its lidar frame, and how its
    energy fell, of the paper's objective."""
    if method == "ours-pair":
        return _ours(pair, config), None
    trace = None
    if method == "rigid":
        flow = np.zeros_like(pair.source)
    elif method == "cluster-icp":
        flow = cluster_icp(pair.source, pair.target, abs(pair.duration_s))
    elif method == "nicp":
        flow = pair.carried(nonrigid_icp(pair.drawn, pair.target))
    else:
        solver = "adam" if method == "paper-adam" else "pcg"
        solution = solve(pair.drawn, pair.target_drawn, SolverSettings(solver=solver))
        flow = pair.carried(solution.flow)
        trace = Trace(solution.energies, (0.0,) * len(solution.energies))
    return pair.as_field(flow), trace


def _ours(pair: Pair, config: Config) -> FlowField:
    """Flow of the whole sweeps, whose ground it finds itself."""
    sweeps = [cloud.registered.sweep for cloud in (pair.here, pair.there)]
    times_ns = [None if s.offset_ns is None else s.stamp_ns + s.offset_ns for s in sweeps]
    found = estimate_flow(
        pair.here.points,
        pair.there.points,
        config,
        source_offset_ns=times_ns[0],
        target_offset_ns=times_ns[1],
        source_lidar=sweeps[0].lidar,
        target_lidar=sweeps[1].lidar,
    )
    R_world_lidar = pair.here.registered.T_world_lidar[:3, :3]
    own = found.to_reference
    return replace(
        FlowField.zero(len(found.moving)),  # its instances mean nothing in the next pair
        displacement=found.displacement @ R_world_lidar,
        moving=found.moving,
        to_reference=None if own is None else own @ R_world_lidar,
    )
