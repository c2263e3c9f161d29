# SPDX-License-Identifier: MIT
"""Scores of the flow of a window: against the truth where there is one, and without."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from densify import flow_metrics as metrics
from densify import poses
from densify.range_image import RangeImage
from densify.scores import ghost_rate
from densify.stages.accumulate import accumulate
from densify.types import Bool, Float, FlowField, LidarSequence, Truth, Window

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5


@dataclass(frozen=True)
class SweepAnswer:
    """The truth of one sweep's N points, in its own lidar frame.

    step, to_key: (N,3) flow to the neighbour towards the key and to the key. at_key: (N,3) key
    frame, where the points are at the key's moment. moving, foreground: (N,) moves now; belongs to
    an object. certain: (N,) moves, at least 0.5 m over the window, on an object of 30 returns.
    """

    step: Float
    to_key: Float
    at_key: Float
    moving: Bool
    foreground: Bool
    certain: Bool


@dataclass(frozen=True)
class Scorer:
    """What methods' flows of one window are held against.

    above: per sweep (N,) above the ground: errors are over these, since no method moves the ground.
    sources: numbers of the sweeps whose step is scored. answers: per sweep, None without truth.
    """

    window: Window
    above: Sequence[Bool]
    sources: tuple[int, ...]
    answers: tuple[SweepAnswer, ...] | None

    @staticmethod
    def of(
        sequence: LidarSequence, window: Window, above: Sequence[Bool], sources: tuple[int, ...]
    ) -> Scorer:
        truth = sequence.truth
        rows = range(len(window.sweeps))
        answers = None if truth is None else tuple(_answer(truth, window, i) for i in rows)
        return Scorer(window, above, sources, answers)

    def step_scores(self, steps: Sequence[FlowField]) -> dict[str, Any]:
        """Of the flow over one sweep, all pairs together. found: of the ``certain`` movers above
        the ground; falsely_moving: of all that stands still, ground too."""
        if self.answers is None:
            moving = np.concatenate([steps[i].moving for i in self.sources])
            return {"called_moving": _plain(float(moving.mean()))}
        answers = self.answers
        flow = self._above(lambda i: steps[i].displacement)
        true = self._above(lambda i: answers[i].step)
        moving = self._above(lambda i: answers[i].moving)
        called = self._above(lambda i: steps[i].moving)
        certain = self._above(lambda i: answers[i].certain)
        foreground = self._above(lambda i: answers[i].foreground)
        parts = metrics.three_way_error(flow, true, moving, foreground)
        buckets = metrics.bucketed_error(flow, true)
        still = np.concatenate([steps[i].moving[~answers[i].moving] for i in self.sources])
        scores = {
            "num_movers": int(moving.sum()),
            "movers_m": parts.foreground_dynamic_m,
            "static_objects_m": parts.foreground_static_m,
            "background_m": parts.background_static_m,
            "three_way_m": parts.mean_m,
            "movers_within_5": metrics.accuracy(flow[moving], true[moving], metrics.STRICT),
            "movers_within_10": metrics.accuracy(flow[moving], true[moving], metrics.RELAXED),
            "movers_angle_rad": metrics.angle_error_rad(flow[moving], true[moving]),
            "space_time_angle_rad": metrics.space_time_angle_error_rad(flow, true),
            "dynamic_iou": metrics.dynamic_iou(called, moving),
            "bucketed_static_m": buckets.static_m,
            "bucketed_dynamic": buckets.dynamic,
            "found": metrics.share_found(called, certain),
            "falsely_moving": float(still.mean()) if len(still) else math.nan,
        }
        return {name: _plain(value) for name, value in scores.items()}

    def window_scores(self, to_key: Sequence[FlowField]) -> dict[str, Any]:
        """Of the flow to the key. Accumulated movers, the key's own left out, are the true movers
        above the ground, without truth those that are called moving."""
        cloud = accumulate(self.window, to_key, drop_lost=True)
        key_image = RangeImage.of(self.window[self.window.key])
        others = self._others()
        movers = [to_key[i].moving for i in range(len(to_key))]
        if self.answers is not None:
            movers = [a.moving & above for a, above in zip(self.answers, self.above, strict=True)]
        kept = [m & ~f.lost for m, f in zip(movers, to_key, strict=True)]
        points = np.concatenate([self._placed(i, to_key[i])[kept[i]] for i in others])
        num_movers = sum(int(movers[i].sum()) for i in others)
        scores: dict[str, Any] = {
            "ghost_rate": ghost_rate(cloud, key_image, self.window.key),
            "num_movers": num_movers,
            "lost": _plain(1 - len(points) / num_movers if num_movers else math.nan),
            "plane_residual_m": _plain(metrics.plane_residual_m(points)),
            "extent_m2": _plain(metrics.extent_m2(points)),
        }
        if self.answers is None:
            return scores
        answers, key = self.answers, self.window.frames.index(self.window.key)
        true = np.concatenate([answers[i].at_key[movers[i]] for i in others])
        errors = metrics.errors_by_hops(
            np.concatenate([to_key[i].displacement[kept[i]] for i in others]),
            np.concatenate([answers[i].to_key[kept[i]] for i in others]),
            np.concatenate([np.full(int(kept[i].sum()), abs(i - key)) for i in others]),
        )
        scores["movers_m_by_hops"] = {str(n): _plain(error) for n, error in errors.items()}
        scores["coverage"] = _plain(metrics.coverage(points, true))
        return scores

    def truth_scores(self) -> dict[str, Any] | None:
        """What perfect flow gets in the scores of accumulated movers; None without truth."""
        if self.answers is None:
            return None
        points = np.concatenate(
            [self.answers[i].at_key[self.answers[i].moving & self.above[i]] for i in self._others()]
        )
        return {
            "num_movers": len(points),
            "plane_residual_m": _plain(metrics.plane_residual_m(points)),
            "extent_m2": _plain(metrics.extent_m2(points)),
        }

    def _above(self, column: Callable[[int], Any]) -> Any:
        return np.concatenate([column(i)[self.above[i]] for i in self.sources])

    def _others(self) -> list[int]:
        key = self.window.frames.index(self.window.key)
        return [i for i in range(len(self.window.sweeps)) if i != key]

    def _placed(self, i: int, field: FlowField) -> Float:
        """(N,3) key frame at the key's moment, where called moving; the others rigidly."""
        registered = self.window.sweeps[i]
        flow = np.where(field.moving[:, None], field.total, 0.0)
        return poses.transform(registered.T_key_lidar, registered.sweep.points + flow)


def _answer(truth: Truth, window: Window, i: int) -> SweepAnswer:
    registered, key = window.sweeps[i], window.frames.index(window.key)
    frame, rows = registered.frame, registered.sweep.row
    whole = truth.sweep(frame)
    toward = window.frames[i + int(np.sign(key - i))]
    to_key = truth.displacement(frame, window.key)[rows]
    first, last = (truth.displacement(frame, window.frames[j])[rows] for j in (0, -1))
    moving, instance = whole.moving[rows], whole.instance[rows]
    num_returns = np.bincount(instance[instance >= 0], minlength=int(instance.max(initial=-1)) + 2)
    many = (instance >= 0) & (num_returns[instance] >= _MIN_RETURNS)
    far = np.linalg.norm(last - first, axis=1) >= _LEAST_MOTION_M
    return SweepAnswer(
        step=truth.displacement(frame, toward)[rows],
        to_key=to_key,
        at_key=poses.transform(registered.T_key_lidar, whole.points[rows] + to_key),
        moving=moving,
        foreground=instance >= 0,
        certain=moving & many & far,
    )


def _plain(value: float) -> float | None:
    """Not a number is None in JSON."""
    return None if math.isnan(value) else value
