# SPDX-License-Identifier: MIT
"""Accumulate the sweeps' points at the key sweep's reference time, and fit tracks of objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.depth.confidence import confidence_by_age
from densify.flow.tracking.objects import LONG_M
from densify.geometry import poses
from densify.geometry.types import (
    Cloud,
    Float,
    FlowField,
    ObjectTrack,
    Stretch,
)

_LEAST_SEEN = 3  # points of an object in one sweep; fewer do not determine its rotation
_AXLE = 0.3  # of the length, from the middle of a vehicle to its rear axle, which does not slip
_BEYOND_PERCENT = 0.2  # percent of the points outside the object's box, on each side


def accumulate(stretch: Stretch, fields: Sequence[FlowField], key: int, drop_lost: bool) -> Cloud:
    """Return the points of all sweeps as one cloud in the lidar frame of the key sweep.

    Moving points are displaced by their scene flow, ``fields``, from each sweep to the key sweep's
    reference time. Static points keep their rigid positions, bit for bit. Moving points that cannot
    be followed to the key sweep are left out with ``drop_lost``, else they keep their rigid
    positions.
    """
    kept = [np.flatnonzero(~(drop_lost & flow.lost)) for flow in fields]
    cloud, first = _empty_cloud(sum(map(len, kept))), 0
    for registered, flow, rows in zip(stretch.sweeps, fields, kept, strict=True):
        span = slice(first, first + len(rows))
        first, sweep = span.stop, registered.sweep
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        cloud.rigid_points[span] = poses.transform(T_key_lidar, sweep.points).take(rows, axis=0)
        cloud.points[span] = cloud.rigid_points[span]
        since_key_ns = sweep.stamp_ns - stretch[key].sweep.stamp_ns
        cloud.frame[span], cloud.since_key_ns[span] = registered.frame, since_key_ns
        cloud.intensity[span] = sweep.intensity[rows]
        cloud.row[span], cloud.lidar[span] = sweep.row[rows], sweep.lidar[rows]
        cloud.moving[span], cloud.instance[span] = flow.moving[rows], flow.instance[rows]

        moving = np.flatnonzero((flow.moving & ~flow.lost)[rows])
        cloud_rows, rows = span.start + moving, rows[moving]
        cloud.points[cloud_rows] += poses.rotate(T_key_lidar, flow.total[rows])
        if flow.velocity_m_s is not None:
            cloud.velocity_m_s[cloud_rows] = poses.rotate(T_key_lidar, flow.velocity_m_s[rows])
    cloud.confidence[:] = confidence_by_age(cloud.since_key_ns)
    return cloud


def _empty_cloud(num: int) -> Cloud:
    """Return a cloud of ``num`` points of the window, to be filled in."""
    return Cloud(
        points=np.empty((num, 3)),
        rigid_points=np.empty((num, 3)),
        frame=np.empty(num, np.int32),
        since_key_ns=np.empty(num, np.int64),
        row=np.empty(num, np.int64),
        lidar=np.empty(num, np.uint8),
        moving=np.empty(num, bool),
        instance=np.empty(num, np.int32),
        velocity_m_s=np.zeros((num, 3), np.float32),
        confidence=np.empty(num, np.float32),
        intensity=np.empty(num, np.float32),
        rgb=np.zeros((num, 3), np.uint8),
        far=np.zeros(num, bool),
    )


class _ObjectPoints(NamedTuple):
    """The N points of an object in one sweep, key sweep's lidar frame."""

    at_sweep: Float  # (N,3) positions in metres at the reference time of this sweep
    at_key: Float  # (N,3) positions in metres at the reference time of the key sweep
    velocity_m_s: Float  # (3,) median velocity of the points


def object_tracks(
    stretch: Stretch, fields: Sequence[FlowField], key: int
) -> tuple[ObjectTrack, ...]:
    """Return the track of each moving object, ordered by instance number.

    The pose at a sweep comes from the rigid motion that best fits, in least squares, the flow of
    the object's points to the key sweep. Sweeps with fewer than three of these points have no pose.
    Objects without such a sweep are left out. The x axis of an object points along its velocity, or
    along its path over the window if that is longer. For objects of 3 m and more these are taken at
    the rear axle, where a vehicle that turns moves where it points. The arguments are as in
    `accumulate`.
    """
    objects: dict[int, dict[int, _ObjectPoints]] = {}
    for registered, flow in zip(stretch.sweeps, fields, strict=True):
        followed = flow.moving & ~flow.lost & (flow.instance >= 0)
        if not followed.any():
            continue
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        instance = flow.instance[followed]
        points = registered.sweep.points[followed]
        if flow.to_reference is not None:
            points = points + flow.to_reference[followed]
        at_sweep = poses.transform(T_key_lidar, points)
        at_key = at_sweep + poses.rotate(T_key_lidar, flow.displacement[followed])
        velocity_m_s = np.zeros(points.shape)
        if flow.velocity_m_s is not None:
            velocity_m_s = poses.rotate(T_key_lidar, flow.velocity_m_s[followed])
        for k in np.unique(instance).tolist():
            in_object = instance == k
            median_m_s = np.median(velocity_m_s[in_object], axis=0)
            objects.setdefault(k, {})[registered.frame] = _ObjectPoints(
                at_sweep[in_object], at_key[in_object], median_m_s
            )
    stamps_ns = {s.frame: s.sweep.stamp_ns for s in stretch.sweeps}
    return tuple(
        _track(k, objects[k], key, stamps_ns)
        for k in sorted(objects)
        if max(len(s.at_sweep) for s in objects[k].values()) >= _LEAST_SEEN
    )


def _track(
    instance: int, by_frame: dict[int, _ObjectPoints], key: int, stamps_ns: dict[int, int]
) -> ObjectTrack:
    """Return the track of an object from its points and the sweeps' reference times by frame."""
    at_key = np.concatenate([s.at_key for s in by_frame.values()])
    # Motion of the object from the key to each sweep, in the key sweep's lidar frame.
    T_sweep_key = {
        frame: poses.fit_rigid(s.at_key, s.at_sweep)
        for frame, s in by_frame.items()
        if len(s.at_sweep) >= _LEAST_SEEN
    }
    T_sweep_key[key] = np.eye(4)
    frames = sorted(T_sweep_key)
    velocity_m_s = np.median([s.velocity_m_s for s in by_frame.values()], axis=0)
    middle = np.median(at_key, axis=0)
    ends = [poses.transform(T_sweep_key[f], middle[None])[0] for f in (frames[0], frames[-1])]
    duration_s = (stamps_ns[frames[-1]] - stamps_ns[frames[0]]) * 1e-9
    direction = velocity_m_s * duration_s if duration_s else velocity_m_s
    direction = max(direction, ends[1] - ends[0], key=lambda xyz: float(np.hypot(*xyz[:2])))
    yaw_first, yaw_last = (poses.log(T_sweep_key[f])[2] for f in (frames[0], frames[-1]))
    for _ in range(2):
        heading = np.arctan2(direction[1], direction[0])
        T_key_object = poses.exp(np.array([0, 0, heading, 0, 0, 0]))
        in_axes = poses.rotate(poses.inverse(T_key_object), at_key)
        low, high = np.percentile(in_axes, [_BEYOND_PERCENT, 100 - _BEYOND_PERCENT], axis=0)
        if high[0] - low[0] < LONG_M:
            break
        axle = (low + high) / 2 - [_AXLE * (high[0] - low[0]), 0, 0]
        x, y, _ = T_key_object[:3, :3] @ axle - middle
        middle = middle + [x, y, 0]
        direction = direction + (yaw_last - yaw_first) * np.array([-y, x, 0])
    T_key_object[:3, 3] = T_key_object[:3, :3] @ ((low + high) / 2)
    T = np.stack([T_sweep_key[frame] @ T_key_object for frame in frames])
    stamp_ns = np.array([stamps_ns[frame] for frame in frames], np.int64)
    speeds_m_s = velocity_m_s[None]
    if len(frames) > 1:
        speeds_m_s = np.gradient(T[:, :3, 3], (stamp_ns - stamps_ns[key]) * 1e-9, axis=0)
    num_points = [len(by_frame[f].at_sweep) if f in by_frame else 0 for f in frames]
    return ObjectTrack(
        instance=instance,
        size_m=high - low,
        frames=tuple(frames),
        stamp_ns=stamp_ns,
        T_key_object=T,
        velocity_m_s=speeds_m_s,
        num_points=np.array(num_points, np.int64),
        seen_size_m=high - low,
    )
