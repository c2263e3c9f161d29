# SPDX-License-Identifier: MIT
"""Make scene flow labels from tracked boxes: points in a box move with it, all others are static.

Sources: Pontes, Hays, Lucey, 3DV 2020, section 4.1 (Argoverse, nuScenes); Jund et al., RA-L 2022.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config import Config
from densify.config.errors import ComputationError, InputError
from densify.config.plugins import READERS
from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import (
    Bool,
    Boxes,
    BoxView,
    Float,
    FlowField,
    Int,
    LidarSequence,
    Progress,
    RegisteredSweep,
)
from densify.outputs.flow_writers import flow_npz
from densify.outputs.folders import write_file
from densify.pipeline.recording import Recording

# Least speed of a moving box; box poses are not accurate (Chodosh et al., WACV 2024)
_MOVES_M_S = 0.5


@dataclass(frozen=True)
class Label:
    """The scene flow label of one sweep with N points."""

    registered: RegisteredSweep  # the sweep of the points
    after: RegisteredSweep  # the next sweep
    field: FlowField  # flow to the next sweep, in the sweep's lidar frame, ego-motion removed
    sure: Bool  # (N,) True for points whose flow is certain
    T_after_sweep: Float  # (4,4) from the lidar frame of the sweep to that of the next sweep


class BoxMargins(NamedTuple):
    """Margins around a box in metres."""

    grown_m: float = 0.1  # added to each side; more takes in mirrors and feet, and more ground
    unsure_m: float = 0.3  # width of the zone outside the grown box where flow is uncertain
    foot_m: float = 0.1  # height above the bottom of a moving box; points below may be the road


def label_sweeps(
    sequence: LidarSequence, frames: Sequence[int], config: Config, progress: Progress | None = None
) -> Iterator[tuple[int, Label | ComputationError | InputError]]:
    """Yield the frame number, and the label or error, of each sweep that can have a label.

    The sweep and its next sweep must have boxes. A recording without any raises InputError.
    """
    boxes = getattr(sequence, "boxes", None)
    if boxes is None or all(boxes(frame) is None for frame in sequence.frames):
        known = ", ".join(f"{row.boxes} ({row.name})" for row in READERS if row.boxes)
        raise InputError(f"{sequence.name}: no tracked boxes; expected one of {known}")
    recording = Recording(sequence, config, 1, frames, looks_around=True)
    for done, frame in enumerate(frames):
        if progress:
            progress("label", done, len(frames))
        try:
            label = _label(recording, boxes, frame)
        except (ComputationError, InputError) as error:
            yield frame, error
            continue
        if label is not None:
            yield frame, label


def _label(recording: Recording, boxes: Callable[[int], Boxes | None], frame: int) -> Label | None:
    """Return the label of a sweep, None if the sweep or its next sweep has no boxes."""
    stretch = recording.window(frame)
    following = next((other for other in stretch.frames if other > frame), None)
    source_boxes = boxes(frame)
    target_boxes = None if following is None else boxes(following)
    if following is None or source_boxes is None or target_boxes is None:
        return None
    registered, after = stretch[frame], stretch[following]
    field, sure = flow_of_boxes(registered, after, source_boxes, target_boxes)
    return Label(registered, after, field, sure, stretch.T_target_source(following, frame))


def write_label(folder: Path, label: Label, overwrite: bool) -> Path:
    """Write a label's flow file ``FRAME_NEXT.npz`` into a folder, and return its path.

    InputError is raised if the file exists and ``overwrite`` is False.
    """
    sweep, field = label.registered.sweep, label.field
    path = folder / f"{sweep.frame:06d}_{label.after.frame:06d}.npz"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: there already, kept; give --overwrite to replace it")
    total = poses.transform(label.T_after_sweep, sweep.points + field.total) - sweep.points
    # In the file ``total_flow`` includes ego-motion, and ``valid`` marks certain flow.
    data = flow_npz(field, row=sweep.row, total_flow=total, object=field.instance, valid=label.sure)
    write_file(path, data)
    return path


def flow_of_boxes(
    source: RegisteredSweep,
    after: RegisteredSweep,
    boxes: Boxes,
    next_boxes: Boxes,
    margins: BoxMargins | None = None,
) -> tuple[FlowField, Bool]:
    """Return the flow of the N points of one sweep to the next, by the boxes of both sweeps.

    Args:
        source: The sweep of the points.
        after: The next sweep, of which only pose and time are used.
        boxes: Boxes of ``source``.
        next_boxes: Boxes of ``after``; those of one object share the track name.
        margins: Margins around the boxes, None for the defaults.

    Returns:
        The flow with ego-motion removed, in the lidar frame of ``source``; ``instance`` is the row
            of the point's box, -1 for no box. Then the (N,) mask of points with certain flow. Flow
            is uncertain for points in two boxes, just outside a box, at the bottom of a moving box,
            in a box that the next sweep lacks, or in image areas without annotation.
    """
    margins = margins or BoxMargins()
    points = source.sweep.points
    field = FlowField.zero(len(points))
    num_inside = np.zeros(len(points), np.int64)  # number of boxes that hold each point
    is_near_box = np.zeros(len(points), bool)
    sure = _is_annotated(boxes.view, points)
    min_motion_m = _MOVES_M_S * (after.sweep.stamp_ns - source.sweep.stamp_ns) * 1e-9
    T_source_after = poses.inverse(source.T_world_lidar) @ after.T_world_lidar
    T_source_next_boxes = T_source_after @ _at_reference(next_boxes, after)
    next_pose = dict(zip(next_boxes.track, T_source_next_boxes, strict=True))
    for k, T_source_box in enumerate(_at_reference(boxes, source)):
        # Phase 1: points in the grown box, by their positions in the frame of the box
        rows = _rows_around(boxes, k, T_source_box, source, margins)
        in_box = poses.transform(poses.inverse(T_source_box), points[rows])
        outside_m = (np.abs(in_box) - boxes.size_m[k] / 2).max(axis=1)
        is_near_box[rows] |= outside_m <= margins.grown_m + margins.unsure_m
        inside = outside_m <= margins.grown_m
        rows, in_box = rows[inside], in_box[inside]
        num_inside[rows] += 1
        field.instance[rows] = k

        # Phase 2: the motion of these points with the box
        T_source_next_box = next_pose.get(boxes.track[k]) if boxes.track[k] else None
        if T_source_next_box is None:
            sure[rows] = False
        elif np.linalg.norm(T_source_next_box[:3, 3] - T_source_box[:3, 3]) >= min_motion_m:
            field.displacement[rows] = poses.transform(T_source_next_box, in_box) - points[rows]
            field.moving[rows] = True
            sure[rows[in_box[:, 2] < margins.foot_m - boxes.size_m[k, 2] / 2]] = False
    is_in_several = num_inside > 1
    sure &= ~is_in_several & ~(is_near_box & (num_inside == 0))
    field.displacement[is_in_several] = 0.0
    field.moving[is_in_several] = False
    return field, sure


def _rows_around(
    boxes: Boxes, k: int, T_lidar_box: Float, registered: RegisteredSweep, margins: BoxMargins
) -> Int:
    """Return the rows of the points that may be in box k or in the margins around this box."""
    sweep = registered.sweep
    reach_m = np.linalg.norm(boxes.size_m[k] / 2 + margins.grown_m + margins.unsure_m)
    offset_m = np.abs(sweep.points[:, :2] - T_lidar_box[:2, 3])
    rows: Int = np.flatnonzero((offset_m <= reach_m).all(axis=1))
    if boxes.lidar is not None and boxes.lidar[k] >= 0:  # drawn for one scanner
        rows = rows[sweep.lidar[rows] == boxes.lidar[k]]
    return rows


def _at_reference(boxes: Boxes, registered: RegisteredSweep) -> Float:
    """Return the box poses (K,4,4), lidar frame, deskewed to the sweep's reference time."""
    if boxes.offset_ns is None:
        return boxes.T_lidar_box
    offset_s = np.asarray(boxes.offset_ns[:, None] * 1e-9, np.float64)
    twist = np.where(offset_s < 0, registered.twist_before, registered.twist_after)
    return poses.exp(offset_s * twist) @ boxes.T_lidar_box


def _is_annotated(view: BoxView | None, points: Float) -> Bool:
    """Return the (N,) mask of points (N,3, lidar frame) in the annotated image area."""
    if view is None:
        return np.ones(len(points), bool)
    uv, visible = image_points(view.camera, poses.transform(view.camera.T_cam_lidar, points))
    with np.errstate(invalid="ignore"):
        for left, top, right, bottom in view.left_out_px:
            inside = (uv >= (left, top)) & (uv <= (right, bottom))
            visible &= ~inside.all(axis=1)
    return visible
