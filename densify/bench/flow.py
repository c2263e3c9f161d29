# SPDX-License-Identifier: MIT
"""``densify bench flow``: scene flow methods on the same pairs and windows, in one process.

The pairs of a window are its sweeps and their neighbours towards the key, brought into one frame by
registration. ``ours`` gets the window, ``ours-pair`` both sweeps of a pair, the other methods of
two clouds the points above the ground of both. The objective and non-rigid ICP are slow: they move
at most ``max_points`` points, drawn at random, and their flow is carried to the other points from
the nearest three. The objective, which matches both ways, sees as many of the target, non-rigid ICP
all of it. The energy is always that of the paper's objective on the drawn points of both.

Seconds are per pair: those of ``ours`` are its whole time, from the ground to the flow to the key,
with the sweeps around the window that it looks at, over the number of the window's. Registration
counts for none, nor does what is compiled when first used.
Errors are over the points above the ground of all pairs together; those of the Argoverse 2
challenges as `densify.scores.challenge` says, with our ground left out.

Firing times within a sweep are used for every method: a point moves by its own flow between the
moment it was measured and the sweep's reference time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.bench.memory import PeakMemory
from densify.bench.pairs import NUM_NEIGHBORS, Pair, Trace, flow_of_pair, pairs_of
from densify.bench.scoring import Scorer
from densify.bench.windows import Window, our_motion
from densify.config import Config
from densify.config.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.flow.objective.solvers import solve
from densify.geometry.types import FlowField, LidarSequence, Motion, Progress

OURS, OURS_PAIR, PAPER, ADAM = "ours", "ours-pair", "paper", "paper-adam"
METHODS = {
    OURS: "this package's engine on the whole window, all points",
    OURS_PAIR: "this package on two sweeps",
    PAPER: "the paper's objective, conjugate gradients",
    ADAM: "the paper's objective, Adam, 1,500 steps, the best of them kept",
    "rigid": "nothing moves",
    "cluster-icp": "rigid ICP per cluster",
    "nicp": "non-rigid ICP, locally affine",
}
DEFAULT_METHODS = tuple(name for name in METHODS if name != ADAM)
DEFAULT_MAX_POINTS = 8000

_DRAWN = (PAPER, ADAM, "nicp")
_WHOLE_SWEEPS = (OURS, OURS_PAIR)
_SCHEMA_VERSION = 1


class _Measured(NamedTuple):
    """row: what is told of a method. traces: of a solver of the objective, per pair."""

    row: dict[str, Any]
    traces: list[Trace]


@dataclass
class _Cost:
    """Seconds of each call, and the highest rise of resident memory, None where it cannot be
    known."""

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
    truth: Path | None = None,
) -> dict[str, Any]:
    """Run and measure; plain numbers ready for JSON, None where nothing can be said.

    window: sweeps on each side of the key. methods: of `METHODS`. pairs_only: one pair, the key's
    earlier neighbour (the later where there is none) to the key, and nothing accumulated.
    max_points: of each cloud for the slow methods; 0 for all. truth: a place of true flow, see
    `densify.readers.true_flow`, which leads forwards only: then the pairs are those before the key.
    Errors need that, or ``sequence.truth``.

    Raises InputError for unknown methods, a window without neighbours, or missing frames.
    """
    _check(methods, window, max_points)
    report = progress or (lambda stage, done, total: None)
    report("register", 0, 1)
    opened = Window.open(sequence, key, window, config)
    if len(opened.frames) < 2:
        raise InputError(f"--key {key}: no neighbour in {sequence.name}; choose another key")
    pairs = pairs_of(opened, max_points)
    scored = _scored_frames(opened.frames, key, pairs_only, truth is not None)
    pairs = {f: pair for f, pair in pairs.items() if f in scored}
    scorer = Scorer.of(sequence, opened, tuple(pairs), truth)
    measured: dict[str, _Measured] = {}
    chosen = [name for name in METHODS if name in methods]
    for done, method in enumerate(chosen):
        report(method, done, len(chosen))
        measured[method] = _measure(method, opened, pairs, scorer, config, pairs_only)
    report("done", 1, 1)
    return {
        "schema_version": _SCHEMA_VERSION,
        "data": sequence.name,
        "key": key,
        "frames": list(opened.frames),
        "num_pairs": len(pairs),
        "points_above_ground": int(np.mean([len(p.source) for p in pairs.values()])),
        "max_points": max_points,
        "truth": None if pairs_only else scorer.truth_scores(),
        "methods": _finished(measured),
    }


def _scored_frames(
    frames: Sequence[int], key: int, pairs_only: bool, forwards: bool
) -> Sequence[int]:
    """Those whose pairs with the key are scored. forwards: only those before the key."""
    here = frames.index(key)
    if forwards and here == 0:
        raise InputError(
            f"--key {key}: no sweep before it, whose flow --truth could tell; choose another"
        )
    if pairs_only:
        return [frames[here - 1 if here else 1]]
    return frames[:here] if forwards else frames


def _check(methods: Sequence[str], window: int, max_points: int) -> None:
    for method in methods:
        if method not in METHODS:
            raise InputError(f"--methods {method}: expected all, or of {', '.join(METHODS)}")
    if not methods:
        raise InputError(f"--methods: got none, expected all, or of {', '.join(METHODS)}")
    if window < 1:
        raise InputError(f"--window {window}: expected at least 1 sweep on each side of the key")
    if 0 < max_points < NUM_NEIGHBORS or max_points < 0:
        raise InputError(
            f"--max-points {max_points}: expected 0 for all, or at least {NUM_NEIGHBORS}"
        )


def _measure(
    method: str,
    window: Window,
    pairs: Mapping[int, Pair],
    scorer: Scorer,
    config: Config,
    pairs_only: bool,
) -> _Measured:
    """One method on all pairs."""
    _warm_up(method, window, next(iter(pairs.values())), config)
    cost = _Cost()
    traces: list[Trace] = []
    if method == OURS:
        motion, to_key = cost.of(lambda: _ours(window, config))
        steps = {f: motion.flow(f, window.towards_key(f)) for f in pairs}
        seconds = cost.seconds[0] / len(window.frames)
    else:
        steps = {}
        for frame, pair in pairs.items():
            steps[frame], trace = cost.of(partial(flow_of_pair, method, pair, config))
            traces += [] if trace is None else [trace]
        to_key = {} if pairs_only else _chained(window, steps, config)
        seconds = float(np.mean(cost.seconds))
    before, after = [], []
    for frame, pair in pairs.items():
        R_world_lidar = window.stretch[frame].T_world_lidar[:3, :3]
        flow = steps[frame].displacement[window.above[frame]] @ R_world_lidar.T
        before.append(pair.energy(np.zeros_like(pair.source)))
        after.append(pair.energy(flow))
    row = {
        "about": METHODS[method],
        "num_points": _num_points(method, pairs),
        "seconds_per_pair": seconds,
        "peak_memory_mb": cost.peak_mb(),
        "energy_before": float(np.mean(before)),
        "energy_after": float(np.mean(after)),
        "step": scorer.step_scores(steps),
        "challenge": scorer.challenge_scores(steps),
        "segmentation": scorer.segmentation_scores(steps),
        "worst_object": scorer.worst_object(steps),
        "window": None if pairs_only else scorer.window_scores(to_key),
    }
    return _Measured(row, traces)


def _warm_up(method: str, window: Window, pair: Pair, config: Config) -> None:
    """What is compiled when it is first used must not count."""
    if method == OURS:
        our_motion(window.around_key(), config)
    elif method == OURS_PAIR:
        flow_of_pair(method, pair, config)
    elif method in (PAPER, ADAM):
        few = NUM_NEIGHBORS + 1
        solve(pair.source[:few], pair.target[:few])


def _ours(window: Window, config: Config) -> tuple[Motion, dict[int, FlowField]]:
    """The motion of our engine, and its flow to the key by frame."""
    motion = our_motion(window.around, config, window.frames)
    return motion, {f: motion.flow(f, window.key) for f in window.frames}


def _chained(
    window: Window, steps: Mapping[int, FlowField], config: Config
) -> dict[int, FlowField]:
    """Flow to the key, by frame, of any method's steps."""
    frames = window.frames
    chained = ChainedMotion(
        window.stretch,
        lambda here, there: steps[frames[here]],
    )
    still = FlowField.zero(len(window.stretch[window.key].sweep))
    return {f: still if f == window.key else chained.flow(f, window.key) for f in frames}


def _num_points(method: str, pairs: Mapping[int, Pair]) -> int:
    """That it moves, on average."""
    if method in _WHOLE_SWEEPS:
        sizes = [len(pair.here.points) for pair in pairs.values()]
    else:
        sizes = [len(p.drawn if method in _DRAWN else p.source) for p in pairs.values()]
    return int(np.mean(sizes))


def _finished(measured: Mapping[str, _Measured]) -> dict[str, dict[str, Any]]:
    """The rows with seconds and movers' error as multiples of ours, where ours ran, and when the
    solvers of the objective were how low."""
    rows = {method: m.row for method, m in measured.items()}
    if ADAM in measured:
        adam = measured[ADAM].traces
        rows[ADAM]["solver"] = _milestones(adam)
        if PAPER in measured:
            paper = measured[PAPER].traces
            rows[ADAM]["solver"] |= _as_low(adam, paper)
            rows[PAPER]["solver"] = _milestones(paper) | _as_low(paper, adam)
    if OURS in rows:
        ours = rows[OURS]
        for row in rows.values():
            row["times_seconds"] = row["seconds_per_pair"] / ours["seconds_per_pair"]
            mine, other = ours["step"].get("movers_m"), row["step"].get("movers_m")
            row["times_error"] = other / mine if mine and other is not None else None
    return rows


def _milestones(traces: Sequence[Trace]) -> dict[str, Any]:
    """Means over the pairs: steps and seconds until the lowest energy and until the end, the
    graph's seconds included."""
    lowest = [int(np.argmin(trace.energies)) for trace in traces]
    seconds = [trace.seconds[i] for trace, i in zip(traces, lowest, strict=True)]
    return {
        "steps": float(np.mean([len(trace.energies) - 1 for trace in traces])),
        "seconds": float(np.mean([trace.seconds[-1] for trace in traces])),
        "lowest_energy": float(np.mean([min(trace.energies) for trace in traces])),
        "steps_to_lowest": float(np.mean(lowest)),
        "seconds_to_lowest": float(np.mean(seconds)),
    }


def _as_low(traces: Sequence[Trace], others: Sequence[Trace]) -> dict[str, Any]:
    """Seconds until the energy is first as low as the other solver's lowest: mean over the pairs
    where it comes so low, None if there is none, and their number."""
    seconds = []
    for trace, other in zip(traces, others, strict=True):
        there = np.flatnonzero(np.array(trace.energies) <= min(other.energies))
        seconds += [trace.seconds[i] for i in there[:1]]
    return {
        "seconds_to_others_lowest": float(np.mean(seconds)) if seconds else None,
        "pairs_as_low_as_other": len(seconds),
    }
