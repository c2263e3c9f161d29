# SPDX-License-Identifier: MIT
"""Frames of a ROS bag: what stands where on the vehicle, and where the vehicle was."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Float
from densify.readers.file_sequence import quaternion_pose
from densify.readers.recorded_poses import PoseTrack
from densify.readers.ros.bag import Bag

_TF = "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"
_FIXED_M = 1e-6  # what moves by less, in metres or radians, is fixed


@dataclass(frozen=True)
class Frames:
    """fixed: T_parent_child by child, with its parent. tracks: T_parent_child of what moves."""

    where: str
    fixed: dict[str, tuple[str, Float]] = field(default_factory=dict)
    moving: dict[str, tuple[str, PoseTrack]] = field(default_factory=dict)

    @staticmethod
    def read(bag: Bag) -> Frames:
        """All of /tf_static and /tf; what never moves in /tf is fixed too. Raises InputError for a
        transform that is no rigid motion."""
        found = Frames(str(bag.path))
        heard: dict[tuple[str, str], dict[int, Float]] = {}
        for topic in bag.of_type(_TF, _OLD_TF):
            for message in bag.messages(topic.name):
                for transform in message.transforms:
                    parent, child = (
                        plain(transform.header.frame_id),
                        plain(transform.child_frame_id),
                    )
                    where = f"{bag.path}: {topic.name}: {parent} to {child}"
                    T = _pose(transform.transform.translation, transform.transform.rotation, where)
                    if topic.name.endswith("tf_static"):
                        found.fixed[child] = (parent, T)
                    else:
                        heard.setdefault((parent, child), {})[stamp_of(transform.header)] = T
        for (parent, child), by_stamp in heard.items():
            if child in found.fixed:
                continue
            T = np.stack([by_stamp[stamp] for stamp in sorted(by_stamp)])
            if np.abs(T - T[0]).max() < _FIXED_M or len(T) == 1:
                found.fixed[child] = (parent, T[0])
            else:
                where = f"{bag.path}: /tf: {parent} to {child}"
                track = PoseTrack(where, np.array(sorted(by_stamp), np.int64), T)
                found.moving[child] = (parent, track)
        return found

    def between(self, target: str, source: str) -> Float | None:
        """(4,4) T_target_source over what is fixed, None if nothing joins them."""
        ways: dict[str, list[tuple[str, Float]]] = {}
        for child, (parent, T) in self.fixed.items():
            ways.setdefault(child, []).append((parent, T))
            ways.setdefault(parent, []).append((child, inverse(T)))
        found, waiting = {source: np.eye(4)}, deque([source])
        while waiting:
            at = waiting.popleft()
            if at == target:
                return found[at]
            for other, T_other_at in ways.get(at, []):
                if other not in found:
                    found[other] = T_other_at @ found[at]
                    waiting.append(other)
        return None

    def track_of(self, frame: str) -> tuple[str, PoseTrack] | None:
        """The path of a frame by /tf, in the nearest frame above that it moves in, whose name comes
        first: ``odom`` rather than ``map``, which jumps where a place is recognised."""
        T_body_frame, body, passed = np.eye(4), frame, {frame}
        while body in self.fixed and body not in self.moving:
            parent, T = self.fixed[body]
            T_body_frame, body = T @ T_body_frame, parent
            if body in passed:
                raise InputError(f"{self.where}: /tf_static: {body} is above itself")
            passed.add(body)
        if body not in self.moving:
            return None
        world, track = self.moving[body]
        T_world_frame = track.T_world_ego @ T_body_frame
        return world, PoseTrack(track.where, track.stamp_ns, T_world_frame)


def recorded_track(bag: Bag, topic: str, frames: Frames, lidar: str) -> PoseTrack:
    """The lidar's path by a topic of odometry or poses.

    Odometry is that of its child frame, a pose without one is the lidar's. Raises InputError if
    nothing joins that frame to the lidar's, or there are fewer than two poses.
    """
    found: dict[int, Float] = {}
    for message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        where = f"{bag.path}: {topic}"
        child = plain(getattr(message, "child_frame_id", "")) or lidar
        T_child_lidar = frames.between(child, lidar)
        if T_child_lidar is None:
            raise InputError(
                f"{where}: nothing in /tf_static joins its frame {child} to the lidar's, {lidar}; "
                f"name other poses, or none: #poses=none"
            )
        T = _pose(pose.position, pose.orientation, where)
        found[stamp_of(message.header)] = T @ T_child_lidar
    if not found:
        raise InputError(f"{bag.path}: {topic}: its messages cannot be found; the bag is damaged")
    stamps_ns = np.array(sorted(found), np.int64)
    return PoseTrack(f"{bag.path}: {topic}", stamps_ns, np.stack([found[s] for s in sorted(found)]))


def plain(frame: str) -> str:
    """A frame's name as ROS 2 writes it."""
    return frame.strip("/")


def stamp_of(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _pose(place: Any, turn: Any, where: str) -> Float:
    quaternion = (turn.w, turn.x, turn.y, turn.z)
    return quaternion_pose(quaternion, (place.x, place.y, place.z), where)
