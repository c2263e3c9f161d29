# SPDX-License-Identifier: MIT
"""Score scene flow as the Argoverse 2 scene flow challenges do, over many pairs of sweeps.

Within 35 m on each side of the vehicle and without the ground, flow from a sweep to the next,
ego-motion removed:

- three-way end-point error (Chodosh, Ramanan, Lucey, WACV 2024; the package av2): means over points
  of objects that move by 0.05 m a sweep or more, of other objects, and of static background;
- bucket normalised error (Khatri et al., "I Can't Believe It's Not Scene Flow!", ECCV 2024; the
  package bucketed-scene-flow-eval): per class, points are sorted by the length of their true flow
  into ``linspace(0, 2.0, 51)`` metres a sweep and one bucket beyond. The first is static: its mean
  error, metres. In every other one the mean error is divided by the mean length of the true flow;
  the quotients are averaged over the buckets that hold points, and over the classes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float
from densify.scores.flow_metrics import end_point_errors, mean_of

CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OBJECT")
"""A point's class is the index of its name here. OBJECT: of a kind that nobody named."""
IGNORED = 255
"""The class of points that the challenge leaves out, such as signs."""
WITHIN_M = 35.0
MOVES_M = 0.05
EDGES_M = np.linspace(0, 2.0, 51)


class ThreeWayError(NamedTuple):
    """Mean errors in metres. ``mean_m`` is the mean of the three, NaN if one is."""

    foreground_dynamic_m: float
    foreground_static_m: float
    background_static_m: float
    mean_m: float


class BucketedError(NamedTuple):
    """The error of the static bucket in metres, and that of the others as a share of the speed.

    An estimate of zero flow has a dynamic error of 1.
    """

    static_m: float
    dynamic: float


class ChallengeScores(NamedTuple):
    """The scores of all pairs.

    Attributes:
        three_way: Metres.
        by_class: Of the classes with points.
        mean: Over these classes.
        num_points: Number of scored points.
    """

    three_way: ThreeWayError
    by_class: dict[str, BucketedError]
    mean: BucketedError
    num_points: int


class ChallengeScorer:
    """Sums over pairs of sweeps."""

    def __init__(self, within_m: float = WITHIN_M) -> None:
        self._within_m = within_m
        self._three_way = np.zeros((3, 2))
        self._buckets = np.zeros((3, len(CLASSES), len(EDGES_M)))

    def add(self, points: Float, estimated: Float, true: Float, classes: NDArray[Any]) -> None:
        """Add one pair, without unlabelled points and the ground.

        Args:
            points: (N,3) metres, vehicle frame.
            estimated: (N,3) metres to the next sweep.
            true: (N,3) metres to the next sweep.
            classes: (N,) indices in `CLASSES`, or `IGNORED`.
        """
        counted = np.abs(points[:, :2]).max(axis=1, initial=0) < self._within_m
        counted &= classes < len(CLASSES)
        error_m = end_point_errors(estimated, true)[counted]
        length_m = np.linalg.norm(np.asarray(true, np.float64), axis=1)[counted]
        named = classes[counted].astype(np.intp)
        moves, objects = length_m >= MOVES_M, named > 0
        for row, part in enumerate((objects & moves, objects & ~moves, ~objects & ~moves)):
            self._three_way[row] += error_m[part].sum(), part.sum()
        cell = named * len(EDGES_M) + np.digitize(length_m, EDGES_M) - 1
        for row, weights in enumerate((None, error_m, length_m)):
            sums = np.bincount(cell, weights, self._buckets[0].size)
            self._buckets[row] += sums.reshape(self._buckets[row].shape)

    def scores(self) -> ChallengeScores:
        """Return the scores of all pairs together, NaN over no points."""
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


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else math.nan
