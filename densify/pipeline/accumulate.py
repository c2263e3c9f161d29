# SPDX-License-Identifier: MIT
"""Accumulate the sweeps' points at the key sweep's reference time, and fit tracks of objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.depth.confidence import confidence_by_age
from densify.flow.tracking.objects import LONG_M
from densify.geometry import poses
from densify.geometry.types import Cloud, Float, FlowField, ObjectTrack, Stretch

_LEAST_POINTS = 3  # points of an object in one sweep; fewer do not determine its rotation
_AXLE = 0.3  # from the middle of a vehicle to its rear axle, as a share of its length
_OUTLIER_PERCENT = 0.2  # percent of the points outside the object's box, on each side


def accumulate(stretch: Stretch, fields: Sequence[FlowField], key: int, drop_lost: bool) -> Cloud:
    """Return the points of all sweeps as one cloud in the lidar frame of the key sweep.

    Moving points are displaced by their scene flow from each sweep to the key sweep's reference
    time. Static points keep their rigid positions, bit for bit.

    Args:
        stretch: Registered, deskewed sweeps.
        fields: Flow of each sweep's points to the key sweep.
        key: Frame number of the key sweep.
        drop_lost: Leave out moving points that cannot be followed to the key sweep, else they keep
            their rigid positions.
    """
    used_rows = [np.flatnonzero(~(drop_lost & flow.lost)) for flow in fields]
    cloud = _empty_cloud(sum(map(len, used_rows)))
    begin_row = 0  # row of the cloud at which the sweep's points begin
    for registered, flow, rows in zip(stretch.sweeps, fields, used_rows, strict=True):
        span = slice(begin_row, begin_row + len(rows))
        sweep = registered.sweep
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        cloud.rigid_points[span] = poses.transform(T_key_lidar, sweep.points).take(rows, axis=0)
        cloud.points[span] = cloud.rigid_points[span]
        cloud.frame[span] = registered.frame
        cloud.since_key_ns[span] = sweep.stamp_ns - stretch[key].sweep.stamp_ns
        cloud.intensity[span] = sweep.intensity[rows]
        cloud.row[span] = sweep.row[rows]
        cloud.lidar[span] = sweep.lidar[rows]
        cloud.moving[span] = flow.moving[rows]
        cloud.instance[span] = flow.instance[rows]

        # Only moving points that are followed to the key sweep are displaced by their flow.
        followed = np.flatnonzero((flow.moving & ~flow.lost)[rows])
        cloud_rows = begin_row + followed
        flow_rows = rows[followed]
        cloud.points[cloud_rows] += poses.rotate(T_key_lidar, flow.total[flow_rows])
        if flow.velocity_m_s is not None:
            velocity_m_s = poses.rotate(T_key_lidar, flow.velocity_m_s[flow_rows])
            cloud.velocity_m_s[cloud_rows] = velocity_m_s
        begin_row = span.stop
    cloud.confidence[:] = confidence_by_age(cloud.since_key_ns)
    return cloud


def _empty_cloud(num_points: int) -> Cloud:
    """Return a cloud of the window whose ``num_points`` points are still to be filled in."""
    return Cloud(
        points=np.empty((num_points, 3)),
        rigid_points=np.empty((num_points, 3)),
        frame=np.empty(num_points, np.int32),
        since_key_ns=np.empty(num_points, np.int64),
        row=np.empty(num_points, np.int64),
        lidar=np.empty(num_points, np.uint8),
        moving=np.empty(num_points, bool),
        instance=np.empty(num_points, np.int32),
        velocity_m_s=np.zeros((num_points, 3), np.float32),
        confidence=np.empty(num_points, np.float32),
        intensity=np.empty(num_points, np.float32),
        rgb=np.zeros((num_points, 3), np.uint8),
        far=np.zeros(num_points, bool),
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

    A pose is the rigid motion that best fits the flow at three or more points of the object in one
    sweep. Objects without a pose are left out. The x axis of an object is along its velocity, or
    along its path over the window if the path is longer. Objects of 3 m and more head along the
    motion of their rear axle. ``fields`` are each sweep's flow to the key sweep.
    """
    objects = _collect_objects(stretch, fields, key)
    stamps_ns = {registered.frame: registered.sweep.stamp_ns for registered in stretch.sweeps}
    return tuple(
        _fit_track(instance, objects[instance], key, stamps_ns)
        for instance in sorted(objects)
        if max(len(points.at_sweep) for points in objects[instance].values()) >= _LEAST_POINTS
    )


def _collect_objects(
    stretch: Stretch, fields: Sequence[FlowField], key: int
) -> dict[int, dict[int, _ObjectPoints]]:
    """Return instance number -> frame -> points of the moving object in that sweep."""
    objects: dict[int, dict[int, _ObjectPoints]] = {}
    for registered, flow in zip(stretch.sweeps, fields, strict=True):
        followed = flow.moving & ~flow.lost & (flow.instance >= 0)
        if not followed.any():
            continue
        T_key_lidar = stretch.T_target_source(key, registered.frame)
        instance = flow.instance[followed]
        points = registered.sweep.points[followed]
        if flow.to_reference is not None:  # from each point's own time to the sweep's
            points = points + flow.to_reference[followed]
        at_sweep = poses.transform(T_key_lidar, points)
        at_key = at_sweep + poses.rotate(T_key_lidar, flow.displacement[followed])
        velocity_m_s = np.zeros(points.shape)
        if flow.velocity_m_s is not None:
            velocity_m_s = poses.rotate(T_key_lidar, flow.velocity_m_s[followed])
        for number in np.unique(instance).tolist():
            in_object = instance == number
            median_m_s = np.median(velocity_m_s[in_object], axis=0)
            objects.setdefault(number, {})[registered.frame] = _ObjectPoints(
                at_sweep[in_object], at_key[in_object], median_m_s
            )
    return objects


def _fit_track(
    instance: int, by_frame: dict[int, _ObjectPoints], key: int, stamps_ns: dict[int, int]
) -> ObjectTrack:
    """Return the track of an object from its points and the sweeps' reference times by frame."""
    # Motion of the object from the key's time to each sweep's time, within the key frame
    motion_from_key = {
        frame: poses.fit_rigid(points.at_key, points.at_sweep)
        for frame, points in by_frame.items()
        if len(points.at_sweep) >= _LEAST_POINTS
    }
    motion_from_key[key] = np.eye(4)
    frames = sorted(motion_from_key)
    stamp_ns = np.array([stamps_ns[frame] for frame in frames], np.int64)
    median_velocity_m_s = np.median([points.velocity_m_s for points in by_frame.values()], axis=0)
    T_key_box, size_m = _fit_box(
        points=np.concatenate([points.at_key for points in by_frame.values()]),
        velocity_m_s=median_velocity_m_s,
        to_first=motion_from_key[frames[0]],
        to_last=motion_from_key[frames[-1]],
        duration_s=int(stamp_ns[-1] - stamp_ns[0]) * 1e-9,
    )

    T_key_object = np.stack([motion_from_key[frame] @ T_key_box for frame in frames])
    velocities_m_s = median_velocity_m_s[None]
    if len(frames) > 1:
        since_key_s = (stamp_ns - stamps_ns[key]) * 1e-9
        velocities_m_s = np.gradient(T_key_object[:, :3, 3], since_key_s, axis=0)
    num_points = [len(by_frame[frame].at_sweep) if frame in by_frame else 0 for frame in frames]
    return ObjectTrack(
        instance=instance,
        size_m=size_m,
        frames=tuple(frames),
        stamp_ns=stamp_ns,
        T_key_object=T_key_object,
        velocity_m_s=velocities_m_s,
        num_points=np.array(num_points, np.int64),
        seen_size_m=size_m,
    )


def _fit_box(
    points: Float, velocity_m_s: Float, to_first: Float, to_last: Float, duration_s: float
) -> tuple[Float, Float]:
    """Return pose (4,4) and size (3,) in metres of the box around points (N,3), x along the motion.

    All are in the key frame. ``to_first`` and ``to_last`` (4,4) are the object's motions from the
    key's time to those of its first and last sweep, ``duration_s`` is the time between the latter.
    """
    # Direction of the median point: its displacement by velocity or by pose, the longer one
    reference = np.median(points, axis=0)
    begin, end = (poses.transform(motion, reference[None])[0] for motion in (to_first, to_last))
    by_velocity = velocity_m_s * duration_s if duration_s else velocity_m_s
    direction = max(by_velocity, end - begin, key=lambda xyz: float(np.hypot(*xyz[:2])))
    yaw_first, yaw_last = (poses.log(motion)[2] for motion in (to_first, to_last))
    # A vehicle heads where its rear axle moves. The first iteration finds the axle.
    for _ in range(2):
        heading = np.arctan2(direction[1], direction[0])
        T_key_object = poses.exp(np.array([0, 0, heading, 0, 0, 0]))
        in_axes = poses.rotate(poses.inverse(T_key_object), points)
        low, high = np.percentile(in_axes, [_OUTLIER_PERCENT, 100 - _OUTLIER_PERCENT], axis=0)
        if high[0] - low[0] < LONG_M:
            break
        axle = (low + high) / 2 - [_AXLE * (high[0] - low[0]), 0, 0]
        x, y, _ = T_key_object[:3, :3] @ axle - reference
        reference = reference + [x, y, 0]
        # A turn moves the axle relative to the reference by angle times lever.
        direction = direction + (yaw_last - yaw_first) * np.array([-y, x, 0])
    T_key_object[:3, 3] = T_key_object[:3, :3] @ ((low + high) / 2)
    return T_key_object, high - low
