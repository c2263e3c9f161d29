# SPDX-License-Identifier: MIT
"""Which keys are good enough for a training set, by scores that need no truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from densify.config.errors import InputError
from densify.geometry.types import Result


@dataclass(frozen=True)
class Gate:
    """Limits beyond which a key is put aside; None is none.

    max_ghost: share of the accumulated points that stand where the key sweep saw through.
    min_density: share of the image's pixels with a measured depth, in every camera. max_outliers:
    share of the key sweep's own returns that the map made without it misses by KITTI's outlier
    rule, in every camera. min_sweeps: in the window, which ends and gaps of the recording cut.
    """

    max_ghost: float | None = None
    min_density: float | None = None
    max_outliers: float | None = None
    min_sweeps: int | None = None

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            option = f"--{limit.name.replace('_', '-')}"
            if limit.name == "min_sweeps":
                if value is not None and value < 1:
                    raise InputError(f"{option} {value}: expected 1 sweep or more")
            elif value is not None and not 0 <= value <= 1:
                raise InputError(f"{option} {value:g}: expected a share, 0 to 1, not per cent")

    def reason(self, scores: Mapping[str, Any], num_sweeps: int) -> str | None:
        """Why a key with these `scores` is put aside; None where it is not."""
        if self.min_sweeps is not None and num_sweeps < self.min_sweeps:
            return f"{num_sweeps} sweeps, expected at least {self.min_sweeps}"
        ghost = scores["ghost"]
        if self.max_ghost is not None and ghost is not None and ghost > self.max_ghost:
            return f"ghost rate {ghost:.5f}, expected at most {self.max_ghost:g}"
        for camera, density in scores["density"].items():
            if self.min_density is not None and density < self.min_density:
                return f"density {density:.4f} in {camera}, expected at least {self.min_density:g}"
        for camera, outliers in scores["outliers"].items():
            if self.max_outliers is not None and (outliers or 0) > self.max_outliers:
                return (
                    f"outliers {outliers:.5f} in {camera}, expected at most {self.max_outliers:g}"
                )
        return None


def scores_of(result: Result) -> dict[str, Any]:
    """The scores of a key that a manifest records: ``num_points``, ``num_moving``, ``ghost``, and
    by camera ``density``, ``density_filled``, ``outliers`` and ``mae_m`` of the key held out; None
    for what cannot be said."""
    return scores_of_metrics(result.metrics)


def scores_of_metrics(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The same of ``Result.metrics``, or of a metrics.json."""
    held_out = metrics["held_out"] or {}
    errors = {name: scores["measured"]["all"] for name, scores in held_out.items()}
    return {
        "num_points": metrics["num_points"],
        "num_moving": metrics["num_moving"],
        "ghost": metrics["ghosts"]["all"],
        "density": {n: d["measured"] for n, d in metrics["density"].items()},
        "density_filled": {n: d["filled"] for n, d in metrics["density"].items()},
        "outliers": {n: e["outliers"] for n, e in errors.items()},
        "mae_m": {n: e["mae_m"] for n, e in errors.items()},
    }
