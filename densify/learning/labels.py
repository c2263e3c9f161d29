# SPDX-License-Identifier: MIT
"""Make scene flow labels from tracked boxes: the flow of each sweep to the next sweep."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.config import Config
from densify.config.errors import ComputationError, InputError
from densify.config.plugins import READERS
from densify.geometry import poses
from densify.geometry.types import Bool, Boxes, FlowField, LidarSequence, Progress, RegisteredSweep
from densify.learning.boxes import flow_of_boxes
from densify.outputs.atomic import write_file
from densify.outputs.flow_writers import flow_npz
from densify.pipeline.recording import Recording


@dataclass(frozen=True)
class Label:
    """The scene flow label of one sweep with N points."""

    registered: RegisteredSweep
    after: RegisteredSweep  # the next sweep
    field: FlowField  # flow to the next sweep, in the sweep's lidar frame, ego-motion removed
    sure: Bool  # (N,) True for points whose flow is certain
    # (4,4) from the lidar frame of the sweep to the lidar frame of the next sweep
    T_next_here: np.ndarray


def label_sweeps(
    sequence: LidarSequence, frames: Sequence[int], config: Config, progress: Progress | None = None
) -> Iterator[tuple[int, Label | ComputationError | InputError]]:
    """Yield (frame number, label) of each sweep, or (frame number, error) if labelling fails.

    Sweeps without a next sweep or without boxes are left out. ``config`` chooses the poses.
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
    stretch = recording.window(frame)
    following = [f for f in stretch.frames if f > frame]
    if not following:
        return None
    source_boxes, target_boxes = boxes(frame), boxes(following[0])
    if source_boxes is None or target_boxes is None:
        return None
    registered, after = stretch[frame], stretch[following[0]]
    field, sure = flow_of_boxes(registered, after, source_boxes, target_boxes)
    T_next_here = stretch.T_target_source(following[0], frame)
    return Label(registered, after, field, sure, T_next_here)


def write_label(folder: Path, label: Label, overwrite: bool) -> Path:
    """Write the label's flow file ``FRAME_NEXT.npz`` into a folder and return its path."""
    sweep, field = label.registered.sweep, label.field
    path = folder / f"{sweep.frame:06d}_{label.after.frame:06d}.npz"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: there already, kept; give --overwrite to replace it")
    arrived = poses.transform(label.T_next_here, sweep.points + field.total)
    total = arrived - sweep.points
    # total_flow includes ego-motion, valid marks certain flow
    data = flow_npz(field, row=sweep.row, total_flow=total, object=field.instance, valid=label.sure)
    write_file(path, data)
    return path
