# SPDX-License-Identifier: MIT
"""Scores of the flow of a window: against the truth where there is one, and without."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.bench.windows import Window
from densify.depth.accumulate import accumulate
from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.linking import link
from densify.geometry.types import Bool, Float, FlowField, Int, LidarSequence, Truth
from densify.readers.true_flow import LabelledFlow, labelled_flow
from densify.scores import flow_metrics as metrics
from densify.scores.challenge import CLASSES, ChallengeScorer
from densify.scores.cloud_scores import ghost_rate, radial_velocity_scores
from densify.scores.segmentation import SegmentationScorer

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5
_LINK_M = 0.6
"""Moving points so near each other are one object, where a method says nothing of objects."""


@dataclass(frozen=True)
class SweepAnswer:
    """The truth of one sweep's N points, in its own lidar frame.

    step, to_key: (N,3) flow to the neighbour towards the key and to the key. at_key: (N,3) key
    frame, where the points are at the key's moment. moving, foreground: (N,) moves now; belongs to
    an object. certain: (N,) moves, at least 0.5 m over the window, on an object of 30 returns.
    segment: (N,) the moving object that the point belongs to now, -1 none.
    """

    step: Float
    to_key: Float
    at_key: Float
    moving: Bool
    foreground: Bool
    certain: Bool
    segment: Int

    def label(self) -> LabelledFlow:
        """The step, and what belongs to an object."""
        classes = np.where(self.foreground, CLASSES.index("OBJECT"), 0).astype(np.uint8)
        return LabelledFlow(self.step, classes, np.ones(len(classes), bool))


@dataclass(frozen=True)
class Scorer:
    """What methods' flows of one window are held against.

    Errors are over the points above the ground, since no method moves the ground. sources: frames
    whose step is scored. answers: by frame, None without exact truth. labels: of the steps of the
    sources, none without truth.
    """

    window: Window
    sources: tuple[int, ...]
    answers: Mapping[int, SweepAnswer] | None
    labels: Mapping[int, LabelledFlow]

    @staticmethod
    def of(
        sequence: LidarSequence, window: Window, sources: tuple[int, ...], place: Path | None = None
    ) -> Scorer:
        """place: of true flow, see `densify.readers.true_flow`; then ``sources`` lie before the
        key. None for the exact truth of the sequence, where it has one."""
        answers, labels = None, {}
        if sequence.truth is not None:
            answers = {f: _answer(sequence.truth, window, f) for f in window.frames}
            labels = {f: answers[f].label() for f in sources}
        if place is not None:
            labels = {f: labelled_flow(place, sequence.name, window.stretch, f) for f in sources}
        return Scorer(window, sources, answers, labels)

    def challenge_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any] | None:
        """The flow to the next sweep as the Argoverse 2 challenges score it, all pairs together,
        see `densify.scores.challenge`; None without truth."""
        if not self.labels:
            return None
        scorer = ChallengeScorer()
        for frame, label in self.labels.items():
            counted = self.window.above[frame] & label.valid
            points = self.window.stretch[frame].sweep.points
            flow, true, classes = steps[frame].displacement, label.flow, label.classes
            scorer.add(*(column[counted] for column in (points, flow, true, classes)))
        scores = scorer.scores()
        by_class = {name: _plainly(error._asdict()) for name, error in scores.by_class.items()}
        return {
            "three_way": _plainly(scores.three_way._asdict()),
            "bucketed": {**by_class, "MEAN": _plainly(scores.mean._asdict())},
            "num_points": scores.num_points,
        }

    def step_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any]:
        """Score the flow to the next sweep, by frame, all pairs together. found: of the ``certain``
        movers above the ground; found_movers_m: error of the movers that are called moving;
        falsely_moving: of all that stands still, ground too."""
        if self.answers is None:
            moving = np.concatenate([steps[f].moving for f in self.sources])
            return {"called_moving": _plain(float(moving.mean()))}
        answers = self.answers
        flow = self._above(lambda f: steps[f].displacement)
        true = self._above(lambda f: answers[f].step)
        moving = self._above(lambda f: answers[f].moving)
        called = self._above(lambda f: steps[f].moving)
        certain = self._above(lambda f: answers[f].certain)
        foreground = self._above(lambda f: answers[f].foreground)
        parts = metrics.three_way_error(flow, true, moving, foreground)
        duration_s = self._above(self._durations_s)
        buckets = metrics.bucketed_error(flow, true, duration_s)
        still = np.concatenate([steps[f].moving[~answers[f].moving] for f in self.sources])
        scores = {
            "num_movers": int(moving.sum()),
            "movers_m": parts.foreground_dynamic_m,
            "found_movers_m": metrics.end_point_error(flow, true, moving & called),
            "static_objects_m": parts.foreground_static_m,
            "background_m": parts.background_static_m,
            "three_way_m": parts.mean_m,
            "movers_within_5": metrics.accuracy(flow[moving], true[moving], metrics.STRICT),
            "movers_within_10": metrics.accuracy(flow[moving], true[moving], metrics.RELAXED),
            "movers_angle_rad": metrics.angle_error_rad(flow[moving], true[moving]),
            "space_time_angle_rad": metrics.space_time_angle_error_rad(flow, true, duration_s),
            "dynamic_iou": metrics.dynamic_iou(called, moving),
            "bucketed_static_m": buckets.static_m,
            "bucketed_dynamic": buckets.dynamic,
            "found": metrics.share_found(called, certain),
            "falsely_moving": float(still.mean()) if len(still) else math.nan,
        }
        return {name: _plain(value) for name, value in scores.items()}

    def segmentation_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any] | None:
        """What moves above the ground, and which of it is one object, all pairs together, see
        `densify.scores.segmentation`; None without exact truth. Moving points that a method puts
        in no object are one where they lie within 0.6 m of each other."""
        if self.answers is None:
            return None
        scorer = SegmentationScorer()
        for frame in self.sources:
            above = self.window.above[frame]
            found = _segments(steps[frame], self.window.points(frame))
            scorer.add(found[above], self.answers[frame].segment[above])
        return scorer.scores()

    def worst_object(self, steps: Mapping[int, FlowField]) -> dict[str, Any] | None:
        """The moving object whose points above the ground, all pairs together, sum the most error,
        and what made it hard: sweeps of the window that see it, its returns in one of those, how
        far away it is and how fast. None without exact truth, or where nothing moves."""
        if self.answers is None:
            return None
        answers, sweeps = self.answers, self.window.stretch
        segment = self._above(lambda f: answers[f].segment)
        if not (segment >= 0).any():
            return None
        error_m = metrics.end_point_errors(
            self._above(lambda f: steps[f].displacement), self._above(lambda f: answers[f].step)
        )
        moves = segment >= 0
        summed_m = np.bincount(segment[moves], error_m[moves])
        worst = int(np.argmax(summed_m))
        its = segment == worst
        speed_m_s = np.linalg.norm(self._above(lambda f: answers[f].step), axis=1) / self._above(
            self._durations_s
        )
        distance_m = np.linalg.norm(self._above(lambda f: sweeps[f].sweep.points), axis=1)
        frame = self._above(lambda f: np.full(len(sweeps[f].sweep), f))
        num_sweeps = len(np.unique(frame[its]))
        return {
            "num_sweeps": num_sweeps,
            "num_pairs": len(self.sources),
            "num_returns": float(its.sum() / num_sweeps),
            "distance_m": float(distance_m[its].mean()),
            "speed_m_s": float(speed_m_s[its].mean()),
            "found": float(self._above(lambda f: steps[f].moving)[its].mean()),
            "error_m": float(error_m[its].mean()),
            "share_of_error": float(summed_m[worst] / summed_m.sum()) if summed_m[worst] else 0.0,
        }

    def window_scores(self, to_key: Mapping[int, FlowField]) -> dict[str, Any]:
        """Score the flow to the key, by frame. Accumulated movers, the key's own left out, are the
        true movers above the ground, without truth those that are called moving. radial_velocity:
        what the flow leaves of measured velocities, see `densify.scores.cloud_scores`."""
        stretch, key = self.window.stretch, self.window.key
        cloud = accumulate(stretch, [to_key[f] for f in stretch.frames], key, drop_lost=True)
        others = self._others()
        movers = {f: to_key[f].moving for f in others}
        if self.answers is not None:
            movers = {f: self.answers[f].moving & self.window.above[f] for f in others}
        kept = {f: movers[f] & ~to_key[f].lost for f in others}
        points = np.concatenate([self._placed(f, to_key[f])[kept[f]] for f in others])
        num_movers = sum(int(movers[f].sum()) for f in others)
        scores: dict[str, Any] = {
            "ghost_rate": ghost_rate(cloud, RangeImage.of(stretch[key]), key),
            "num_movers": num_movers,
            "lost": _plain(1 - len(points) / num_movers if num_movers else math.nan),
            "plane_residual_m": _plain(metrics.plane_residual_m(points)),
            "extent_m2": _plain(metrics.extent_m2(points)),
            "radial_velocity": radial_velocity_scores(cloud, stretch[key]),
        }
        if self.answers is None:
            return scores
        answers = self.answers
        true = np.concatenate([answers[f].at_key[movers[f]] for f in others])
        found = {f: kept[f] & to_key[f].moving for f in others}
        scores["movers_m_by_hops"] = self._errors_by_hops(answers, to_key, kept)
        scores["found_movers_m_by_hops"] = self._errors_by_hops(answers, to_key, found)
        scores["coverage"] = _plain(metrics.coverage(points, true))
        return scores

    def _errors_by_hops(
        self,
        answers: Mapping[int, SweepAnswer],
        to_key: Mapping[int, FlowField],
        counted: Mapping[int, Bool],
    ) -> dict[str, float | None]:
        """Mean errors of the flow to the key, by sweeps from it. counted: the points, by frame."""
        errors = metrics.errors_by_hops(
            np.concatenate([to_key[f].displacement[mine] for f, mine in counted.items()]),
            np.concatenate([answers[f].to_key[mine] for f, mine in counted.items()]),
            np.concatenate([np.full(mine.sum(), self._hops(f)) for f, mine in counted.items()]),
        )
        return {str(n): _plain(error) for n, error in errors.items()}

    def truth_scores(self) -> dict[str, Any] | None:
        """What perfect flow gets in the scores of accumulated movers; None without truth."""
        if self.answers is None:
            return None
        answers, above = self.answers, self.window.above
        points = np.concatenate(
            [answers[f].at_key[answers[f].moving & above[f]] for f in self._others()]
        )
        return {
            "num_movers": len(points),
            "plane_residual_m": _plain(metrics.plane_residual_m(points)),
            "extent_m2": _plain(metrics.extent_m2(points)),
        }

    def _above(self, column: Callable[[int], Any]) -> Any:
        return np.concatenate([column(f)[self.window.above[f]] for f in self.sources])

    def _durations_s(self, frame: int) -> Float:
        """(N,) of the step of each of a sweep's points."""
        here, there = (
            self.window.stretch[f].sweep for f in (frame, self.window.towards_key(frame))
        )
        return np.full(len(here), abs(there.stamp_ns - here.stamp_ns) * 1e-9)

    def _hops(self, frame: int) -> int:
        """Sweeps from the key."""
        return abs(self.window.frames.index(frame) - self.window.frames.index(self.window.key))

    def _others(self) -> list[int]:
        return [f for f in self.window.frames if f != self.window.key]

    def _placed(self, frame: int, field: FlowField) -> Float:
        """(N,3) key frame at the key's moment, where called moving; the others rigidly."""
        flow = np.where(field.moving[:, None], field.total, 0.0)
        stretch = self.window.stretch
        T_key_lidar = stretch.T_target_source(self.window.key, frame)
        return poses.transform(T_key_lidar, stretch[frame].sweep.points + flow)


def _answer(truth: Truth, window: Window, frame: int) -> SweepAnswer:
    rows = window.stretch[frame].sweep.row
    whole = truth.sweep(frame)
    to_key = truth.displacement(frame, window.key)[rows]
    T_key_lidar = window.stretch.T_target_source(window.key, frame)
    ends = window.frames[0], window.frames[-1]
    first, last = (truth.displacement(frame, end)[rows] for end in ends)
    moving, instance = whole.moving[rows], whole.instance[rows]
    num_returns = np.bincount(instance[instance >= 0], minlength=int(instance.max(initial=-1)) + 2)
    many = (instance >= 0) & (num_returns[instance] >= _MIN_RETURNS)
    far = np.linalg.norm(last - first, axis=1) >= _LEAST_MOTION_M
    return SweepAnswer(
        step=truth.displacement(frame, window.towards_key(frame))[rows],
        to_key=to_key,
        at_key=poses.transform(T_key_lidar, whole.points[rows] + to_key),
        moving=moving,
        foreground=instance >= 0,
        certain=moving & many & far,
        segment=np.where(moving, instance, -1).astype(np.int64),
    )


def _segments(field: FlowField, points: Float) -> Int:
    """(N,) the object of each moving point, -1 of what stands."""
    found = np.where(field.moving, field.instance, -1).astype(np.int64)
    loose = np.flatnonzero(field.moving & (found < 0))
    _, group = link(points[loose], _LINK_M)
    found[loose] = found.max(initial=-1) + 1 + group
    return found


def _plain(value: float) -> float | None:
    """The value as JSON has it, None for not a number."""
    return None if math.isnan(value) else value


def _plainly(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _plain(value) for name, value in values.items()}
