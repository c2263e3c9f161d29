# SPDX-License-Identifier: MIT
"""Boxes that people or programs drew around objects, sweep by sweep."""

from __future__ import annotations

from dataclasses import dataclass

from densify.arrays import Float, Int


@dataclass(frozen=True)
class Boxes:
    """The boxes of one sweep, K of them.

    track: (K,) the same for the same object in every sweep. T_lidar_box: (K,4,4) at the sweep's
    reference time, lidar frame; a box's frame has its origin in the middle, x to the front.
    size_m: (K,3) length, width, height.
    """

    track: Int
    T_lidar_box: Float
    size_m: Float
