# SPDX-License-Identifier: MIT
"""ROS 1 bags and ROS 2 bags (.db3, .mcap), by the rosbags package, without ROS (`densify[ros]`).

``ros:PATH[#points=/topic,/topic&images=/topic,/topic&poses=/topic]``: topics are guessed where one
fits, and must be named where several do; ``images=none`` and ``poses=none`` leave them out.

points
    PointCloud2 of any layout, or Livox's CustomMsg, in the frame that their header names, taken as
    fired. Rays start at that frame's origin. Points of several lidars make one sweep in the frame
    of the first one named: each of its messages takes the nearest in time of the others, and
    /tf_static gives where each lidar's rays start.
stamps
    of the header (when it was recorded, if that is 0): the reference time. Times of points count
    from it, or are absolute; field, unit and clock are found out (`densify.readers.point_fields`).
    Sweeps and images are numbered from 0 in the order of their stamps.
images
    Image or CompressedImage with the CameraInfo beside them: raw ones with K and D, ``image_rect``
    with P and R. Their frame is that of the image's header, fixed to the lidar's by /tf_static (or
    by a /tf that never moves). A P that moves the camera sideways (stereo) is taken to agree.
poses
    Odometry, PoseStamped, or /tf: of the lidar's frame by fixed frames, interpolated to the sweeps'
    stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers.file_sequence import FileSequence, Returns, check_image_size, truth_beside
from densify.readers.point_fields import (
    Fields,
    PointTimes,
    find_fields,
    find_times,
    full_scale,
    points_of,
    scaled,
)
from densify.readers.recorded_poses import PoseTrack
from densify.readers.ros_bag import POSES, Bag, Entry, Images, Topics
from densify.readers.ros_messages import (
    Transforms,
    camera_of,
    cloud_columns,
    image_rgb,
    plain,
    recorded_track,
)

_NUM_TRIED = 5  # messages, until one holds points
_USUAL_PERIOD_NS = 100_000_000


def open_recording(path: Path, scene: str | None) -> RosBag:
    """See `densify.readers.ReaderModule`; scene: which topics, see above."""
    return RosBag(path, scene)


class Lidar(NamedTuple):
    """A lidar's topic. entries: its messages. T_first_lidar: (4,4) to the first lidar's frame.
    period_ns: median step of its messages. times, scale: of its points and intensities. words: what
    was found of the times."""

    topic: str
    frame: str
    entries: list[Entry]
    T_first_lidar: Float
    fields: Fields
    period_ns: int
    times: PointTimes | None
    scale: float
    words: str


class RosBag(FileSequence):
    """A bag as a `LidarSequence`; `findings` says what was found."""

    def __init__(self, path: Path, options: str | None = None) -> None:
        """Read the bag through once, for the stamps of its messages. Raises InputError if it is
        damaged, or its topics, frames or calibrations do not tell what is needed."""
        self._bag = Bag(path)
        self._topics = Topics.choose(self._bag, options)
        self._left_out = list(self._topics.left_out)
        images = self._topics.images
        self._index = self._bag.index([*self._topics.points, *(i.topic for i in images)])
        self._transforms = Transforms.read(self._bag)
        self._lidars: list[Lidar] = []
        for topic in self._topics.points:
            self._lidars.append(self._lidar(topic))
        cameras = {i.camera: camera for i in images if (camera := self._camera(i)) is not None}
        self._image_topics = {i.camera: i.topic for i in images}
        stamps = {
            name: {n: e.stamp_ns for n, e in enumerate(self._index[self._image_topics[name]])}
            for name in cameras
        }
        self._sweeps = self._lidars[0].entries
        truth = truth_beside(path if path.is_dir() else path.parent)
        frames = range(len(self._sweeps))
        super().__init__(path.resolve().name, path, frames, cameras, stamps, truth)

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep."""
        self.check_frame(frame)
        return self._sweeps[frame].stamp_ns

    def findings(self) -> Sequence[tuple[str, str]]:
        """See `LidarSequence`."""
        lines = []
        for lidar in self._lidars:
            used = [f"{part} = {name}" for part, name in vars(lidar.fields).items() if name]
            lines.append(("lidar", f"{lidar.topic} in {lidar.frame}: {', '.join(used)}"))
            lines.append(("times", f"{lidar.words}; intensity divided by {lidar.scale:g}"))
        lines += [("images", f"{topic} ({name})") for name, topic in self._image_topics.items()]
        lines += [("no camera", text) for text in self._left_out]
        return [*lines, ("poses from", self._track_and_words[1])]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        at, found = self._sweeps[frame], list[tuple[int, Returns]]()
        for number, lidar in enumerate(self._lidars):
            near = min(lidar.entries, key=lambda e: abs(e.stamp_ns - at.stamp_ns))
            near = near if number else at
            if abs(near.stamp_ns - at.stamp_ns) <= self._lidars[0].period_ns // 2:
                found.append((number, self._returns_of(lidar, near, at.stamp_ns)))
        parts = [part for _, part in found]
        timed = all(part.offset_ns is not None for part in parts)
        origins = np.stack([lidar.T_first_lidar[:3, 3] for lidar in self._lidars])
        return self.where, Returns(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.intensity for part in parts]),
            np.concatenate([part.offset_ns for part in parts]) if timed else None,
            np.concatenate([np.full(len(part.points), n, np.uint8) for n, part in found]),
            origins if len(self._lidars) > 1 else None,
        )

    def _returns_of(self, lidar: Lidar, entry: Entry, stamp_ns: int) -> Returns:
        """Return a message's points in the first lidar's frame, timed since the sweep's stamp."""
        where = f"{self._bag.path}: {lidar.topic} at {entry.stamp_ns} ns"
        columns = cloud_columns(self._bag.message(lidar.topic, entry), where)
        for name in vars(lidar.fields).values():
            if name and name not in columns:
                raise InputError(
                    f"{where}: no field {name}, which other messages have; got {', '.join(columns)}"
                )
        points = points_of(columns, lidar.fields)
        valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        intensity = np.zeros(len(points), np.float32)
        if lidar.fields.intensity:
            intensity = scaled(columns[lidar.fields.intensity], lidar.scale)
        offset_ns = None
        if lidar.times is not None:
            values = columns[lidar.times.field]
            if values.dtype.kind == "f" and not np.isfinite(values[valid]).all():
                raise InputError(f"{where}: {lidar.times.field}: got a time that is not finite")
            offset_ns = np.zeros(len(points), np.int64)
            since_ns = entry.stamp_ns - stamp_ns
            offset_ns[valid] = lidar.times.offset_ns(values[valid], entry.stamp_ns) + since_ns
        points[valid] = poses.transform(lidar.T_first_lidar, points[valid])
        points[~valid] = 0.0
        return Returns(points, intensity, offset_ns)

    def _image(self, camera: Camera, number: int) -> NDArray[np.uint8]:
        topic = self._image_topics[camera.name]
        where = f"{self._bag.path}: {topic}: image {number}"
        rgb = image_rgb(self._bag.message(topic, self._index[topic][number]), where)
        check_image_size(rgb.shape, camera, where)
        return rgb

    def _pose(self, frame: int) -> Float:
        track, _ = self._track_and_words
        return super()._pose(frame) if track is None else track.at(self.stamp_ns(frame))

    @cached_property
    def _track_and_words(self) -> tuple[PoseTrack | None, str]:
        """The first lidar's path, and for a person where it is from."""
        chosen, lidar = self._topics.poses, self._lidars[0].frame
        if not chosen:
            return None, "none, as asked for"
        try:
            if chosen != "tf":
                track = recorded_track(self._bag, chosen, self._transforms, lidar)
                return track, f"{chosen}, {len(track.stamp_ns)} of them"
        except InputError as error:
            if self._topics.poses_named:
                raise
            return None, str(error)
        found = self._transforms.track_of(lidar)
        if found is not None:
            return found[1], f"/tf, {found[0]} to {lidar}"
        if self._topics.poses_named:
            raise InputError(f"{self._bag.path}: /tf: nothing tells where {lidar} was")
        names = ", ".join(topic.name for topic in self._bag.of_type(*POSES))
        hint = f"; name one of {names}: #poses=" if names else ", and there is no odometry"
        return None, f"none: /tf does not tell where {lidar} was{hint}"

    def _lidar(self, topic: str) -> Lidar:
        where, entries = f"{self._bag.path}: {topic}", self._index[topic]
        for entry in entries[:_NUM_TRIED]:
            message = self._bag.message(topic, entry)
            columns = cloud_columns(message, where)
            if len(next(iter(columns.values()), ())):
                break
        else:
            raise InputError(f"{where}: its first messages hold no points")
        frame = plain(message.header.frame_id)
        first = self._lidars[0].frame if self._lidars else frame
        T = self._transforms.between(first, frame)
        if T is None:
            raise InputError(
                f"{self._bag.path}: nothing in /tf_static joins the frame {frame} of {topic} to "
                f"{first}; name the topic of one lidar: #points={topic}"
            )
        fields = find_fields(columns)
        missing = [axis for axis in "xyz" if not getattr(fields, axis)]
        if missing:
            raise InputError(f"{where}: no field {', '.join(missing)}; got {', '.join(columns)}")
        steps = np.diff([e.stamp_ns for e in entries])
        period_ns = max(1, int(np.median(steps))) if len(steps) else _USUAL_PERIOD_NS
        times, words = None, "no field of times"
        if fields.time:
            column = columns[fields.time]
            times, words = find_times(column, fields.time, period_ns, entry.stamp_ns)
        scale = full_scale(columns[fields.intensity]) if fields.intensity else 1.0
        return Lidar(topic, frame, entries, T, fields, period_ns, times, scale or 1.0, words)

    def _camera(self, images: Images) -> Camera | None:
        """Return None, with a note, where a camera that nobody named does not tell its place."""
        where = f"{self._bag.path}: {images.info}"
        try:
            entries, info = self._index[images.topic], next(self._bag.messages(images.info), None)
            if not entries or info is None:
                raise InputError(f"{where}: no messages of {images.topic} or its calibration")
            image = self._bag.message(images.topic, entries[0])
            frame, lidar = plain(image.header.frame_id), self._lidars[0].frame
            T = self._transforms.between(frame, lidar)
            if T is None:
                raise InputError(
                    f"{where}: nothing in /tf_static joins the camera's frame {frame} to the "
                    f"lidar's, {lidar}; record /tf_static, or leave images out: #images=none"
                )
            return camera_of(info, images.camera, T, images.rectified, where)
        except InputError as error:
            if images.named:
                raise
            self._left_out.append(f"{images.topic}: {error}")
            return None
