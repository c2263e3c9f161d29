# SPDX-License-Identifier: MIT
"""The output of where moving objects were, movers.json.

::

    schema_version, key
    objects     each a `ObjectTrack`:
      instance  as in cloud.laz and movers/
      size_m    length, width, height of the box around its points, in its own frame: x to where it
                moves at the key's moment, y to its left, z along the key's, origin in the box's
                middle
      poses     at the reference time of each sweep that saw it, and at the key's: frame, stamp_ns,
                num_points of that sweep, T_key_object (4,4), velocity_m_s (3,); key coordinates,
                the vehicle's own motion removed
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from densify.geometry.types import ObjectTrack, Result
from densify.outputs.context import Context
from densify.outputs.plain import write_json

SCHEMA_VERSION = 1


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``movers.json``; nothing for results that know no poses."""
    if not result.T_key_lidar:
        return
    write_json(folder / "movers.json", tracks_table(result.key, result.tracks))


def tracks_table(key: int, tracks: Sequence[ObjectTrack]) -> dict[str, Any]:
    """The content of movers.json."""
    return {
        "schema_version": SCHEMA_VERSION,
        "key": key,
        "objects": [_object(track) for track in tracks],
    }


def _object(track: ObjectTrack) -> dict[str, Any]:
    poses = [
        {
            "frame": frame,
            "stamp_ns": track.stamp_ns[i],
            "num_points": track.num_points[i],
            "T_key_object": track.T_key_object[i],
            "velocity_m_s": track.velocity_m_s[i],
        }
        for i, frame in enumerate(track.frames)
    ]
    return {"instance": track.instance, "size_m": track.size_m, "poses": poses}
