# SPDX-License-Identifier: MIT
"""Scene flow from tracked boxes: points in a box move with it, all others stand.

As the scene flow of Argoverse and nuScenes was made (Pontes, Hays, Lucey, 3DV 2020, section 4.1;
Jund et al., RA-L 2022).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.geometry import poses
from densify.types import Bool, Boxes, Float, FlowField

MOVES_M_S = 0.5
"""Slower boxes stand still: nobody draws a box to the centimetre (Chodosh et al., WACV 2024)."""


@dataclass(frozen=True)
class BoxMargins:
    """grown_m: boxes are larger by so much on each side; larger takes in mirrors and feet, and more
    of the ground and of what stands beside. unsure_m: points so much farther outside are unsure."""

    grown_m: float = 0.1
    unsure_m: float = 0.3


def flow_of_boxes(
    points: Float,
    boxes: Boxes,
    next_boxes: Boxes,
    T_here_next: Float,
    duration_s: float,
    margins: BoxMargins | None = None,
) -> tuple[FlowField, Bool]:
    """Flow of one sweep to the next, and which of it is sure.

    points: (N,3) lidar frame at the sweep's reference time. boxes, next_boxes: of the two sweeps.
    T_here_next: (4,4) from the next sweep's lidar frame. duration_s: between the two.

    Returns the field, whose ``instance`` is the box's row (-1 none), and (N,) bool: False in two
    boxes, just outside one, and in a box that is not there in the next sweep.
    """
    margins = margins or BoxMargins()
    field = FlowField.zero(len(points))
    num_inside, near = np.zeros(len(points), np.int64), np.zeros(len(points), bool)
    sure = np.ones(len(points), bool)
    row_of = {int(track): row for row, track in enumerate(next_boxes.track)}
    for k, (track, T_here_box, size_m) in enumerate(
        zip(boxes.track, boxes.T_lidar_box, boxes.size_m, strict=True)
    ):
        in_box = poses.transform(poses.inverse(T_here_box), points)
        outside_m = (np.abs(in_box) - size_m / 2).max(axis=1)
        inside = outside_m <= margins.grown_m
        num_inside += inside
        near |= (outside_m <= margins.grown_m + margins.unsure_m) & ~inside
        field.instance[inside] = k
        if int(track) not in row_of:
            sure[inside] = False
            continue
        T_here_there = T_here_next @ next_boxes.T_lidar_box[row_of[int(track)]]
        shift_m = np.linalg.norm(T_here_there[:3, 3] - T_here_box[:3, 3])
        if shift_m < MOVES_M_S * duration_s:
            continue
        rows = np.flatnonzero(inside)
        field.displacement[rows] = poses.transform(T_here_there, in_box[rows]) - points[rows]
        field.moving[rows] = True
    twice = num_inside > 1
    sure &= ~twice & ~(near & (num_inside == 0))
    field.displacement[twice] = 0.0
    field.moving[twice] = False
    return field, sure
