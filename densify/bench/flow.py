# SPDX-License-Identifier: MIT
"""``densify bench flow``: engines of scene flow on the same windows, in one process.

Errors are over the points above the ground of all sweeps of the window together, each with the flow
to its neighbour towards the key. Seconds are per pair of sweeps, from the ground to the flow to the
key; registration does not count, nor what is compiled when first used.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from densify.bench.scoring import Scorer, Window
from densify.config import Config, as_mapping, resolve
from densify.config.errors import InputError
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.geometry import poses
from densify.geometry.types import FlowField, LidarSequence, Progress, Stretch
from densify.pipeline.recording import Recording

_PAPER = ("flow.engine=paper", "objective.static_prior=false")
METHODS: Mapping[str, tuple[str, ...] | None] = {
    "ours": (),
    "ours-pair": ("flow.engine=pairs",),
    "paper": (*_PAPER, "objective.solver=pcg"),
    "paper-adam": (*_PAPER, "objective.solver=adam"),
    "rigid": None,
}
"""Changes of the configuration; None: nothing moves."""
DEFAULT_METHODS = tuple(name for name in METHODS if name != "paper-adam")


def bench_flow(
    sequence: LidarSequence,
    key: int,
    window: int,
    config: Config,
    methods: Sequence[str] = DEFAULT_METHODS,
    progress: Progress | None = None,
    truth: Path | None = None,
) -> dict[str, Any]:
    """Run and measure methods; plain numbers ready for JSON, None where nothing is known.

    window: sweeps on each side of the key.
    methods: names of `METHODS`; ``ours`` is the engine of the configuration.
    truth: a place of true flow, see `densify.readers.true_flow`; then only the pairs before the key
        are scored. None for the exact truth of the sequence, where it has one.

    Returns ``methods`` by name, each with ``seconds_per_pair`` and the scores of
    `densify.bench.scoring`: ``step``, ``challenge``, ``window``.
    Raises InputError for unknown methods, a window without neighbours, or missing frames.
    """
    unknown = [method for method in methods if method not in METHODS]
    if unknown or not methods:
        raise InputError(
            f"--methods: got {unknown[0] if unknown else 'none'}, expected {', '.join(METHODS)}"
        )
    opened = open_window(sequence, key, window, config)
    here = opened.frames.index(key)
    if len(opened.frames) < 2 or (truth is not None and here == 0):
        raise InputError(f"--key {key}: no pair to score in {sequence.name}; choose another key")
    others = tuple(frame for frame in opened.frames if frame != key)
    scored = others if truth is None else opened.frames[:here]
    scorer = Scorer.of(sequence, opened, scored, truth)
    rows = {}
    chosen = [name for name in METHODS if name in methods]
    for done, method in enumerate(chosen):
        if progress is not None:
            progress(method, done, len(chosen))
        steps, to_key, seconds = _flows(method, opened, config)
        rows[method] = {
            "seconds_per_pair": seconds / len(others),
            "step": scorer.step_scores(steps),
            "challenge": scorer.challenge_scores(steps),
            "window": scorer.window_scores(to_key),
        }
    facts = {"data": sequence.name, "key": key, "frames": list(opened.frames)}
    return {**facts, "num_pairs": len(scored), "methods": rows}


def open_window(sequence: LidarSequence, key: int, size: int, config: Config) -> Window:
    """Return the key's registered window. Raises InputError for a missing key, ComputationError
    where registration went wrong."""
    recording = Recording(sequence, config, size, [key], looks_around=True)
    stretch = recording.window(key)
    heights = ground(stretch)
    above = {}
    for registered in stretch.sweeps:
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        above[registered.sweep.frame] = heights.above(points) >= ABOVE_GROUND_M
    return Window(stretch, key, recording.around(key), above)


def _flows(
    method: str, window: Window, config: Config
) -> tuple[dict[int, FlowField], dict[int, FlowField], float]:
    """Return the flow to the neighbour and to the key, by frame, and the seconds."""
    changes, frames = METHODS[method], window.frames
    if changes is None:
        still = {f: FlowField.zero(len(window.stretch[f].sweep)) for f in frames}
        return still, still, 0.0
    config = resolve(as_mapping(config), changes)
    if method == "ours":  # what is compiled must not count
        here = frames.index(window.key)
        _motion(Stretch(window.stretch.sweeps[max(0, here - 1) : here + 2]), config)
    start = time.perf_counter()
    motion = _motion(window.around if method == "ours" else window.stretch, config, frames)
    steps = {f: motion.flow(f, window.towards_key(f)) for f in frames if f != window.key}
    to_key = {f: motion.flow(f, window.key) for f in frames}
    return steps, to_key, time.perf_counter() - start


def _motion(stretch: Stretch, config: Config, asked: Sequence[int] | None = None) -> Any:
    heights = ground(stretch)
    return estimate_motion(Scene(stretch, heights, asked=asked), config)
