# SPDX-License-Identifier: MIT
"""How far labels are from the exact flow, where a recording has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.geometry.types import Bool, Float, Truth
from densify.learning.labels import Label
from densify.scores.flow_metrics import end_point_errors

MOVES_M_S = 1.0
"""Points at that speed or faster count as moving."""

WRONG_M = 0.05
"""Points that stand count as wrong where their label is farther off."""


class LabelErrors(NamedTuple):
    """Errors of valid points. error_m: (M,) of those that really move, and way_m: (M,) how far they
    do to the next sweep. found: (M,) bool, labelled as moving. num_standing: all others, of which
    num_wrong have a label that is more than 5 cm off."""

    error_m: Float
    way_m: Float
    found: Bool
    num_standing: int
    num_wrong: int

    @staticmethod
    def of(label: Label, truth: Truth) -> LabelErrors:
        """truth: of the recording that was labelled."""
        sweep, after = label.registered.sweep, label.after.sweep
        true = truth.displacement(sweep.frame, after.frame)[sweep.row]
        error_m = end_point_errors(label.field.displacement, true)
        way_m = np.linalg.norm(true, axis=1)
        fast = way_m >= MOVES_M_S * (after.stamp_ns - sweep.stamp_ns) * 1e-9
        moves, stands = label.sure & fast, label.sure & ~fast
        num_wrong = int((error_m[stands] > WRONG_M).sum())
        moving = label.field.moving[moves]
        return LabelErrors(error_m[moves], way_m[moves], moving, int(stands.sum()), num_wrong)

    @staticmethod
    def joined(parts: Sequence[LabelErrors]) -> LabelErrors:
        """All sweeps together, one or more."""
        error_m, way_m, found, num_standing, num_wrong = zip(*parts, strict=True)
        return LabelErrors(
            np.concatenate(error_m),
            np.concatenate(way_m),
            np.concatenate(found),
            sum(num_standing),
            sum(num_wrong),
        )

    def summary(self) -> dict[str, float | None]:
        """num_moving, error_m (mean and median) and way_m (mean) of what moves, missed (its share
        labelled as standing), wrong (share of what stands). None of nothing."""
        some, stands = len(self.error_m) > 0, self.num_standing > 0
        return {
            "num_moving": len(self.error_m),
            "error_m": float(self.error_m.mean()) if some else None,
            "median_error_m": float(np.median(self.error_m)) if some else None,
            "way_m": float(self.way_m.mean()) if some else None,
            "missed": 1 - float(self.found.mean()) if some else None,
            "wrong": self.num_wrong / self.num_standing if stands else None,
        }
