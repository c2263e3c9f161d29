# SPDX-License-Identifier: MIT
"""What readers of boxes share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Boxes, Float, Int


def upright_poses(centre_m: Float, heading_rad: Float) -> Float:
    """(K,3) middles, (K,) headings of the boxes' fronts, from x towards y -> (K,4,4) in the same
    frame, z of the boxes along its z."""
    T = np.tile(np.eye(4), (len(centre_m), 1, 1))
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :3, 3] = centre_m
    return T


def checked_boxes(
    track: Sequence[str] | NDArray[Any],
    T_lidar_box: Float | Sequence[Float],
    size_m: Float,
    where: str,
    lidar: Int | None = None,
) -> Boxes:
    """Boxes as they were read. where: for messages. Raises InputError for a box that has no size,
    or is there twice."""
    bad = np.flatnonzero(~((size_m > 0) & (size_m < np.inf)).all(axis=1))
    if len(bad):
        raise InputError(
            f"{where}: a box has no size: got {size_m[bad[0]].tolist()}, expected length, width "
            f"and height in metres above 0"
        )
    names = np.array(track, np.str_)
    found, times = np.unique(names[names != ""], return_counts=True)
    if (times > 1).any():
        raise InputError(f"{where}: the box {found[times > 1][0]} is there twice, expected once")
    return Boxes(names, np.reshape(T_lidar_box, (-1, 4, 4)), size_m.reshape(-1, 3), lidar=lidar)
