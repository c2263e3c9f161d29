# SPDX-License-Identifier: MIT
"""``densify bench flow``: scene flow methods on the same pairs and windows, in one process.

The pairs of a window are its sweeps and their neighbours towards the key, brought into the key's
frame by registration; methods of two clouds get the points above the ground of both, the window
engine gets the window. The objective and non-rigid ICP are slow: they move at most ``max_points``
points, drawn at random, and their flow is carried to the other points from the nearest three. The
objective, which matches both ways, sees as many of the target, non-rigid ICP all of it. The energy
is always that of the paper's objective on the drawn points of both.

Seconds are per pair; the window engine's are its whole time, ground and chaining included, over the
number of sweeps. Registration counts for none. Errors are over the points above the ground of all
pairs together.

Firing times within a sweep are used for every method: a point moves by its own flow between the
moment it was measured and the sweep's reference time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from densify import poses
from densify.bench.baselines import cluster_icp, nonrigid_icp
from densify.bench.memory import PeakMemory
from densify.bench.scoring import Scorer
from densify.bench.windows import (
    WindowFlow,
    chained,
    engine_flow,
    heights_above_ground,
    open_window,
)
from densify.config import Config
from densify.errors import InputError
from densify.flow.graph import knn_graph, laplacian
from densify.flow.pair import estimate_flow
from densify.flow.solvers import ObjectiveSettings, solve
from densify.types import Bool, Float, FlowField, Int, LidarSequence, Progress, Window

OURS = "window"
METHODS = {
    OURS: "this package's engine on the whole window, all points",
    "pair": "this package on two clouds",
    "paper": "the paper's objective, conjugate gradients",
    "adam": "the paper's objective, Adam, 1,500 steps, the best of them kept",
    "rigid": "nothing moves",
    "cluster-icp": "rigid ICP per cluster",
    "nicp": "non-rigid ICP, locally affine",
}
DEFAULT_METHODS = tuple(name for name in METHODS if name != "adam")
DEFAULT_MAX_POINTS = 8000

_SLOW = ("paper", "adam", "nicp")
_ALPHA, _NUM_NEIGHBORS = 10.0, 50  # the paper's
_MOVES_M_S = 0.5  # Chodosh et al., WACV 2024: a point is dynamic from here
_NUM_CARRIED = 3
_SEED = 0
_SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Pair:
    """Two clouds in one frame, and what the slow methods see of them.

    source, target: (n,3), (m,3) above the ground. drawn, target_drawn: their rows that are drawn.
    duration_s: from source to target, negative if backwards.
    """

    source: Float
    target: Float
    drawn: Int
    target_drawn: Int
    duration_s: float

    @cached_property
    def _laplacian(self) -> csr_array:
        return laplacian(knn_graph(self.source[self.drawn], _NUM_NEIGHBORS))

    def energy(self, flow: Float) -> float:
        """The paper's E (m²) of the flow (n,3) at the drawn points; the definition, without the
        solvers' code."""
        drawn, goal = flow[self.drawn], self.target[self.target_drawn]
        moved = self.source[self.drawn] + drawn
        forward_m, _ = cKDTree(goal).query(moved, workers=-1)
        backward_m, _ = cKDTree(moved).query(goal, workers=-1)
        smoothness = np.sum(drawn * (self._laplacian @ drawn))
        return float(np.sum(forward_m**2) + np.sum(backward_m**2) + _ALPHA * smoothness)

    def carried(self, drawn_flow: Float) -> Float:
        """(n,3) from the flow of the drawn points: each takes that of the nearest three, weighed by
        inverse distance."""
        at = self.source[self.drawn]
        k = min(_NUM_CARRIED, len(at))
        distance_m, near = cKDTree(at).query(self.source, list(range(1, k + 1)), workers=-1)
        weight = 1 / (np.asarray(distance_m) + 1e-6)
        weight /= weight.sum(axis=1, keepdims=True)
        return np.einsum("nk,nkj->nj", weight, drawn_flow[near])


class Motion(NamedTuple):
    """A method's flow (n,3) of a pair's source, who is said to move (n,), and Adam's energies."""

    flow: Float
    moving: Bool
    energies: tuple[float, ...] = ()


class _Measured(NamedTuple):
    """row: what is told of a method. energies, seconds: per pair. traces: Adam's energy before each
    step and after the last, per pair."""

    row: dict[str, Any]
    energies: list[float]
    seconds: list[float]
    traces: list[tuple[float, ...]]


@dataclass
class _Cost:
    """Seconds per pair, and the highest rise of resident memory, None where it cannot be known."""

    seconds: list[float] = field(default_factory=list)
    memory_mb: list[float | None] = field(default_factory=list)

    def of(self, work: Callable[[], Any]) -> Any:
        memory = PeakMemory.start()
        start = time.perf_counter()
        result = work()
        self.seconds.append(time.perf_counter() - start)
        self.memory_mb.append(memory.rise_mb())
        return result

    def peak_mb(self) -> float | None:
        known = [m for m in self.memory_mb if m is not None]
        return max(known) if known else None


def bench_flow(
    sequence: LidarSequence,
    key: int,
    window: int,
    config: Config,
    methods: Sequence[str] = DEFAULT_METHODS,
    pairs_only: bool = False,
    max_points: int = DEFAULT_MAX_POINTS,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run and measure; plain numbers ready for JSON, None where nothing can be said.

    window: sweeps on each side of the key. methods: of `METHODS`. pairs_only: one pair, the key's
    earlier neighbour (the later where there is none) to the key, and nothing accumulated.
    max_points: of each cloud for the slow methods; 0 for all. Errors need ``sequence.truth``.

    Raises InputError for unknown methods, a window without neighbours, or missing frames.
    """
    _check(methods, window, max_points)
    report = progress or (lambda stage, done, total: None)
    report("register", 0, 1)
    registered = open_window(sequence, key, window, config)
    if len(registered.sweeps) < 2:
        raise InputError(f"--key {key}: no neighbour in {sequence.name}; choose another key")
    heights_m = heights_above_ground(registered, config)
    above = tuple(h >= config.flow.min_height_m for h in heights_m)
    pairs = _pairs(registered, above, max_points)
    if pairs_only:
        first = max(i for i in pairs if i <= max(min(pairs), _key_row(registered) - 1))
        pairs = {first: pairs[first]}
    scorer = Scorer.of(sequence, registered, above, tuple(pairs))
    measured: dict[str, _Measured] = {}
    chosen = [name for name in METHODS if name in methods]
    for done, method in enumerate(chosen):
        report(method, done, len(chosen))
        measured[method] = _measure(method, registered, above, pairs, scorer, config, pairs_only)
    report("done", 1, 1)
    return {
        "schema_version": _SCHEMA_VERSION,
        "data": sequence.name,
        "key": key,
        "frames": list(registered.frames),
        "num_pairs": len(pairs),
        "points_above_ground": int(np.mean([len(p.source) for p in pairs.values()])),
        "max_points": max_points,
        "truth": None if pairs_only else scorer.truth_scores(),
        "methods": _finished(measured),
    }


def _check(methods: Sequence[str], window: int, max_points: int) -> None:
    for method in methods:
        if method not in METHODS:
            raise InputError(f"--methods {method}: expected all, or of {', '.join(METHODS)}")
    if not methods:
        raise InputError(f"--methods: got none, expected all, or of {', '.join(METHODS)}")
    if window < 1:
        raise InputError(f"--window {window}: expected at least 1 sweep on each side of the key")
    if 0 < max_points < _NUM_NEIGHBORS or max_points < 0:
        raise InputError(
            f"--max-points {max_points}: expected 0 for all, or at least {_NUM_NEIGHBORS}"
        )


def _key_row(window: Window) -> int:
    return window.frames.index(window.key)


def _pairs(window: Window, above: Sequence[Bool], max_points: int) -> dict[int, Pair]:
    """By number of the source sweep, each with its neighbour towards the key."""
    key = _key_row(window)
    clouds = [
        poses.transform(s.T_key_lidar, s.sweep.points[a])
        for s, a in zip(window.sweeps, above, strict=True)
    ]
    rng = np.random.default_rng(_SEED)
    drawn = []
    for cloud, sweep in zip(clouds, window.sweeps, strict=True):
        if len(cloud) <= _NUM_NEIGHBORS:
            raise InputError(
                f"frame {sweep.frame}: {len(cloud)} points stand above the ground, expected more "
                f"than {_NUM_NEIGHBORS}; choose another key"
            )
        count = len(cloud) if max_points == 0 else min(max_points, len(cloud))
        drawn.append(np.sort(rng.permutation(len(cloud))[:count]))
    pairs = {}
    for i in range(len(clouds)):
        if i != key:
            j = i + int(np.sign(key - i))
            late_ns = window.sweeps[j].sweep.stamp_ns - window.sweeps[i].sweep.stamp_ns
            pairs[i] = Pair(clouds[i], clouds[j], drawn[i], drawn[j], late_ns * 1e-9)
    return pairs


def _measure(
    method: str,
    window: Window,
    above: Sequence[Bool],
    pairs: dict[int, Pair],
    scorer: Scorer,
    config: Config,
    pairs_only: bool,
) -> _Measured:
    """One method on all pairs."""
    cost = _Cost()
    traces: list[tuple[float, ...]] = []
    if method == OURS:
        flow = cost.of(lambda: engine_flow(window, config))
        cost.seconds = [cost.seconds[0] / len(window.sweeps)]
        num_points = int(np.mean([len(s.sweep) for s in window.sweeps]))
    else:
        steps = [FlowField.zero(len(s.sweep)) for s in window.sweeps]
        for i, pair in pairs.items():
            motion = cost.of(partial(_move, method, pair, config))
            traces.append(motion.energies)
            steps[i] = _as_field(motion, above[i], window, i, pair.duration_s)
        flow = WindowFlow(tuple(steps), ()) if pairs_only else chained(window, steps, config)
        sizes = [len(p.drawn if method in _SLOW else p.source) for p in pairs.values()]
        num_points = int(np.mean(sizes))
    before, after = [], []
    for i, pair in pairs.items():
        into_key = window.sweeps[i].T_key_lidar[:3, :3].T
        before.append(pair.energy(np.zeros_like(pair.source)))
        after.append(pair.energy(flow.steps[i].displacement[above[i]] @ into_key))
    row = {
        "about": METHODS[method],
        "num_points": num_points,
        "seconds_per_pair": float(np.mean(cost.seconds)),
        "peak_memory_mb": cost.peak_mb(),
        "energy_before": float(np.mean(before)),
        "energy_after": float(np.mean(after)),
        "step": scorer.step_scores(flow.steps),
        "window": None if pairs_only else scorer.window_scores(flow.to_key),
    }
    return _Measured(row, after, cost.seconds, traces)


def _move(method: str, pair: Pair, config: Config) -> Motion:
    """One method of two clouds on one pair."""
    if method == "pair":
        found = estimate_flow(pair.source, pair.target, config)
        return Motion(found.displacement, found.moving)
    energies: tuple[float, ...] = ()
    if method == "rigid":
        flow = np.zeros_like(pair.source)
    elif method == "cluster-icp":
        flow = cluster_icp(pair.source, pair.target)
    else:
        source = pair.source[pair.drawn]
        if method == "nicp":
            drawn_flow = nonrigid_icp(source, pair.target)
        else:
            target = pair.target[pair.target_drawn]
            solver = "pcg" if method == "paper" else "adam"
            solution = solve(source, target, ObjectiveSettings(solver=solver))
            drawn_flow = solution.flow
            energies = solution.energies if method == "adam" else ()
        flow = pair.carried(drawn_flow)
    moving = np.linalg.norm(flow, axis=1) >= _MOVES_M_S * abs(pair.duration_s)
    return Motion(flow, moving, energies)


def _as_field(motion: Motion, above: Bool, window: Window, i: int, duration_s: float) -> FlowField:
    """Flow of a whole sweep in its lidar frame; the ground stands still."""
    registered = window.sweeps[i]
    field = FlowField.zero(len(above))
    field.displacement[above] = motion.flow @ registered.T_key_lidar[:3, :3]
    field.moving[above] = motion.moving
    offset_ns = registered.sweep.offset_ns
    if offset_ns is None:
        return field
    late = -offset_ns[:, None] * 1e-9 / duration_s
    return replace(field, to_reference=late * field.displacement)


def _finished(measured: dict[str, _Measured]) -> dict[str, dict[str, Any]]:
    """With seconds and movers' error as multiples of ours, where ours ran, and when Adam was
    where."""
    if "adam" in measured:
        measured["adam"].row.update(_milestones(measured["adam"], measured.get("paper")))
    rows = {method: m.row for method, m in measured.items()}
    if OURS in rows:
        ours = rows[OURS]
        for row in rows.values():
            row["times_seconds"] = row["seconds_per_pair"] / ours["seconds_per_pair"]
            mine, other = ours["step"].get("movers_m"), row["step"].get("movers_m")
            row["times_error"] = other / mine if mine and other is not None else None
    return rows


def _milestones(adam: _Measured, paper: _Measured | None) -> dict[str, Any]:
    """Means over the pairs: steps and seconds until Adam's lowest energy, and seconds until it
    first comes as low as conjugate gradients end, over the pairs where it does. A step's time is
    the mean of the run's, the graph's included."""
    lowest = [int(np.argmin(trace)) for trace in adam.traces]
    step_s = [s / (len(trace) - 1) for s, trace in zip(adam.seconds, adam.traces, strict=True)]
    milestones: dict[str, Any] = {
        "steps_to_lowest": float(np.mean(lowest)),
        "seconds_to_lowest": float(np.multiply(lowest, step_s).mean()),
    }
    if paper is not None:
        goals = zip(adam.traces, paper.energies, step_s, strict=True)
        there = [(np.flatnonzero(np.array(trace) <= goal), s) for trace, goal, s in goals]
        seconds = [float(steps[0] * s) for steps, s in there if len(steps)]
        milestones["seconds_to_paper"] = float(np.mean(seconds)) if seconds else None
        milestones["pairs_as_low_as_paper"] = len(seconds)
    return milestones
