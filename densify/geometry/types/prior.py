# SPDX-License-Identifier: MIT
"""Depth that is known from an image alone, and maps completed with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.geometry.arrays import Bool, Float32


@dataclass(frozen=True)
class Prior:
    """A depth image that the user brings, as large as the map it is for.

    value: (H,W) float32, 0 none: depth or inverse depth, relative or metric. sky: (H,W) bool, to be
    left empty. source: where it is from, for messages.
    """

    value: Float32
    sky: Bool
    source: str


@dataclass(frozen=True)
class PriorFit:
    """How a prior's values p become depth z in metres over the whole image, before the local
    correction: kind ``depth``, z = scale p + shift_m; ``inverse``, 1/z = scale p + shift_per_m;
    ``log``, ln z = scale ln p + shift.

    residual: mean of |ln z - ln measured| over the measured pixels, held to ln 1.25, each octave of
    depth counted alike. wrong: share of them, in the same way, that are off by more than 25 %.
    used: whether the prior fits well enough to be used.
    """

    kind: str
    scale: float
    shift: float
    residual: float
    wrong: float
    used: bool


@dataclass(frozen=True)
class FullDepth:
    """A depth map completed with a prior; (H,W) each.

    depth_m: float32 metres, 0 none: ``DepthMap.filled_m`` where that has a depth. confidence:
    float32 0 to 1, of the prior's pixels less than of all others. from_prior: bool, the prior's.
    source: where the prior is from.
    """

    depth_m: Float32
    confidence: Float32
    from_prior: Bool
    fit: PriorFit
    source: str

    @property
    def share(self) -> float:
        """Share of the image's pixels that came from the prior."""
        return float(np.mean(self.from_prior)) if self.from_prior.size else 0.0
