# SPDX-License-Identifier: MIT
"""Writes a street as a ROS 2 bag, see `densify.outputs.writers.ros_bag`: OUT/street_ros2/."""

from __future__ import annotations

from pathlib import Path

from densify.outputs.writers.excerpt import Excerpt
from densify.outputs.writers.ros_bag import write_bag


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`."""
    place = out / "street_ros2"
    return write_bag(excerpt, place, overwrite, is_ros2=True)
