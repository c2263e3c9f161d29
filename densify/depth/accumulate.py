# SPDX-License-Identifier: MIT
"""Accumulation: the points of all sweeps at the key's moment, with where they come from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Cloud, FlowField, Int, Stretch

_CONFIDENCE_PER_S = 0.7
_CONFIDENCE_MOVED = 0.8


def accumulate(stretch: Stretch, fields: Sequence[FlowField], key: int, drop_lost: bool) -> Cloud:
    """One cloud in the key frame from flow to the key.

    fields: of each sweep to the key. key: its frame. drop_lost: leave out what moves but could not
    be followed; otherwise it stays where registration puts it. Points that do not move are placed
    by registration alone, to the last bit.

    Confidence is a relative score, not calibrated: it falls with the time from the key and for
    points that flow had to move.
    """
    parts = []
    for registered, flow in zip(stretch.sweeps, fields, strict=True):
        sweep = registered.sweep
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        kept: Int | slice = slice(None)
        num_kept = len(sweep)
        if drop_lost and flow.lost.any():
            kept = np.flatnonzero(~flow.lost)
            num_kept = len(kept)
        rigid = poses.transform(T_key_lidar, sweep.points)
        points = rigid.copy()
        moves = flow.moving & ~flow.lost
        points[moves] += poses.rotate(T_key_lidar, flow.total[moves])
        velocity_m_s = np.zeros(points.shape, np.float32)
        if flow.velocity_m_s is not None:
            velocity_m_s[moves] = poses.rotate(T_key_lidar, flow.velocity_m_s[moves])
        since_key_ns = sweep.stamp_ns - stretch[key].sweep.stamp_ns
        own = max(0.1, 1 - _CONFIDENCE_PER_S * abs(since_key_ns) * 1e-9)
        confidence = np.full(len(sweep), own)
        confidence[moves & (registered.frame != key)] *= _CONFIDENCE_MOVED
        parts.append(
            {
                "points": points[kept],
                "rigid_points": rigid[kept],
                "frame": np.full(num_kept, registered.frame, np.int32),
                "since_key_ns": np.full(num_kept, since_key_ns, np.int64),
                "row": sweep.row[kept],
                "lidar": sweep.lidar[kept],
                "moving": flow.moving[kept],
                "instance": flow.instance[kept],
                "velocity_m_s": velocity_m_s[kept],
                "confidence": confidence[kept].astype(np.float32),
                "intensity": sweep.intensity[kept],
                "rgb": np.zeros((num_kept, 3), np.uint8),
                "far": np.zeros(num_kept, bool),
            }
        )
    return Cloud(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})
