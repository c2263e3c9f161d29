# SPDX-License-Identifier: MIT
"""Boxes around a street's objects, as somebody would draw them who looks at the sweeps."""

from __future__ import annotations

import numpy as np

from densify.geometry import poses
from densify.types import Boxes, Float
from densify.writers.excerpt import Excerpt

_MIN_RETURNS = 5


def drawn_boxes(excerpt: Excerpt, frame: int, T_world_ego: Float) -> Boxes:
    """Boxes of all objects with 5 returns or more in the sweep, each where the object was when the
    sweep's rays met it on average; a box has the size of all it holds at that moment.

    T_world_ego: (4,4) the frame in which the boxes are told, at the sweep's reference time.
    """
    street, returns = excerpt.street, excerpt.returns(frame)
    bodies = street.simulator.scene.world.bodies
    track, T_ego_box, size_m = [], [], []
    for instance in sorted({b.instance for b in bodies if b.instance >= 0}):
        mine = returns.instance == instance
        if mine.sum() < _MIN_RETURNS:
            continue
        met_ns = street.stamp_ns(frame) + round(float(returns.offset_ns[mine].mean()))
        at = street.simulator.bodies_at([met_ns]).T_world_body[0]
        parts = [i for i, b in enumerate(bodies) if b.instance == instance]
        T_main_world = poses.inverse(at[parts[0]])
        corners = np.concatenate(
            [poses.transform(T_main_world @ at[i], bodies[i].mesh.vertices) for i in parts]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        T_main_box = np.eye(4)
        T_main_box[:3, 3] = (low + high) / 2
        track.append(instance)
        T_ego_box.append(poses.inverse(T_world_ego) @ at[parts[0]] @ T_main_box)
        size_m.append(high - low)
    return Boxes(
        np.array(track, np.int64), np.reshape(T_ego_box, (-1, 4, 4)), np.reshape(size_m, (-1, 3))
    )
