# SPDX-License-Identifier: MIT
"""Scene flow as the Argoverse 2 scene flow challenges score it, over many pairs of sweeps.

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
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from densify.config.errors import InputError
from densify.geometry.arrays import Bool, Float
from densify.scores.flow_metrics import BucketedError, ThreeWayError, end_point_errors

CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OBJECT")
"""A point's class is the index of its name here. OBJECT: of a kind that nobody named."""
IGNORED = 255
"""The class of points that the challenge leaves out, such as signs."""
WITHIN_M = 35.0
MOVES_M = 0.05
EDGES_M = np.linspace(0, 2.0, 51)


class ChallengeScores(NamedTuple):
    """three_way: metres. by_class: of the classes that have points. mean: over these. num_points:
    that were scored."""

    three_way: ThreeWayError
    by_class: dict[str, BucketedError]
    mean: BucketedError
    num_points: int


@dataclass
class ChallengeScorer:
    """Sums over pairs of sweeps. within_m: half a side of the square that counts."""

    within_m: float = WITHIN_M
    _three_way: Float = field(default_factory=lambda: np.zeros((3, 2)), repr=False)
    _buckets: Float = field(
        default_factory=lambda: np.zeros((3, len(CLASSES), len(EDGES_M))), repr=False
    )

    def add(
        self, points: ArrayLike, estimated: ArrayLike, true: ArrayLike, classes: ArrayLike
    ) -> None:
        """Add one pair, without unlabelled points and the ground.

        points: (N,3) metres, vehicle frame. estimated, true: (N,3) metres to the next sweep.
        classes: (N,) indices in `CLASSES`, or `IGNORED`. Raises InputError if these do not fit.
        """
        error_m = end_point_errors(estimated, true)
        length_m = np.linalg.norm(np.asarray(true, np.float64), axis=1)
        at, named = _checked(points, classes, len(error_m))
        counted: Bool = (np.abs(at[:, :2]).max(axis=1, initial=0) < self.within_m) & (
            named < len(CLASSES)
        )
        error_m, length_m, named = error_m[counted], length_m[counted], named[counted]
        moves, objects = length_m >= MOVES_M, named > 0
        for row, part in enumerate((objects & moves, objects & ~moves, ~objects & ~moves)):
            self._three_way[row] += error_m[part].sum(), part.sum()
        cell = named * len(EDGES_M) + np.digitize(length_m, EDGES_M) - 1
        for row, weights in enumerate((None, error_m, length_m)):
            sums = np.bincount(cell, weights, self._buckets[0].size)
            self._buckets[row] += sums.reshape(self._buckets[row].shape)

    def scores(self) -> ChallengeScores:
        """Return the scores of all pairs together; NaN over no points."""
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
                by_class[name] = BucketedError(_ratio(error_m[0], num[0]), _mean(quotients))
        columns = np.array([*by_class.values()]).reshape(-1, 2).T
        mean = BucketedError(*(_mean(column[np.isfinite(column)]) for column in columns))
        return ChallengeScores(three_way, by_class, mean, int(self._buckets[0].sum()))


def _checked(points: ArrayLike, classes: ArrayLike, num: int) -> tuple[Float, NDArray[np.intp]]:
    at, named = np.asarray(points, np.float64), np.asarray(classes)
    if at.shape != (num, 3) or named.shape != (num,) or named.dtype.kind not in "iu":
        raise InputError(
            f"challenge scores: got points of shape {at.shape} and {named.dtype} classes of shape "
            f"{named.shape}, expected ({num}, 3) and whole numbers of shape ({num},)"
        )
    bad = (named < 0) | ((named >= len(CLASSES)) & (named != IGNORED))
    if bad.any():
        raise InputError(
            f"challenge scores: got class {named[bad][0]}, expected 0 to {len(CLASSES) - 1}, or "
            f"{IGNORED} for points left out"
        )
    return at, named.astype(np.intp)


def _mean(values: Float) -> float:
    return float(values.mean()) if len(values) else math.nan


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else math.nan
