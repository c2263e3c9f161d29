# SPDX-License-Identifier: MIT
"""Boxes that people or programs drew around objects, sweep by sweep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from densify.geometry.arrays import Float, Int
from densify.geometry.types.depth import Camera


@dataclass(frozen=True)
class BoxView:
    """Where boxes were drawn, if not everywhere: in the image of one camera, but for rectangles.

    left_out_px: (R,4) left, top, right, bottom of what nobody drew boxes in.
    """

    camera: Camera
    left_out_px: Float


@dataclass(frozen=True)
class Boxes:
    """The boxes of one sweep, K of them.

    track: (K,) text, the same for the same object in every sweep; empty for one that is followed to
    no other sweep. T_lidar_box: (K,4,4) in the lidar frame at the sweep's reference time, in which
    the data set's points were carried by the vehicle's own motion alone, so that a box is where its
    object was met; a box's frame has its origin in the middle, x to the front, z up. size_m: (K,3)
    length, width, height. offset_ns: (K,) int64 since the reference time, where each box stands in
    the lidar frame of another time, as of data sets that carry no points; None for 0. lidar: (K,)
    whose points a box is drawn around, -1 of all scanners; None for all. view: None for everywhere.
    """

    track: NDArray[Any]
    T_lidar_box: Float
    size_m: Float
    offset_ns: Int | None = None
    lidar: Int | None = None
    view: BoxView | None = None
