# SPDX-License-Identifier: MIT
"""Read ROS 1 bags and ROS 2 bags (.db3, .mcap) by the rosbags package, without ROS (extra ``ros``).

``ros:PATH[#points=/topic,/topic&images=/topic,/topic&poses=/topic]``; name topics if several fit,
``images=none`` and ``poses=none`` read none.

points: PointCloud2 of any layout, or Livox's CustomMsg, in the frame of the header, each point as
    fired from the origin of this frame. Several lidars form one sweep in the frame of the first:
    its messages are joined with the others nearest in time. /tf_static gives the lidars' positions.
stamps: The header's time (if 0, the time of recording) is the reference time. Point times count
    from the stamp, or are absolute. Sweeps and images are numbered from 0 in the order of stamps.
images: Image or CompressedImage with the CameraInfo of the same namespace. Raw images use K and D,
    ``image_rect`` uses P and R. The camera frame of the header is joined to the lidar frame by
    /tf_static, or by a /tf that never moves. A stereo P with a sideways shift is assumed to agree.
poses: Odometry, PoseStamped, or /tf, converted to the lidar by fixed frames and interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, Float, Float32
from densify.readers import checks
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.point_fields import PointLayout, sample_columns
from densify.readers.recorded_poses import PoseTrack
from densify.readers.ros_bag import POSES, Bag, Entry, Topics, place_of
from densify.readers.ros_messages import (
    Transforms,
    camera_of,
    check_encoding,
    cloud_columns,
    image_rgb,
    plain,
    recorded_track,
)

_USUAL_PERIOD_NS = 100_000_000


def open_recording(path: Path, scene: str | None) -> RosBag:
    """Open a bag; ``scene`` has its topics, such as ``points=/lidar&images=none``, None to find."""
    return RosBag(path, scene)


class Lidar(NamedTuple):
    """A lidar of the bag."""

    topic: str
    frame: str  # frame in the header of the messages; that of odometry's body for placed messages
    placed: bool  # True if odometry placed the messages in its own world: registered clouds
    entries: list[Entry]  # index of the messages, by ascending stamp
    T_first_lidar: Float  # (4,4) pose of this lidar in the frame of the first lidar
    period_ns: int  # median time between consecutive messages
    layout: PointLayout


class RosBag(FileSequence):
    """A ROS bag as a `LidarSequence`; the lidar frame is the frame of the first lidar."""

    def __init__(self, path: Path, options: str | None = None) -> None:
        """Index the bag: read all stamps, transforms and calibrations, and sample sweeps."""
        self._bag = Bag(path)
        self._topics = topics = Topics.choose(self._bag, options)
        self._index = self._bag.index([*topics.points, *topics.images])
        self._transforms = Transforms.read(self._bag)
        self._lidars: list[Lidar] = []
        for topic in topics.points:
            self._lidars.append(self._lidar(topic))
        self._image_topics: dict[str, str] = {}
        self._left_out: list[str] = []
        cameras = {}
        for topic in topics.images:
            try:
                camera = self._camera(topic)
            except InputError as error:
                if "images" in topics.named:
                    raise
                self._left_out.append(str(error))
                continue
            self._check_size(camera, topic)
            cameras[camera.name], self._image_topics[camera.name] = camera, topic
        stamps = {
            name: {n: entry.stamp_ns for n, entry in enumerate(self._index[topic])}
            for name, topic in self._image_topics.items()
        }
        self._sweeps = self._lidars[0].entries
        self._stamps_ns = [entry.stamp_ns for entry in self._sweeps]
        truth = checks.truth_beside(path if path.is_dir() else path.parent)
        frames = range(len(self._sweeps))
        super().__init__(path.resolve().name, path, frames, cameras, stamps, truth)

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return the chosen topics and assumptions as pairs of a label and a text."""
        lines = []
        for lidar in self._lidars:
            layout = lidar.layout
            used = [
                f"{quantity} = {name}" for quantity, name in vars(layout.fields).items() if name
            ]
            undone = f", out of the world of {self._topics.poses}" if lidar.placed else ""
            lines.append(("lidar", f"{lidar.topic} in {lidar.frame}{undone}: {', '.join(used)}"))
            scale = f"intensity divided by {layout.intensity_scale:g}"
            lines.append(("times", f"{layout.time_words}; {scale}"))
        lines += [("images", f"{topic} ({name})") for name, topic in self._image_topics.items()]
        lines += [("no camera", text) for text in self._left_out]
        return [*lines, ("poses from", self._track_and_words[1])]

    def _returns(self, frame: int) -> Returns:
        sweep, numbered = self._sweeps[frame], list[tuple[int, Returns]]()
        for number, lidar in enumerate(self._lidars):
            nearest = min(lidar.entries, key=lambda e: abs(e.stamp_ns - sweep.stamp_ns))
            nearest = nearest if number else sweep
            if abs(nearest.stamp_ns - sweep.stamp_ns) <= self._lidars[0].period_ns // 2:
                numbered.append((number, self._returns_of(lidar, nearest, sweep.stamp_ns)))
        clouds = [cloud for _, cloud in numbered]
        timed = all(cloud.offset_ns is not None for cloud in clouds)
        origins = np.stack([lidar.T_first_lidar[:3, 3] for lidar in self._lidars])
        return Returns(
            np.concatenate([cloud.points for cloud in clouds]),
            np.concatenate([_intensity(cloud) for cloud in clouds]),
            np.concatenate([cloud.offset_ns for cloud in clouds]) if timed else None,  # type: ignore
            np.concatenate([np.full(len(cloud.points), n, np.uint8) for n, cloud in numbered]),
            origins if len(self._lidars) > 1 else None,
            num_untimed=sum(cloud.num_untimed for cloud in clouds),
        )

    def _returns_of(self, lidar: Lidar, entry: Entry, stamp_ns: int) -> Returns:
        """Return a message's points in the first lidar's frame, with times since ``stamp_ns``."""
        where = f"{self._bag.path}: {lidar.topic} at {entry.stamp_ns} ns"
        columns = cloud_columns(self._bag.message(lidar.topic, entry), where)
        returns, valid = lidar.layout.returns(columns, where, entry.stamp_ns)
        if lidar.placed:
            returns = self._taken_back(returns, entry.stamp_ns)
        points = np.zeros_like(returns.points)
        points[valid] = poses.transform(lidar.T_first_lidar, returns.points[valid])
        offset_ns = returns.offset_ns
        if offset_ns is not None:
            offset_ns = offset_ns + (entry.stamp_ns - stamp_ns)
        return replace(returns, points=points, offset_ns=offset_ns)

    def _taken_back(self, placed: Returns, stamp_ns: int) -> Returns:
        """Return points of the world of odometry as fired, in the frame that odometry places."""
        track, words = self._track_and_words
        if track is None:
            raise InputError(f"{self._bag.path}: registered clouds need their odometry: {words}")
        return track.taken_back(placed, stamp_ns)

    def gaps(self) -> list[str]:
        """Return a sentence for each topic whose headers lack stamps, or whose messages repeat."""
        num, num_twice = self._bag.num_unstamped, self._bag.num_twice
        return [
            f"{topic}: {num[topic]} headers have no stamp: taken is when they were recorded"
            for topic in self._index
            if num[topic]
        ] + [
            f"{topic}: {num_twice[topic]} messages were recorded twice and are read once"
            for topic in self._index
            if num_twice[topic]
        ]

    def _check_size(self, camera: Camera, topic: str) -> None:
        """Raise InputError if the first image of a topic is not of the camera's size."""
        where, info = f"{self._bag.path}: {topic}", f"{place_of(topic)}/camera_info"
        message = self._bag.message(topic, self._index[topic][0])
        if hasattr(message, "format"):
            height, width = image_rgb(message, where).shape[:2]
        else:
            height, width = message.height, message.width
        camera_info = next(self._bag.messages(info))
        binning = max(camera_info.binning_x, camera_info.binning_y)
        if binning > 1 and (width, height) == (camera_info.width, camera_info.height):
            raise InputError(
                f"{where}: {info} says binning {binning}, but the images have all of its {width} x "
                f"{height} px: they are binned already; record it with binning_x and binning_y 0, "
                f"or leave the camera out of #images="
            )
        checks.image_size((height, width), camera, where)

    def _image(self, camera: Camera, number: int) -> NDArray[np.uint8]:
        topic = self._image_topics[camera.name]
        where = f"{self._bag.path}: {topic}: image {number}"
        rgb = image_rgb(self._bag.message(topic, self._index[topic][number]), where)
        checks.image_size(rgb.shape, camera, where)
        return rgb

    def _pose(self, frame: int) -> Float:
        track, _ = self._track_and_words
        return super()._pose(frame) if track is None else track.at(self.stamp_ns(frame))

    @cached_property
    def _track_and_words(self) -> tuple[PoseTrack | None, str]:
        """Poses of the first lidar (None without poses), and their source or the reason as text."""
        chosen, lidar = self._topics.poses, self._lidars[0].frame
        if not chosen:
            return None, "none, as asked for"
        named = "poses" in self._topics.named
        if chosen != "tf":
            try:
                track = recorded_track(self._bag, chosen, self._transforms, lidar)
            except InputError as error:
                if named:
                    raise
                return None, str(error)
            return track, f"{chosen}, {len(track.stamp_ns)} of them"
        parent_and_track = self._transforms.track_of(lidar)
        if parent_and_track is not None:
            return parent_and_track[1], f"/tf, {parent_and_track[0]} to {lidar}"
        if named:
            raise InputError(f"{self._bag.path}: /tf: nothing tells where {lidar} was")
        names = ", ".join(topic.name for topic in self._bag.of_type(*POSES))
        hint = f"; name one of {names}: #poses=" if names else ", and there is no odometry"
        return None, f"none: /tf does not tell where {lidar} was{hint}"

    def _lidar(self, topic: str) -> Lidar:
        """Find frame, mounting and point fields of a lidar from some of its messages."""
        where, entries = f"{self._bag.path}: {topic}", self._index[topic]
        columns_of_entry = sample_columns(
            entries, lambda entry: cloud_columns(self._bag.message(topic, entry), where)
        )
        if not columns_of_entry:
            raise InputError(f"{where}: the messages looked at hold no points")
        frame = plain(self._bag.message(topic, next(iter(columns_of_entry))).header.frame_id)
        placed_frame = self._placed_in(frame)
        frame = placed_frame or frame
        first = self._lidars[0].frame if self._lidars else frame
        T = self._transforms.between(first, frame)
        if T is None:
            raise InputError(
                f"{self._bag.path}: nothing in /tf_static joins the frame {frame} of {topic} to "
                f"{first}; name the topic of one lidar: #points={topic}"
            )
        steps = np.diff([e.stamp_ns for e in entries])
        period_ns = max(1, int(np.median(steps))) if len(steps) else _USUAL_PERIOD_NS
        stamps_ns = [entry.stamp_ns for entry in columns_of_entry]
        layout = PointLayout.find([*columns_of_entry.values()], where, period_ns, stamps_ns)
        return Lidar(topic, frame, bool(placed_frame), entries, T, period_ns, layout)

    def _placed_in(self, frame: str) -> str:
        """Return the frame that the chosen odometry places in ``frame``, "" if in another."""
        if self._topics.poses in ("", "tf"):
            return ""
        message = next(self._bag.messages(self._topics.poses), None)
        if message is None or plain(message.header.frame_id) != frame:
            return ""
        return plain(getattr(message, "child_frame_id", "")) or "lidar"

    def _camera(self, topic: str) -> Camera:
        """Return the camera of a topic; raise InputError without images, CameraInfo or mounting."""
        prefix, prefixes = place_of(topic), [place_of(t) for t in self._topics.images]
        where, info = f"{self._bag.path}: {topic}", f"{prefix}/camera_info"
        message = next(self._bag.messages(info), None) if info in self._bag.topics else None
        if message is None:
            raise InputError(f"{where}: no {info} with its calibration; leave it out of #images=")
        if not self._index[topic]:
            raise InputError(f"{where}: holds no images")
        image = self._bag.message(topic, self._index[topic][0])
        check_encoding(image, where)
        frame, lidar = plain(image.header.frame_id), self._lidars[0].frame
        T = self._transforms.between(frame, lidar)
        if T is None:
            raise InputError(
                f"{where}: nothing in /tf_static joins the camera's frame {frame} to the "
                f"lidar's, {lidar}; record /tf_static, or leave images out: #images=none"
            )
        name = (prefix if prefixes.count(prefix) == 1 else topic).strip("/").replace("/", "_")
        rectified = "rect" in topic.removesuffix("/compressed").rpartition("/")[2]
        return camera_of(message, name or "camera", T, rectified, f"{self._bag.path}: {info}")


def _intensity(cloud: Returns) -> Float32:
    return np.zeros(len(cloud.points), np.float32) if cloud.intensity is None else cloud.intensity
