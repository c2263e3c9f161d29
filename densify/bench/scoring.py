# SPDX-License-Identifier: MIT
"""Scores of the flow of a window: against the truth where there is one, and without."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.depth.accumulate import accumulate
from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, LidarSequence, Stretch, Truth
from densify.readers.true_flow import LabelledFlow, labelled_flow
from densify.scores import flow_metrics as metrics
from densify.scores.challenge import CLASSES, ChallengeScorer
from densify.scores.cloud_scores import ghost_rate

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

    def towards_key(self, frame: int) -> int:
        """Return the neighbour on the way to the key, the key itself for the key."""
        here, key = self.frames.index(frame), self.frames.index(self.key)
        return self.frames[here + (key > here) - (key < here)]

    def around_key(self) -> Stretch:
        """Return the key and its neighbours."""
        key = self.frames.index(self.key)
        return Stretch(self.stretch.sweeps[max(0, key - 1) : key + 2])


def points_in_world(stretch: Stretch, frame: int) -> Float:
    """Return the (N,3) points of a sweep, world, z up."""
    return poses.transform(stretch[frame].T_world_lidar, stretch[frame].sweep.points)


@dataclass(frozen=True)
class SweepTruth:
    """The truth of one sweep's N points, in its own lidar frame.

    step, to_key: (N,3) flow to the neighbour towards the key, and to the key.
    at_key: (N,3) key frame, positions at the key's time.
    moving, foreground: (N,) moves now; belongs to an object.
    certain: (N,) moves, at least 0.5 m over the window, on an object of 30 returns.
    """

    step: Float
    to_key: Float
    at_key: Float
    moving: Bool
    foreground: Bool
    certain: Bool

    @staticmethod
    def of(truth: Truth, window: Window, frame: int) -> SweepTruth:
        """Return the truth of a sweep of the window."""
        rows = window.stretch[frame].sweep.row
        whole = truth.sweep(frame)
        to_key = truth.displacement(frame, window.key)[rows]
        T_key_lidar = window.stretch.T_target_source(window.key, frame)
        ends = window.frames[0], window.frames[-1]
        first, last = (truth.displacement(frame, end)[rows] for end in ends)
        moving, instance = whole.moving[rows], whole.instance[rows]
        num_returns = np.bincount(instance[instance >= 0], minlength=instance.max(initial=-1) + 2)
        many = (instance >= 0) & (num_returns[instance] >= _MIN_RETURNS)
        far = np.linalg.norm(last - first, axis=1) >= _LEAST_MOTION_M
        return SweepTruth(
            step=truth.displacement(frame, window.towards_key(frame))[rows],
            to_key=to_key,
            at_key=poses.transform(T_key_lidar, whole.points[rows] + to_key),
            moving=moving,
            foreground=instance >= 0,
            certain=moving & many & far,
        )


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
                step = truths[frame].step
                labels[frame] = LabelledFlow(step, classes.astype(np.uint8), valid)
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
            flow, true, classes = steps[frame].displacement, label.flow, label.classes
            scorer.add(*(column[counted] for column in (points, flow, true, classes)))
        scores = scorer.scores()
        buckets = {name: _plainly(error._asdict()) for name, error in scores.by_class.items()}
        buckets["MEAN"] = _plainly(scores.mean._asdict())
        three_way = _plainly(scores.three_way._asdict())
        return {"three_way": three_way, "bucketed": buckets, "num_points": scores.num_points}

    def step_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any]:
        """Score the flow to the next sweep, all pairs together.

        found: share of the certain moving points above the ground that are called moving.
        found_movers_m: error of the moving points that are called moving.
        falsely_moving: share of all static points, ground included.
        """
        if self.truths is None:
            moving = np.concatenate([steps[f].moving for f in self.sources])
            return {"called_moving": float(moving.mean())}
        truths = self.truths
        flow = self._above(lambda f: steps[f].displacement)
        true = self._above(lambda f: truths[f].step)
        moving = self._above(lambda f: truths[f].moving)
        called = self._above(lambda f: steps[f].moving)
        certain = self._above(lambda f: truths[f].certain)
        parts = metrics.three_way_error(
            flow, true, moving, self._above(lambda f: truths[f].foreground)
        )
        static = np.concatenate([steps[f].moving[~truths[f].moving] for f in self.sources])
        return {
            "num_movers": int(moving.sum()),
            **_plainly(
                {
                    "movers_m": parts.foreground_dynamic_m,
                    "found_movers_m": metrics.end_point_error(flow, true, moving & called),
                    "static_objects_m": parts.foreground_static_m,
                    "background_m": parts.background_static_m,
                    "found": metrics.share_found(called, certain),
                    "falsely_moving": float(static.mean()) if len(static) else math.nan,
                }
            ),
        }

    def window_scores(self, to_key: Mapping[int, FlowField]) -> dict[str, Any]:
        """Score the flow to the key. Accumulated moving points, the key's own left out, are the
        true ones above the ground, without truth those called moving."""
        stretch, key = self.window.stretch, self.window.key
        cloud = accumulate(stretch, [to_key[f] for f in stretch.frames], key, drop_lost=True)
        others = [f for f in self.window.frames if f != key]
        movers = {f: to_key[f].moving for f in others}
        if self.truths is not None:
            movers = {f: self.truths[f].moving & self.window.above[f] for f in others}
        kept = {f: movers[f] & ~to_key[f].lost for f in others}
        points = np.concatenate([self._moved(f, to_key[f])[kept[f]] for f in others])
        num_movers = sum(int(movers[f].sum()) for f in others)
        scores: dict[str, Any] = {
            "ghost_rate": ghost_rate(cloud, RangeImage.of(stretch[key]), key),
            "num_movers": num_movers,
            "lost": 1 - len(points) / num_movers if num_movers else None,
        }
        if self.truths is None:
            return scores
        truths = self.truths
        true = np.concatenate([truths[f].at_key[movers[f]] for f in others])
        found = {f: kept[f] & to_key[f].moving for f in others}
        scores["movers_m_by_hops"] = self._errors_by_hops(truths, to_key, kept)
        scores["found_movers_m_by_hops"] = self._errors_by_hops(truths, to_key, found)
        scores["coverage"] = _plain(metrics.coverage(points, true))
        return scores

    def _errors_by_hops(
        self,
        truths: Mapping[int, SweepTruth],
        to_key: Mapping[int, FlowField],
        counted: Mapping[int, Bool],
    ) -> dict[str, float | None]:
        """Return mean errors of the flow to the key by the number of sweeps to the key.

        counted: (N,) the points, by frame.
        """
        place = self.window.frames.index
        hops = {f: abs(place(f) - place(self.window.key)) for f in counted}
        errors = metrics.errors_by_hops(
            np.concatenate([to_key[f].displacement[rows] for f, rows in counted.items()]),
            np.concatenate([truths[f].to_key[rows] for f, rows in counted.items()]),
            np.concatenate([np.full(rows.sum(), hops[f]) for f, rows in counted.items()]),
        )
        return {str(n): _plain(error) for n, error in errors.items()}

    def _above(self, column: Callable[[int], Any]) -> Any:
        return np.concatenate([column(f)[self.window.above[f]] for f in self.sources])

    def _moved(self, frame: int, field: FlowField) -> Float:
        """Return the (N,3) positions at the key's time, key frame; static points move rigidly."""
        flow = np.where(field.moving[:, None], field.total, 0.0)
        stretch = self.window.stretch
        T_key_lidar = stretch.T_target_source(self.window.key, frame)
        return poses.transform(T_key_lidar, stretch[frame].sweep.points + flow)


def _plain(value: float) -> float | None:
    """Return the value as JSON has it, None for not a number."""
    return None if math.isnan(value) else value


def _plainly(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _plain(value) for name, value in values.items()}
