# SPDX-License-Identifier: MIT
"""Writes the built-in street in the formats of data sets, with its exact truth.

To add a format, write a module with the function that `TreeWriter` describes and one row in
`FORMATS`. A test of its reader then has a recording of which everything is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from densify.config.errors import InputError
from densify.geometry.types import Progress
from densify.outputs.writers.excerpt import Excerpt
from densify.readers.street import Street

FORMATS = {
    "kitti": "densify.outputs.writers.kitti_raw",
    "folder": "densify.outputs.writers.folder",
    "ros1": "densify.outputs.writers.ros1",
    "ros2": "densify.outputs.writers.ros2",
    "argoverse2": "densify.outputs.writers.argoverse2",
    "kitti-odometry": "densify.outputs.writers.kitti_odometry",
    "kitti-tracking": "densify.outputs.writers.kitti_tracking",
    "kitti-360": "densify.outputs.writers.kitti_360",
    "nuscenes": "densify.outputs.writers.nuscenes",
    "opensceneflow": "densify.outputs.writers.open_scene_flow",
    "waymo": "densify.outputs.writers.waymo",
    "dgp": "densify.outputs.writers.dgp",
    "pandaset": "densify.outputs.writers.pandaset",
}
"""Name in ``densify simulate --format`` -> module."""


class TreeWriter(Protocol):
    """What the module of a format has; and ``CAMERA_NAMES``, which of the street's cameras it has
    room for, where that is not all of them."""

    def write_tree(self, excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
        """Write the excerpt below ``out``; return the place that ``--data`` opens, which is
        complete or not there. The truth lies beside the data, as `Excerpt.write_truth` makes it.

        Raises InputError for what the format cannot hold, and for a place that is there already
        unless ``overwrite`` is set.
        """
        ...


def write_street(
    format: str,
    street: Street,
    out: Path,
    frames: Sequence[int],
    cameras: Sequence[str] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Write frames of a street in a data set's format and return the place that ``--data`` opens.

    format: a row of `FORMATS`. frames: absolute numbers. cameras: names; None for all that the
    format has room for. progress: called with "simulate", frames done, frames in all. Raises
    InputError as `TreeWriter.write_tree`, and for a format, frame or camera that does not exist.
    """
    if format not in FORMATS:
        raise InputError(f"--format {format}: expected one of {', '.join(FORMATS)}")
    module = import_module(FORMATS[format])
    if cameras is None:
        room = getattr(module, "CAMERA_NAMES", street.cameras)
        cameras = [name for name in street.cameras if name in room] or [*street.cameras]
    excerpt, writer = Excerpt.of(street, frames, cameras, progress), cast(TreeWriter, module)
    try:
        place = writer.write_tree(excerpt, out, overwrite)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error
    excerpt.tell(len(excerpt.frames))
    return place
