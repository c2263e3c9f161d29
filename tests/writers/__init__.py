# SPDX-License-Identifier: MIT
"""Streets in the formats of data sets, with exact truth: what the readers must give back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from densify.outputs import simulated_street
from densify.readers.street import Street
from writers.argoverse2 import write_argoverse2
from writers.dgp import write_dgp
from writers.excerpt import Excerpt
from writers.kitti import write_kitti_360, write_odometry, write_tracking
from writers.nuscenes import write_nuscenes
from writers.pandaset import write_pandaset
from writers.ros import write_ros1, write_ros2
from writers.waymo import write_waymo

WRITERS = {
    "ros1": write_ros1,
    "ros2": write_ros2,
    "argoverse2": write_argoverse2,
    "kitti-odometry": write_odometry,
    "kitti-tracking": write_tracking,
    "kitti-360": write_kitti_360,
    "nuscenes": write_nuscenes,
    "waymo": write_waymo,
    "dgp": write_dgp,
    "pandaset": write_pandaset,
}
FORMATS = (*simulated_street.FORMATS, *WRITERS)


def write_street(
    format: str,
    street: Street,
    out: Path,
    frames: Sequence[int],
    cameras: Sequence[str] | None = None,
) -> Path:
    """Write frames of a street and return the place that ``--data`` opens.

    format: one of `FORMATS`. cameras: None for all of the street.
    """
    if format in WRITERS:
        return WRITERS[format](Excerpt.of(street, frames, cameras), out)
    return simulated_street.write_street(format, street, out, frames, cameras)
