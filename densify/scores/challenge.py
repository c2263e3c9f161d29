# SPDX-License-Identifier: MIT
"""Score scene flow as the Argoverse 2 scene flow challenges do, over many pairs of sweeps.

Scored is the flow from a sweep to the next, ego-motion removed, within 35 m on each side of the
vehicle and without the ground:

- three-way end-point error (Chodosh, Ramanan, Lucey, WACV 2024; the package av2): mean errors over
  points of objects that move by 0.05 m a sweep or more, of other objects, and of static background;
- bucket normalised error (Khatri et al., "I Can't Believe It's Not Scene Flow!", ECCV 2024; the
  package bucketed-scene-flow-eval): the points of each class are sorted by the length of their true
  flow into ``linspace(0, 2.0, 51)`` metres a sweep and one bucket beyond. The first bucket is
  static, scored by its mean error in metres. In every other bucket the mean error is divided by the
  mean true length. The quotients are averaged over the buckets with points, then over the classes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float
from densify.scores.flow_metrics import end_point_errors, mean_of

CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OBJECT")
"""Names of the classes; a point's class is the index. OBJECT is an object of unknown kind."""
IGNORED = 255
"""Class number of points that the challenge leaves out, such as signs."""
WITHIN_M = 35.0
MOVES_M = 0.05
EDGES_M = np.linspace(0, 2.0, 51)


class ThreeWayError(NamedTuple):
    """Mean end-point errors in metres, and ``mean_m``, the mean of the three, NaN if any is NaN."""

    foreground_dynamic_m: float
    foreground_static_m: float
    background_static_m: float
    mean_m: float


class BucketedError(NamedTuple):
    """The bucket normalised error of a class, or its mean over classes."""

    static_m: float  # mean error in the static bucket, metres
    # Mean error in the other buckets as a share of the true flow, 1 for an estimate of zero
    dynamic: float


class ChallengeScores(NamedTuple):
    """The scores over all pairs of sweeps."""

    three_way: ThreeWayError  # three-way end-point error in metres
    # Bucketed error of each class with points, by name of the class
    by_class: dict[str, BucketedError]
    mean: BucketedError  # bucketed error averaged over these classes
    num_points: int  # number of scored points


class ChallengeScorer:
    """Accumulator of the challenge's scores over pairs of sweeps."""

    def __init__(self, within_m: float = WITHIN_M) -> None:
        self._within_m = within_m
        self._three_way = np.zeros((3, 2))
        self._buckets = np.zeros((3, len(CLASSES), len(EDGES_M)))

    def add(self, points: Float, estimated: Float, true: Float, classes: NDArray[Any]) -> None:
        """Add the flow of one pair of sweeps, without unlabelled points and the ground.

        ``points`` (N,3) are in metres, vehicle frame. Both flows (N,3) are to the next sweep in
        metres, ego-motion removed. ``classes`` (N,) are indices in `CLASSES`, or `IGNORED`.
        """
        counted = np.abs(points[:, :2]).max(axis=1, initial=0) < self._within_m
        counted &= classes < len(CLASSES)
        error_m = end_point_errors(estimated, true)[counted]
        length_m = np.linalg.norm(np.asarray(true, np.float64), axis=1)[counted]
        named = classes[counted].astype(np.intp)
        moves, objects = length_m >= MOVES_M, named > 0
        for row, mask in enumerate((objects & moves, objects & ~moves, ~objects & ~moves)):
            self._three_way[row] += error_m[mask].sum(), mask.sum()
        cell = named * len(EDGES_M) + np.digitize(length_m, EDGES_M) - 1
        for row, weights in enumerate((None, error_m, length_m)):
            sums = np.bincount(cell, weights, self._buckets[0].size)
            self._buckets[row] += sums.reshape(self._buckets[row].shape)

    def scores(self) -> ChallengeScores:
        """Return the scores over all added pairs; a mean over no points is NaN."""
        dynamic_m, static_m, background_m = (_ratio(e, num) for e, num in self._three_way)
        mean_m = (dynamic_m + static_m + background_m) / 3
        three_way = ThreeWayError(dynamic_m, static_m, background_m, mean_m)
        by_class = {}
        for name, (num, error_m, length_m) in zip(
            CLASSES, self._buckets.transpose(1, 0, 2), strict=True
        ):
            if num.any():
                filled = num[1:] > 0
                quotients = error_m[1:][filled] / length_m[1:][filled]
                by_class[name] = BucketedError(_ratio(error_m[0], num[0]), mean_of(quotients))
        columns = np.array([*by_class.values()]).reshape(-1, 2).T
        mean = BucketedError(*(mean_of(column[np.isfinite(column)]) for column in columns))
        return ChallengeScores(three_way, by_class, mean, int(self._buckets[0].sum()))


def _ratio(numerator: float, denominator: float) -> float:
    return float(numerator / denominator) if denominator else math.nan
