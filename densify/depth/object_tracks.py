# SPDX-License-Identifier: MIT
"""Where each moving object was at every sweep of a window, read off the flow to the key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, FlowField, ObjectTrack, Stretch

_LEAST_POINTS = 10  # of an object in all sweeps
_LEAST_SEEN = 3  # of it in one sweep: fewer do not tell how it is turned
_PERCENTILES = (1.0, 99.0)
_LEAST_SPEED_M_S = 0.3  # below, it points to where it went over the window
_HOLD = 1e-6  # against turning about what the points do not tell, a line they lie on


class _Sighting(NamedTuple):
    """The N points that one sweep has of an object, key coordinates. there, at_key: (N,3) at the
    sweep's reference time and at the key's. velocity_m_s: (3,) at the key's."""

    there: Float
    at_key: Float
    velocity_m_s: Float


def object_tracks(
    stretch: Stretch, fields: Sequence[FlowField], key: int
) -> tuple[ObjectTrack, ...]:
    """The objects with ten points or more, by instance.

    fields: of each sweep to the key. The pose at a sweep is the rigid motion nearest in least
    squares (Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976) to how
    its points get to the key; sweeps with fewer than three points of it are left out.
    """
    seen: dict[int, dict[int, _Sighting]] = {}
    for registered, flow in zip(stretch.sweeps, fields, strict=True):
        follows = flow.moving & ~flow.lost & (flow.instance >= 0)
        if not follows.any():
            continue
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        instance = flow.instance[follows]
        points = registered.sweep.points[follows]
        if flow.to_reference is not None:
            points = points + flow.to_reference[follows]
        there = poses.transform(T_key_lidar, points)
        at_key = there + poses.rotate(T_key_lidar, flow.displacement[follows])
        velocity_m_s = np.zeros(points.shape)
        if flow.velocity_m_s is not None:
            velocity_m_s = poses.rotate(T_key_lidar, flow.velocity_m_s[follows])
        for k in np.unique(instance).tolist():
            own = instance == k
            middle_m_s = np.median(velocity_m_s[own], axis=0)
            seen.setdefault(k, {})[registered.frame] = _Sighting(
                there[own], at_key[own], middle_m_s
            )
    stamps_ns = {s.frame: s.sweep.stamp_ns for s in stretch.sweeps}
    return tuple(
        _track(k, seen[k], key, stamps_ns)
        for k in sorted(seen)
        if sum(len(s.there) for s in seen[k].values()) >= _LEAST_POINTS
    )


def _track(
    instance: int, seen: dict[int, _Sighting], key: int, stamps_ns: dict[int, int]
) -> ObjectTrack:
    at_key = np.concatenate([s.at_key for s in seen.values()])
    T_there_key = {
        frame: _rigid(s.at_key, s.there) for frame, s in seen.items() if len(s.there) >= _LEAST_SEEN
    }
    T_there_key[key] = np.eye(4)
    frames = sorted(T_there_key)
    velocity_m_s = np.median([s.velocity_m_s for s in seen.values()], axis=0)
    way = velocity_m_s
    if np.hypot(*way[:2]) < _LEAST_SPEED_M_S:
        middle = np.median(at_key, axis=0)
        ends = [poses.transform(T_there_key[f], middle[None])[0] for f in (frames[0], frames[-1])]
        way = ends[1] - ends[0]
    heading = np.arctan2(way[1], way[0])
    T_key_object = poses.exp(np.array([0, 0, heading, 0, 0, 0]))
    body = poses.rotate(poses.inverse(T_key_object), at_key)
    low, high = np.percentile(body, _PERCENTILES, axis=0)
    T_key_object[:3, 3] = T_key_object[:3, :3] @ ((low + high) / 2)
    T = np.stack([T_there_key[frame] @ T_key_object for frame in frames])
    stamp_ns = np.array([stamps_ns[frame] for frame in frames], np.int64)
    speeds_m_s = velocity_m_s[None]
    if len(frames) > 1:
        speeds_m_s = np.gradient(T[:, :3, 3], (stamp_ns - stamps_ns[key]) * 1e-9, axis=0)
    return ObjectTrack(
        instance=instance,
        size_m=high - low,
        frames=tuple(frames),
        stamp_ns=stamp_ns,
        T_key_object=T,
        velocity_m_s=speeds_m_s,
        num_points=np.array([len(seen[f].there) if f in seen else 0 for f in frames], np.int64),
    )


def _rigid(source: Float, target: Float) -> Float:
    """(4,4) the rigid motion that brings (N,3) points nearest to others."""
    from_m, to_m = source.mean(axis=0), target.mean(axis=0)
    # einsum and not BLAS: the same sums whatever the number of threads.
    spread = np.einsum("ni,nj->ij", target - to_m, source - from_m)
    spread += _HOLD * np.square(source - from_m).sum() * np.eye(3)
    left, _, right = np.linalg.svd(spread)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, to_m - turn @ from_m
    return T
