# SPDX-License-Identifier: MIT
"""A street as OpenSceneFlow preprocesses recordings, see `densify.readers.open_scene_flow`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float
from writers.excerpt import Excerpt

_REGULAR_VEHICLE = 19  # of Argoverse 2's categories, which the files use


def write_open_scene_flow(excerpt: Excerpt, out: Path) -> Path:
    import h5py

    excerpt = replace(excerpt, cameras=())
    frames, folder = excerpt.frames, out / "street"
    folder.mkdir(parents=True)
    with h5py.File(folder / "street.h5", "w") as file:
        for frame, target in zip(frames, (*frames[1:], None), strict=True):
            group = file.create_group(str(excerpt.street.stamp_ns(frame)))
            for name, array in _sweep(excerpt, frame).items():
                group.create_dataset(name, data=array)
            for name, array in _flow(excerpt, frame, target).items() if target else ():
                group.create_dataset(name, data=array)
    excerpt.write_truth(folder / "truth", [excerpt.street.stamp_ns(f) for f in frames])
    return folder


def _points(excerpt: Excerpt, frame: int) -> Float:
    """(N,3) at the stamp, carried there by the vehicle's motion."""
    stamp_ns, offset_ns = excerpt.street.stamp_ns(frame), excerpt.returns(frame).offset_ns
    return excerpt.poses().compensated(excerpt.fired(frame), stamp_ns, offset_ns)


def _sweep(excerpt: Excerpt, frame: int) -> dict[str, Any]:
    returns, points = excerpt.returns(frame), _points(excerpt, frame)
    origins_m = excerpt.street.simulator.sensor.origins_m
    mounts = np.tile(np.eye(4), (len(origins_m), 1, 1))
    mounts[:, :3, 3] = origins_m
    return {
        "lidar": np.column_stack([points, returns.intensity * 255]).astype(np.float32),
        "lidar_id": returns.lidar,
        "lidar_dt": (returns.offset_ns * 1e-9).astype(np.float32),
        "lidar_center": mounts.astype(np.float32),
        "pose": excerpt.pose(excerpt.street.stamp_ns(frame)),
        "ground_mask": np.zeros(len(points), bool),
    }


def _flow(excerpt: Excerpt, frame: int, target: int) -> dict[str, Any]:
    truth, points = excerpt.street.truth, _points(excerpt, frame)
    T_world_here, T_world_there = (
        excerpt.pose(excerpt.street.stamp_ns(f)) for f in (frame, target)
    )
    there = points + truth.displacement(frame, target)
    arrived = transform(inverse(T_world_there) @ T_world_here, there)
    moving, instance = truth.sweep(frame).moving, excerpt.returns(frame).instance
    return {
        "flow": (arrived - points).astype(np.float32),
        "flow_is_valid": np.ones(len(points), bool),
        "flow_category_indices": np.where(moving, _REGULAR_VEHICLE, 0).astype(np.uint8),
        "flow_instance_id": np.where(moving, instance + 1, 0).astype(np.int16),
    }
