# SPDX-License-Identifier: MIT
"""Writes a street as OpenSceneFlow preprocesses recordings, with its truth beside it, see
`densify.readers.open_scene_flow.reader`::

    OUT/street/street.h5    lidar, lidar_id, lidar_dt, lidar_center, pose, ground_mask; of all but
                            the last sweep flow, flow_is_valid, flow_category_indices,
                            flow_instance_id, ego_motion
    OUT/street/truth/       as in `densify.readers.truth_files`

Stamps are in nanoseconds, in the middle of the sweeps. There is no room for images.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.poses import inverse, transform
from densify.outputs.writers.excerpt import Excerpt, new_folder, put
from densify.readers.extras import needed

_GROUND_M = 0.25
_REGULAR_VEHICLE = 19  # of Argoverse 2's categories, which the files use


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. Cameras are left out."""
    h5py = needed("h5py", "opensceneflow", "OpenSceneFlow recordings")
    excerpt = replace(excerpt, cameras=())
    with new_folder(out / "street", overwrite) as folder:
        buffer = io.BytesIO()
        with h5py.File(buffer, "w") as file:
            for number, frame in excerpt.numbered():
                group = file.create_group(str(excerpt.street.stamp_ns(frame)))
                for name, array in _sweep(excerpt, frame).items():
                    group.create_dataset(name, data=array)
                if number + 1 < len(excerpt.frames):
                    for name, array in _flow(excerpt, frame, excerpt.frames[number + 1]).items():
                        group.create_dataset(name, data=array)
        put(folder / "street.h5", buffer.getvalue())
        excerpt.write_truth(folder / "truth", [excerpt.street.stamp_ns(f) for f in excerpt.frames])
    return out / "street"


def _sweep(excerpt: Excerpt, frame: int) -> dict[str, Any]:
    simulator, returns = excerpt.street.simulator, excerpt.returns(frame)
    fired = returns.points.astype(np.float64)
    stamp_ns = simulator.stamp_ns(frame)
    points = excerpt.poses().compensated(fired, stamp_ns, returns.offset_ns)
    in_world = transform(simulator.T_world_lidar_at(stamp_ns), points)
    above_m = in_world[:, 2] - simulator.scene.ground.terrain.height(in_world[:, :2])
    origins = np.tile(np.eye(4), (len(simulator.sensor.scanners), 1, 1))
    origins[:, :3, 3] = simulator.sensor.origins_m
    return {
        "lidar": np.column_stack([points, returns.intensity * 255]).astype(np.float32),
        "lidar_id": returns.lidar,
        "lidar_dt": (returns.offset_ns * 1e-9).astype(np.float32),
        "lidar_center": origins.astype(np.float32),
        "pose": simulator.T_world_lidar_at(stamp_ns),
        "ground_mask": (returns.body == 0) & (above_m < _GROUND_M),
    }


def _flow(excerpt: Excerpt, frame: int, target: int) -> dict[str, Any]:
    truth, returns = excerpt.street.truth, excerpt.returns(frame)
    stamps_ns = [excerpt.street.stamp_ns(f) for f in (frame, target)]
    fired = returns.points.astype(np.float64)
    points = excerpt.poses().compensated(fired, stamps_ns[0], returns.offset_ns)
    T_world_here, T_world_there = excerpt.T_world_ego(np.array(stamps_ns))
    T_there_here = inverse(T_world_there) @ T_world_here
    arrived = transform(T_there_here, points + truth.displacement(frame, target))
    moving = truth.sweep(frame).moving
    return {
        "flow": (arrived - points).astype(np.float32),
        "flow_is_valid": np.ones(len(points), bool),
        "flow_category_indices": np.where(moving, _REGULAR_VEHICLE, 0).astype(np.uint8),
        "flow_instance_id": np.where(moving, returns.instance + 1, 0).astype(np.int16),
        "ego_motion": T_there_here.astype(np.float32),
    }
