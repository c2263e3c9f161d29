# SPDX-License-Identifier: MIT
"""A run's movers.json, checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import ObjectTrack
from densify.outputs.export.fields import Fields


def read_tracks(path: Path) -> list[ObjectTrack]:
    """What `densify.outputs.tracks` wrote. Raises InputError, which says what is amiss where."""
    fields = Fields.of_file(path, "where moving objects were")
    return [_track(entry) for entry in fields.rows("objects")]


def _track(entry: Fields) -> ObjectTrack:
    poses = entry.rows("poses")
    if not poses:
        raise InputError(f"{entry.path}: {entry.prefix}poses: expected one or more")
    return ObjectTrack(
        instance=int(entry.number("instance", 0, 1 << 30)),
        size_m=entry.vector("size_m", 3),
        frames=tuple(int(pose.number("frame", 0, 1 << 31)) for pose in poses),
        stamp_ns=np.array([pose.whole("stamp_ns") for pose in poses], np.int64),
        T_key_object=np.stack([pose.pose("T_key_object") for pose in poses]),
        velocity_m_s=np.stack([pose.vector("velocity_m_s", 3) for pose in poses]),
        num_points=np.array([pose.whole("num_points") for pose in poses], np.int64),
    )
