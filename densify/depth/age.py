# SPDX-License-Identifier: MIT
"""How old each pixel of a depth map is: what moves may have gone on since it was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from densify.geometry.types import DepthMap


def with_ages(depth: DepthMap, stamps_ns: Mapping[int, int], key: int, late_s: float) -> DepthMap:
    """The map with ``age_s``, seconds between the moment it shows and each pixel's source sweep.

    stamps_ns: reference times of the sweeps, by frame. late_s: from the key's reference time to the
    moment the map shows. A measured pixel has the age of its sweep, a filled one that of the
    measured pixel nearest to it in the image, of equally near ones any (always the same).
    """
    shown_ns = stamps_ns[key] + round(1e9 * late_s)
    age_s = {frame: abs(stamp_ns - shown_ns) * 1e-9 for frame, stamp_ns in stamps_ns.items()}
    measured = depth.depth_m > 0
    frames, which = np.unique(depth.frame[measured], return_inverse=True)
    ages = np.full(measured.shape, np.nan, np.float32)
    ages[measured] = np.array([age_s[int(f)] for f in frames])[which]
    filled = (depth.filled_m > 0) & ~measured
    if len(frames) and filled.any():
        row, column = distance_transform_edt(
            ~measured, return_distances=False, return_indices=True
        )[:, filled]
        ages[filled] = ages[row, column]
    return replace(depth, age_s=ages)
