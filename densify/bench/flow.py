# SPDX-License-Identifier: MIT
"""Compare methods of scene flow on the same window of sweeps: ``densify bench flow``.

Errors are those of the flow to the neighbouring sweep towards the key sweep, pooled over the points
above the ground in all sweeps. Seconds per pair of sweeps cover ground estimation, this flow and
the flow to the key sweep, without registration and compilation.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config import Config, as_mapping, resolve
from densify.config.errors import InputError
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, LidarSequence, Progress, Stretch, Truth
from densify.pipeline.accumulate import accumulate
from densify.pipeline.recording import Recording
from densify.readers.flow_files import LabelledFlow, labelled_flow
from densify.scores.challenge import CLASSES, ChallengeScorer
from densify.scores.cloud_scores import ghost_rate
from densify.scores.flow_metrics import end_point_error, end_point_errors, mean_of

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5


@dataclass(frozen=True)
class Window:
    """Consecutive registered sweeps around a key sweep."""

    stretch: Stretch
    key: int  # frame number of the key sweep
    around: Stretch  # sweeps from which the configured method estimates motion
    above: Mapping[int, Bool]  # frame number -> (N,) mask of points above the ground

    @property
    def frames(self) -> tuple[int, ...]:
        """The frame numbers of the window, ascending."""
        return self.stretch.frames

    def hops(self, frame: int) -> int:
        """Return the number of sweeps from ``frame`` to the key sweep, negative for later ones."""
        return self.frames.index(self.key) - self.frames.index(frame)

    def towards_key(self, frame: int) -> int:
        """Return the next frame number towards the key sweep, or the key sweep's own."""
        return self.frames[self.frames.index(frame) + int(np.sign(self.hops(frame)))]


class SweepTruth(NamedTuple):
    """The ground truth of the N points of a sweep: scene flow in metres without ego-motion.

    Flow starts at the sweep's reference time and is in the lidar frame of that time.
    """

    step: Float  # (N,3) flow to the neighbouring sweep towards the key sweep
    to_key: Float  # (N,3) flow to the key sweep
    moving: Bool  # (N,) bool, True for points that move at the reference time
    foreground: Bool  # (N,) bool, True for points of objects, moving or not
    # (N,) bool, True for moving points that travel at least 0.5 m over the window and belong to an
    # object with 30 returns or more
    certain: Bool

    @staticmethod
    def of(truth: Truth, window: Window, frame: int) -> SweepTruth:
        """Gather the exact ground truth of the sweep ``frame`` (its number) of the window."""
        rows = window.stretch[frame].sweep.row
        targets = window.towards_key(frame), window.key, window.frames[0], window.frames[-1]
        step, to_key, first, last = (truth.displacement(frame, t)[rows] for t in targets)
        whole = truth.sweep(frame)
        moving, instance = whole.moving[rows], whole.instance[rows]
        num_returns = np.bincount(instance[instance >= 0], minlength=instance.max(initial=-1) + 2)
        many = (instance >= 0) & (num_returns[instance] >= _MIN_RETURNS)
        far = np.linalg.norm(last - first, axis=1) >= _LEAST_MOTION_M
        return SweepTruth(step, to_key, moving, instance >= 0, moving & many & far)


@dataclass(frozen=True)
class Scorer:
    """Scorer of methods on a window, mostly by points above the ground, which no method moves."""

    window: Window
    sources: tuple[int, ...]  # frame numbers of the sweeps whose flow to a neighbour is scored
    # Frame number -> exact ground truth, None for a real recording
    truths: Mapping[int, SweepTruth] | None
    # Frame number -> labelled flow to the neighbour, {} without ground truth
    labels: Mapping[int, LabelledFlow]

    @staticmethod
    def of(
        sequence: LidarSequence, window: Window, sources: tuple[int, ...], place: Path | None = None
    ) -> Scorer:
        """Return the scorer of a window that scores the sweeps ``sources`` (frame numbers).

        ``place``: folder of true flow (`densify.readers.flow_files`); None for exact truth, if any.
        """
        truths, labels = None, {}
        if sequence.truth is not None:
            truths = {f: SweepTruth.of(sequence.truth, window, f) for f in window.frames}
            for frame in sources:
                classes = np.where(truths[frame].foreground, CLASSES.index("OBJECT"), 0)
                valid = np.ones(len(classes), bool)
                labels[frame] = LabelledFlow(truths[frame].step, classes.astype(np.uint8), valid)
        if place is not None:
            labels = {f: labelled_flow(place, sequence.name, window.stretch, f) for f in sources}
        return Scorer(window, sources, truths, labels)

    def challenge_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any] | None:
        """Return the Argoverse 2 challenges' pooled scores, None without ground truth.

        ``steps`` is frame number -> flow to the neighbour towards the key sweep. The result has
        ``three_way`` and ``bucketed`` errors and ``num_points``.
        """
        if not self.labels:
            return None
        scorer = ChallengeScorer()
        for frame, label in self.labels.items():
            counted = self.window.above[frame] & label.valid
            points = self.window.stretch[frame].sweep.points
            flow = steps[frame].displacement[counted]
            scorer.add(points[counted], flow, label.flow[counted], label.classes[counted])
        scores = scorer.scores()
        buckets = {**scores.by_class, "MEAN": scores.mean}
        return {
            "three_way": _plainly(scores.three_way._asdict()),
            "bucketed": {name: _plainly(error._asdict()) for name, error in buckets.items()},
            "num_points": scores.num_points,
        }

    def step_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any]:
        """Return the scores of the flow to the neighbouring sweep, pooled over the sources.

        ``found`` is the share of ``certain`` moving points that are called moving,
        ``falsely_moving`` that of static points, ground included. End-point errors in metres are
        ``movers_m`` of moving points and ``found_movers_m`` of those called moving. Without ground
        truth, ``called_moving`` is the share of all points called moving.
        """
        truths = self.truths
        if truths is None:
            moving = np.concatenate([steps[f].moving for f in self.sources])
            return {"called_moving": float(moving.mean())}
        flow = self._above(lambda f: steps[f].displacement)
        true = self._above(lambda f: truths[f].step)
        moving = self._above(lambda f: truths[f].moving)
        objects = self._above(lambda f: truths[f].foreground)
        called = self._above(lambda f: steps[f].moving)
        certain = self._above(lambda f: truths[f].certain)
        static = np.concatenate([steps[f].moving[~truths[f].moving] for f in self.sources])
        scores = {
            "movers_m": end_point_error(flow, true, objects & moving),
            "found_movers_m": end_point_error(flow, true, moving & called),
            "static_objects_m": end_point_error(flow, true, objects & ~moving),
            "background_m": end_point_error(flow, true, ~objects & ~moving),
            "found": mean_of(called[certain]),
            "falsely_moving": mean_of(static),
        }
        return {"num_movers": int(moving.sum()), **_plainly(scores)}

    def window_scores(self, to_key: Mapping[int, FlowField]) -> dict[str, Any]:
        """Return the scores of the flow to the key sweep: ghost rate and errors of moving points.

        Given ground truth, end-point errors in metres of points above the ground, by number of
        sweeps to the key: ``movers_m_by_hops`` of moving points, ``found_movers_m_by_hops`` of
        those called moving.
        """
        stretch, key = self.window.stretch, self.window.key
        cloud = accumulate(stretch, [to_key[f] for f in stretch.frames], key, drop_lost=True)
        scores: dict[str, Any] = {"ghost_rate": ghost_rate(cloud, RangeImage.of(stretch[key]), key)}
        if self.truths is None:
            return scores
        errors_m: dict[str, list[Float]] = defaultdict(list)
        found_m: dict[str, list[Float]] = defaultdict(list)
        for frame, truth in self.truths.items():
            if frame != key:
                field, hops = to_key[frame], str(abs(self.window.hops(frame)))
                kept = truth.moving & self.window.above[frame] & ~field.lost
                error_m = end_point_errors(field.displacement, truth.to_key)
                errors_m[hops].append(error_m[kept])
                found_m[hops].append(error_m[kept & field.moving])
        for name, by_hops in (("movers", errors_m), ("found_movers", found_m)):
            means = {hops: mean_of(np.concatenate(by_hops[hops])) for hops in sorted(by_hops)}
            scores[f"{name}_m_by_hops"] = _plainly(means)
        return scores

    def _above(self, column: Callable[[int], Any]) -> Any:
        """Return values of points above the ground; ``column`` maps frame number -> (N,) values."""
        return np.concatenate([column(f)[self.window.above[f]] for f in self.sources])


def _plainly(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else value for name, value in values.items()}


_PAPER = ("flow.engine=paper", "objective.static_prior=false")
METHODS: Mapping[str, tuple[str, ...] | None] = {
    "ours": (),
    "ours-pair": ("flow.engine=pairs",),
    "paper": (*_PAPER, "objective.solver=pcg"),
    "paper-adam": (*_PAPER, "objective.solver=adam"),
    "rigid": None,
}
"""Name of a method -> changes of the configuration. None: all points are static."""
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
    """Run and measure methods of scene flow. The result has plain numbers, None if unknown.

    Args:
        window: Number of sweeps on each side of the key sweep.
        methods: Names in `METHODS`. ``ours`` is the configured engine.
        truth: Folder of true flow (`densify.readers.flow_files`), which scores only the sweeps
            before the key sweep. None for the exact ground truth of the recording.

    Returns:
        ``data``, ``key``, ``frames``, ``num_pairs``, and ``methods``: name -> ``seconds_per_pair``
            and the scores ``step``, ``challenge``, ``window`` of `Scorer`.
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
    """Return the registered window of a key sweep, with ``size`` sweeps on each side."""
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
    """Return flow to the neighbour towards the key and flow to the key, by frame, and seconds."""
    changes, frames = METHODS[method], window.frames
    if changes is None:
        still = {f: FlowField.zero(len(window.stretch[f].sweep)) for f in frames}
        return still, still, 0.0
    config = resolve(as_mapping(config), changes)
    if method == "ours":  # compile before the clock starts
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
