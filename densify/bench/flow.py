# SPDX-License-Identifier: MIT
"""Compare engines of scene flow on the same windows: ``densify bench flow``.

Errors are over the points above the ground of all sweeps of the window together, each with the flow
to its neighbour towards the key. Seconds are per pair of sweeps, from the ground to the flow to the
key. Registration does not count, nor the compilation at the first use. Scores are against the truth
if there is one, and without.
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
from densify.depth.accumulate import accumulate
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, LidarSequence, Progress, Stretch, Truth
from densify.pipeline.recording import Recording
from densify.readers.flow_files import LabelledFlow, labelled_flow
from densify.scores.challenge import CLASSES, ChallengeScorer
from densify.scores.cloud_scores import ghost_rate
from densify.scores.flow_metrics import end_point_error, end_point_errors, mean_of

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5


@dataclass(frozen=True)
class Window:
    """Consecutive registered sweeps around a key.

    Attributes:
        around: Sweeps from which our engine takes the motion.
        above: By frame (N,), above the ground.
    """

    stretch: Stretch
    key: int
    around: Stretch
    above: Mapping[int, Bool]

    @property
    def frames(self) -> tuple[int, ...]:
        """The frame numbers, ascending."""
        return self.stretch.frames

    def hops(self, frame: int) -> int:
        """Return the number of sweeps from the frame to the key, negative for frames after it."""
        return self.frames.index(self.key) - self.frames.index(frame)

    def towards_key(self, frame: int) -> int:
        """Return the neighbour on the way to the key. For the key it is the key itself."""
        return self.frames[self.frames.index(frame) + int(np.sign(self.hops(frame)))]


class SweepTruth(NamedTuple):
    """The truth of the N points of one sweep, in its own lidar frame.

    Attributes:
        step: (N,3) flow to the neighbour towards the key.
        to_key: (N,3) flow to the key.
        moving: (N,) moves now.
        foreground: (N,) belongs to an object.
        certain: (N,) moves, at least 0.5 m over the window, on an object of 30 returns.
    """

    step: Float
    to_key: Float
    moving: Bool
    foreground: Bool
    certain: Bool

    @staticmethod
    def of(truth: Truth, window: Window, frame: int) -> SweepTruth:
        """Return the truth of a sweep of the window."""
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
    """The scores of methods on one window.

    Errors are over the points above the ground, because no method moves the ground.

    Attributes:
        sources: Frames whose step is scored.
        truths: By frame, None without exact truth.
        labels: Of the steps of the sources, none without truth.
    """

    window: Window
    sources: tuple[int, ...]
    truths: Mapping[int, SweepTruth] | None
    labels: Mapping[int, LabelledFlow]

    @staticmethod
    def of(
        sequence: LidarSequence, window: Window, sources: tuple[int, ...], place: Path | None = None
    ) -> Scorer:
        """Return the scorer of a window.

        Args:
            place: Folder of true flow, see `densify.readers.flow_files`; None for the exact
                truth of the sequence, if it has one.
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
        """Return the scores of the Argoverse 2 challenges, all pairs together, None without truth.

        They are of the flow to the next sweep, see `densify.scores.challenge`.
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
        """Return the scores of the flow to the next sweep, all pairs together.

        found: share of the certain moving points above the ground that are called moving (recall).
        found_movers_m: error of the moving points that are called moving. falsely_moving: share of
        false positives among all static points, ground included.
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
        """Return the scores of the flow to the key: ghosts, and with truth errors of moving points.

        The errors are of points above the ground, by the number of sweeps to the key, of all and of
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
        return np.concatenate([column(f)[self.window.above[f]] for f in self.sources])


def _plainly(values: Mapping[str, float]) -> dict[str, float | None]:
    """Return the values as JSON has them, None for not a number."""
    return {name: None if math.isnan(value) else value for name, value in values.items()}


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
    """Run and measure methods. The result has plain numbers, None if unknown.

    Args:
        window: Number of sweeps on each side of the key.
        methods: Of `METHODS`; ``ours`` is the configured engine.
        truth: Folder of true flow (`densify.readers.flow_files`), to score only the pairs
            before the key; None for the sequence's own.

    Returns:
        ``methods`` by name, each with ``seconds_per_pair`` and the scores ``step``,
            ``challenge``, ``window`` of `Scorer`.

    Raises:
        InputError: A method is unknown, the window has no neighbours, or a frame is missing.
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
    """Return the registered window of a key.

    Raises:
        InputError: The key does not exist.
        ComputationError: Registration fails.
    """
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
    if method == "ours":  # compilation must not count
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
