# SPDX-License-Identifier: MIT
"""Motion segmentation over many sweeps: which points move, and which of them are one object.

- intersection over union of the moving points, all sweeps together;
- panoptic quality of the moving objects (Kirillov et al., "Panoptic Segmentation", CVPR 2019): an
  estimated and a true object are the same if the IoU of their points is above half. PQ = Σ IoU of
  those / (found + (missed + false) / 2), the product of recognition quality, found / (found +
  (missed + false) / 2), and segmentation quality, the mean IoU of those found. Objects of fewer
  than 50 points count nowhere (SemanticKITTI, Behley et al., ICRA 2021, has the same 50).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from densify.config.errors import InputError
from densify.geometry.arrays import Int

LEAST_POINTS = 50


@dataclass
class SegmentationScorer:
    """Sums over sweeps. least_points: of an object that counts."""

    least_points: int = LEAST_POINTS
    _num_both: int = 0
    _num_either: int = 0
    _num_found: int = 0
    _num_missed: int = 0
    _num_false: int = 0
    _sum_iou: float = 0.0

    def add(self, estimated: ArrayLike, true: ArrayLike) -> None:
        """Add one sweep. estimated, true: (N,) whole numbers of the moving object of each point, -1
        static; the numbers of the two need not agree. Raises InputError for other types."""
        found, real = _labels(estimated, "estimated"), _labels(true, "true")
        if found.shape != real.shape:
            raise InputError(
                f"segmentation: got {len(found)} estimated and {len(real)} true labels, expected "
                f"as many"
            )
        self._num_both += int(((found >= 0) & (real >= 0)).sum())
        self._num_either += int(((found >= 0) | (real >= 0)).sum())
        common = np.zeros((found.max(initial=-1) + 1, real.max(initial=-1) + 1), np.int64)
        both = (found >= 0) & (real >= 0)
        np.add.at(common, (found[both], real[both]), 1)
        num_found = np.bincount(found[found >= 0], minlength=len(common))
        num_real = np.bincount(real[real >= 0], minlength=common.shape[1])
        union = num_found[:, None] + num_real[None] - common
        same = 2 * common > union
        large = num_real >= self.least_points
        counted = same & large
        self._num_found += int(counted.sum())
        self._sum_iou += float((common[counted] / union[counted]).sum())
        self._num_false += int(((num_found >= self.least_points) & ~same.any(axis=1)).sum())
        self._num_missed += int((large & ~same.any(axis=0)).sum())

    def scores(self) -> dict[str, Any]:
        """Return all scores, 0 to 1 or None of nothing, and the numbers of objects."""
        counted = self._num_found + (self._num_missed + self._num_false) / 2
        return {
            "moving_iou": _ratio(self._num_both, self._num_either),
            "panoptic_quality": _ratio(self._sum_iou, counted),
            "recognition": _ratio(self._num_found, counted),
            "segmentation": _ratio(self._sum_iou, self._num_found),
            "num_found": self._num_found,
            "num_missed": self._num_missed,
            "num_false": self._num_false,
        }


def _labels(values: ArrayLike, name: str) -> Int:
    """Return the labels (N,) numbered anew from 0; -1 stays."""
    labels = np.asarray(values)
    if labels.ndim != 1 or labels.dtype.kind not in "iu":
        raise InputError(
            f"segmentation: {name}: got {labels.dtype} of shape {labels.shape}, expected (N,) "
            f"whole numbers"
        )
    numbers, label = np.unique(labels, return_inverse=True)
    anew: Int = label - np.searchsorted(numbers, 0)
    return np.maximum(anew, -1)


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None
