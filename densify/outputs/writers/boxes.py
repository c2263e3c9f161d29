# SPDX-License-Identifier: MIT
"""Boxes around a street's objects, as somebody would draw them who looks at the sweeps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Bool, Float, Int
from densify.outputs.writers.excerpt import Excerpt

_MIN_RETURNS = 5


@dataclass(frozen=True)
class DrawnBoxes:
    """The K boxes of one sweep.

    instance: (K,) of the street. T_world_box: (K,4,4) where each was when the sweep's rays met it
    on average, at met_ns (K,). size_m: (K,3). moving: (K,) bool, then.
    """

    instance: Int
    T_world_box: Float
    size_m: Float
    met_ns: Int
    moving: Bool


def drawn_boxes(excerpt: Excerpt, frame: int, lidar: int | None = None) -> DrawnBoxes:
    """Boxes of all objects with 5 returns or more in the sweep; a box has the size of all it holds
    at that moment. lidar: of returns of that scanner alone."""
    street, returns = excerpt.street, excerpt.returns(frame)
    bodies = street.simulator.scene.world.bodies
    met = np.isin(returns.instance, [b.instance for b in bodies if b.instance >= 0])
    if lidar is not None:
        met &= returns.lidar == lidar
    found, row, times = np.unique(returns.instance[met], return_inverse=True, return_counts=True)
    late_ns = np.bincount(row, returns.offset_ns[met]) / times
    seen = times >= _MIN_RETURNS
    instances = found[seen].astype(np.int64)
    met_ns = street.stamp_ns(frame) + np.rint(late_ns[seen]).astype(np.int64)
    T_world_box, size_m = np.zeros((len(instances), 4, 4)), np.zeros((len(instances), 3))
    moving = np.zeros(len(instances), bool)
    for k, instance in enumerate(instances):
        parts = [i for i, b in enumerate(bodies) if b.instance == instance]
        then = street.simulator.bodies_at([int(met_ns[k])], parts)
        T_world_main = then.T_world_body[0, 0]
        T_main_world = poses.inverse(T_world_main)
        corners = np.concatenate(
            [
                poses.transform(T_main_world @ T_world_part, bodies[i].mesh.vertices)
                for i, T_world_part in zip(parts, then.T_world_body[0], strict=True)
            ]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        T_main_box = np.eye(4)
        T_main_box[:3, 3] = (low + high) / 2
        T_world_box[k], size_m[k] = T_world_main @ T_main_box, high - low
        moving[k] = then.moving[0, 0]
    return DrawnBoxes(instances, T_world_box, size_m, met_ns, moving)
