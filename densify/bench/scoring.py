# SPDX-License-Identifier: MIT
"""Scores of the flow of a window: against the truth where there is one, and without."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.depth.accumulate import accumulate
from densify.free_space.range_image import RangeImage
from densify.geometry.types import Bool, Float, FlowField, LidarSequence, Stretch, Truth
from densify.readers.true_flow import LabelledFlow, labelled_flow
from densify.scores.challenge import CLASSES, ChallengeScorer
from densify.scores.cloud_scores import ghost_rate
from densify.scores.flow_metrics import end_point_error, end_point_errors, mean_of

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5


@dataclass(frozen=True)
class Window:
    """Consecutive registered sweeps around a key.

    around: the sweeps that our engine takes the motion from.
    above: by frame (N,), above the ground.
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
        """Return the neighbour on the way to the key, the key itself for the key."""
        return self.frames[self.frames.index(frame) + int(np.sign(self.hops(frame)))]


class SweepTruth(NamedTuple):
    """The truth of one sweep's N points, in its own lidar frame.

    step, to_key: (N,3) flow to the neighbour towards the key, and to the key.
    moving, foreground: (N,) moves now; belongs to an object.
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
    """Scores methods' flows of one window.

    Errors are over the points above the ground, since no method moves the ground.
    sources: frames whose step is scored.
    truths: by frame, None without exact truth.
    labels: of the steps of the sources, none without truth.
    """

    window: Window
    sources: tuple[int, ...]
    truths: Mapping[int, SweepTruth] | None
    labels: Mapping[int, LabelledFlow]

    @staticmethod
    def of(
        sequence: LidarSequence, window: Window, sources: tuple[int, ...], place: Path | None = None
    ) -> Scorer:
        """Return the scorer of a window. place: of true flow, see `densify.readers.true_flow`, None
        for the exact truth of the sequence, where it has one."""
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
        """Score the flow to the next sweep as the Argoverse 2 challenges do, all pairs together,
        see `densify.scores.challenge`; None without truth."""
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
        """Score the flow to the next sweep, all pairs together.

        found: share of the certain moving points above the ground that are called moving.
        found_movers_m: error of the moving points that are called moving.
        falsely_moving: share of all static points, ground included.
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
        """Score the flow to the key: ghosts, and with truth the errors of the moving points above
        the ground by the number of sweeps to the key, of all and of those called moving."""
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
