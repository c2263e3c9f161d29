# SPDX-License-Identifier: MIT
"""Accumulation: the points of all sweeps at the key's moment, with where they come from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify import poses
from densify.types import Cloud, Float, FlowField, Window

_CONFIDENCE_PER_SWEEP = 0.07
_CONFIDENCE_MOVED = 0.8


def accumulate(window: Window, fields: Sequence[FlowField], drop_lost: bool) -> Cloud:
    """One cloud in the key frame from flow to the key.

    fields: of each sweep to the key. drop_lost: leave out what moves but could not be followed;
    otherwise it stays where registration puts it. Points that do not move are placed by
    registration alone, to the last bit.

    Confidence is a ranking, not a probability: it falls with the distance from the key and for
    points that flow had to move.
    """
    velocities_m_s = _velocities(window, fields)
    parts = []
    for registered, flow in zip(window.sweeps, fields, strict=True):
        sweep = registered.sweep
        kept = np.flatnonzero(~flow.lost) if drop_lost else np.arange(len(sweep))
        rigid = poses.transform(registered.T_key_lidar, sweep.points)
        points = rigid.copy()
        moves = flow.moving & ~flow.lost
        velocity_m_s = velocities_m_s[flow.instance] * moves[:, None]
        points[moves] += flow.total[moves] @ registered.T_key_lidar[:3, :3].T
        away = abs(registered.frame - window.key)
        confidence = np.full(len(sweep), max(0.1, 1 - _CONFIDENCE_PER_SWEEP * away))
        confidence[moves & (away > 0)] *= _CONFIDENCE_MOVED
        parts.append(
            {
                "points": points[kept],
                "rigid_points": rigid[kept],
                "frame": np.full(len(kept), registered.frame, np.int32),
                "row": sweep.row[kept],
                "moving": flow.moving[kept],
                "instance": flow.instance[kept],
                "velocity_m_s": velocity_m_s[kept].astype(np.float32),
                "confidence": confidence[kept].astype(np.float32),
                "intensity": sweep.intensity[kept],
                "rgb": np.zeros((len(kept), 3), np.uint8),
            }
        )
    return Cloud(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def _velocities(window: Window, fields: Sequence[FlowField]) -> Float:
    """(num_instances + 1, 3) m/s in the key frame at the key's moment; the last row, for points of
    no instance, is 0.

    An object's velocity is what brings it from the nearest sweep that shows it to the key; where
    the sweeps on both sides do, their mean.
    """
    key = window.frames.index(window.key)
    num_instances = 1 + max((int(f.instance.max(initial=-1)) for f in fields), default=-1)
    velocities = np.zeros((num_instances + 1, 3))
    for instance in range(num_instances):
        found: list[tuple[int, Float]] = []
        for i in sorted(range(len(fields)), key=lambda i: abs(i - key)):
            flow, registered = fields[i], window.sweeps[i]
            mine = (flow.instance == instance) & flow.moving & ~flow.lost
            if i == key or not mine.any():
                continue
            if found and abs(i - key) > found[0][0]:
                break
            late_ns = window.sweeps[key].sweep.stamp_ns - registered.sweep.stamp_ns
            moved = flow.displacement[mine].mean(0) @ registered.T_key_lidar[:3, :3].T
            found.append((abs(i - key), moved / (late_ns * 1e-9)))
        if found:
            velocities[instance] = np.mean([v for _, v in found], axis=0)
    return velocities
