# SPDX-License-Identifier: MIT
"""Compute scene flow from tracked boxes: points in a box move with it, all others are static.

Sources: Pontes, Hays, Lucey, 3DV 2020, section 4.1 (Argoverse, nuScenes); Jund et al., RA-L 2022.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import Bool, Boxes, BoxView, Float, FlowField, Int, RegisteredSweep

MOVES_M_S = 0.5
"""Least speed of a moving box; box poses are not accurate (Chodosh et al., WACV 2024)."""


@dataclass(frozen=True)
class BoxMargins:
    """Margins around a box."""

    # Margin added to each side of a box. A larger margin takes in mirrors and feet, and more of the
    # ground.
    grown_m: float = 0.1
    unsure_m: float = 0.3  # width of the zone outside the grown box where flow is uncertain
    # Height above the bottom of a moving box below which flow is uncertain: the points may be the
    # road
    foot_m: float = 0.1


def flow_of_boxes(
    source: RegisteredSweep,
    after: RegisteredSweep,
    boxes: Boxes,
    next_boxes: Boxes,
    margins: BoxMargins | None = None,
) -> tuple[FlowField, Bool]:
    """Return the flow of the N points of one sweep to the next, and which flows are certain.

    Args:
        source: Sweep of the N points.
        after: Next sweep in the same world. Only its pose and time are used.
        boxes: Boxes of ``source``.
        next_boxes: Boxes of ``after``. Boxes of one object share the track name.

    Returns:
        The flow with ego-motion removed, in the lidar frame of ``source``; ``instance`` is the row
            of the point's box, -1 for no box. Then (N,) True where the flow is certain. It is False
            for points in two boxes, just outside a box, at the bottom of a moving box, in a box
            that the next sweep lacks, or in image areas without annotation.
    """
    margins = margins or BoxMargins()
    points = source.sweep.points
    field = FlowField.zero(len(points))
    num_inside, is_near_box = np.zeros(len(points), np.int64), np.zeros(len(points), bool)
    sure = _looked_at(boxes.view, points)
    duration_s = (after.sweep.stamp_ns - source.sweep.stamp_ns) * 1e-9
    T_source_next = poses.inverse(source.T_world_lidar) @ after.T_world_lidar
    T_source_next_boxes = T_source_next @ _at_reference(next_boxes, after)
    row_of = {track: row for row, track in enumerate(next_boxes.track) if track}
    for k, (rows, T_source_box) in enumerate(_about(boxes, source, margins)):
        track = boxes.track[k]
        in_box = poses.transform(poses.inverse(T_source_box), points[rows])
        outside_m = (np.abs(in_box) - boxes.size_m[k] / 2).max(axis=1)
        is_near_box[rows] |= outside_m <= margins.grown_m + margins.unsure_m
        inside = outside_m <= margins.grown_m
        rows, in_box = rows[inside], in_box[inside]
        num_inside[rows] += 1
        field.instance[rows] = k
        if track not in row_of:
            sure[rows] = False
            continue
        T_source_next_box = T_source_next_boxes[row_of[track]]
        shift_m = np.linalg.norm(T_source_next_box[:3, 3] - T_source_box[:3, 3])
        if shift_m < MOVES_M_S * duration_s:
            continue
        field.displacement[rows] = poses.transform(T_source_next_box, in_box) - points[rows]
        field.moving[rows] = True
        sure[rows[in_box[:, 2] < margins.foot_m - boxes.size_m[k, 2] / 2]] = False
    twice = num_inside > 1
    sure &= ~twice & ~(is_near_box & (num_inside == 0))
    field.displacement[twice] = 0.0
    field.moving[twice] = False
    return field, sure


def _about(
    boxes: Boxes, registered: RegisteredSweep, margins: BoxMargins
) -> Iterator[tuple[Int, Float]]:
    """Yield, for each box, the indices of the points around it and its (4,4) pose, lidar frame."""
    points = registered.sweep.points
    reach_m = np.linalg.norm(boxes.size_m / 2 + margins.grown_m + margins.unsure_m, axis=1)
    x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
    for k, T_lidar_box in enumerate(_at_reference(boxes, registered)):
        rows: Int = np.flatnonzero(
            (np.abs(x - T_lidar_box[0, 3]) <= reach_m[k])
            & (np.abs(y - T_lidar_box[1, 3]) <= reach_m[k])
        )
        if boxes.lidar is not None and boxes.lidar[k] >= 0:  # drawn for one scanner
            rows = rows[registered.sweep.lidar[rows] == boxes.lidar[k]]
        yield rows, T_lidar_box


def _at_reference(boxes: Boxes, registered: RegisteredSweep) -> Float:
    """Return the (K,4,4) box poses, lidar frame, deskewed to the reference time like the points."""
    if boxes.offset_ns is None:
        return boxes.T_lidar_box
    T = boxes.T_lidar_box.copy()
    for k, offset_ns in enumerate(boxes.offset_ns.tolist()):
        twist = registered.twist_before if offset_ns < 0 else registered.twist_after
        T[k] = poses.exp(offset_ns * 1e-9 * twist) @ T[k]
    return T


def _looked_at(view: BoxView | None, points: Float) -> Bool:
    """Return (N,) True for the points (N,3, lidar frame) in the annotated image area."""
    if view is None:
        return np.ones(len(points), bool)
    uv, seen = image_points(view.camera, poses.transform(view.camera.T_cam_lidar, points))
    with np.errstate(invalid="ignore"):
        for left, top, right, bottom in view.left_out_px:
            inside = (uv >= (left, top)) & (uv <= (right, bottom))
            seen &= ~inside.all(axis=1)
    return seen
