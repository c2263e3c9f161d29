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

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers import checks, ros_bag
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.point_fields import PointLayout, sample_columns
from densify.readers.recorded_poses import PoseTrack
from densify.readers.ros_bag import CLOUDS, IMAGES, Bag, Entry, Topic
from densify.readers.timeline import median_period_ns

_FIXED_M = 1e-6  # frames that move less, in metres or radians, are fixed
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSES = (_ODOMETRY, *(f"geometry_msgs/msg/Pose{kind}Stamped" for kind in ("", "WithCovariance")))
_TYPES = {"points": CLOUDS, "images": IMAGES, "poses": _POSES}  # of messages, by option
_USAGE = "#points=/topic,/topic&images=/topic,/topic&poses=/topic, tf or none"
_NO_PICTURES = re.compile(r"depth|disparity|theora|mask|confidence")


def open_recording(path: Path, scene: str | None) -> RosBag:
    """Return a bag. ``scene`` names topics to read: ``points=/lidar&images=none``, None: detect."""
    return RosBag(path, scene)


class Topics(NamedTuple):
    """The topics of a bag that are used."""

    points: list[str]  # topics of the lidars. Each message of the first topic is a sweep.
    images: list[str]  # topics of the cameras' images
    poses: str  # topic of the poses, ``tf`` for /tf, or "" to read no poses
    # Options that the user gave (points, images, poses). A problem with a named topic is an error;
    # other unusable topics are skipped.
    named: Collection[str]

    @staticmethod
    def choose(bag: Bag, options: str | None) -> Topics:
        """Return the topics by the ``options`` after ``#`` (None: none) and the message types."""
        named = dict(parse_qsl(options or "", keep_blank_values=True))
        unknown = [key for key in named if key not in _TYPES]
        if unknown or (options and not named):
            got = unknown[0] if unknown else options
            raise InputError(f"{bag.path}#{options}: got {got}, expected {_USAGE}")
        chosen = {
            key: [name for name in text.split(",") if name not in ("", "none")]
            for key, text in named.items()
        }
        if not chosen.get("points"):
            chosen["points"] = [_only_cloud(bag)]
        if "images" not in chosen:
            chosen["images"] = _usual_images([topic.name for topic in bag.of_type(*IMAGES)])
        if "poses" not in chosen:
            odometry = bag.of_type(_ODOMETRY)
            chosen["poses"] = [odometry[0].name if len(odometry) == 1 else "tf"]
        for key, names in chosen.items():
            for name in names:
                topic = bag.topics.get(name)
                if (key, name) != ("poses", "tf") and (not topic or topic.type not in _TYPES[key]):
                    got = f"a topic of {topic.type}" if topic else "no such topic"
                    fit = _listed(bag.of_type(*_TYPES[key])) or "none"
                    raise InputError(f"{bag.path}: {key}={name}: {got}; topics that fit: {fit}")
        pose_topic = "".join(chosen["poses"][:1])
        return Topics(chosen["points"], chosen["images"], pose_topic, named.keys())


def _only_cloud(bag: Bag) -> str:
    """Return the only topic of point clouds. Raise InputError for no or several topics."""
    clouds = bag.of_type(*CLOUDS)
    if len(clouds) == 1:
        return clouds[0].name
    if clouds:
        raise InputError(
            f"{bag.path}: several topics could be the sweeps: {_listed(clouds)}; name one "
            f"or all lidars of the vehicle: --data 'ros:{bag.path}#points=/topic,/topic'"
        )
    raise InputError(
        f"{bag.path}: no PointCloud2; got {_listed(bag.topics.values()) or 'no messages'}; "
        f"play raw packets through the sensor's driver and record the points that come out"
    )


def _usual_images(topics: Sequence[str]) -> list[str]:
    """Return one image topic for each camera, preferably rectified, then uncompressed."""
    topic_of_camera: dict[str, str] = {}
    for topic in sorted(topics, key=lambda t: ("rect" not in t, t.endswith("/compressed"), t)):
        if not _NO_PICTURES.search(topic.lower()):
            topic_of_camera.setdefault(_namespace(topic), topic)
    return sorted(topic_of_camera.values())


def _namespace(topic: str) -> str:
    """Return the camera's namespace: ``/front/image_raw/compressed`` gives ``/front``."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _listed(topics: Iterable[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.type.rpartition('/')[2]}, {t.num_messages})" for t in topics)


# Frames and poses


class Transforms:
    """The tree of coordinate frames of a bag. A frame that never moves in /tf is fixed."""

    def __init__(self, bag: Bag) -> None:
        """Read all transforms of /tf_static and /tf."""
        self._path = bag.path
        # Name of the parent frame and the constant pose T_parent_child (4,4), by child frame
        self._fixed: dict[str, tuple[str, Float]] = {}
        # Name of the parent frame and the path T_parent_child over time, by child frame
        self._moving: dict[str, tuple[str, PoseTrack]] = {}
        recorded: dict[tuple[str, str], dict[int, Float]] = defaultdict(dict)
        for topic in bag.of_type(*ros_bag.TRANSFORMS):
            messages = bag.messages(topic.name)
            for transform in chain.from_iterable(message.transforms for message in messages):
                parent, child = _plain(transform.header.frame_id), _plain(transform.child_frame_id)
                where = f"{bag.path}: {topic.name}: {parent} to {child}"
                T = _pose(transform.transform.translation, transform.transform.rotation, where)
                if topic.name.endswith("tf_static"):
                    self._fixed[child] = (parent, T)
                else:
                    recorded[parent, child][_stamp_ns(transform.header)] = T
        for (parent, child), T_at_stamp in recorded.items():
            T = np.stack([*T_at_stamp.values()])
            if child in self._fixed:
                continue
            if np.abs(T - T[0]).max() < _FIXED_M:
                self._fixed[child] = (parent, T[0])
            else:
                track = _track(f"{bag.path}: /tf: {parent} to {child}", T_at_stamp)
                self._moving[child] = (parent, track)

    def between(self, target: str, source: str) -> Float | None:
        """Return the constant T_target_source (4,4), or None if no fixed frames join the two."""
        T_above_target, T_above_source = self._above(target), self._above(source)
        for ancestor in T_above_source:
            if ancestor in T_above_target:
                return poses.inverse(T_above_target[ancestor]) @ T_above_source[ancestor]
        return None

    def track_of(self, frame: str) -> tuple[str, PoseTrack] | None:
        """Return a frame's moving parent and T_parent_frame over time, or None if nothing moves."""
        # The nearest moving parent is usually odom, not map, which jumps at loop closures.
        for body, T_body_frame in self._above(frame).items():
            if body in self._moving:
                world, track = self._moving[body]
                return world, replace(track, T_world_ego=track.T_world_ego @ T_body_frame)
        return None

    def _above(self, frame: str) -> dict[str, Float]:
        """Return T_ancestor_frame (4,4) of a frame and all frames above it that are fixed to it."""
        T_ancestor_frame, ancestor = {frame: np.eye(4)}, frame
        while ancestor in self._fixed:
            parent, T = self._fixed[ancestor]
            if parent in T_ancestor_frame:
                raise InputError(f"{self._path}: /tf_static: {parent} is above itself")
            T_ancestor_frame[parent] = T @ T_ancestor_frame[ancestor]
            ancestor = parent
        return T_ancestor_frame


def _recorded_track(bag: Bag, topic: str, transforms: Transforms, lidar: str) -> PoseTrack:
    """Read the path T_world_lidar of frame ``lidar`` from a topic of odometry or poses."""
    T_at_stamp, where = dict[int, Float](), f"{bag.path}: {topic}"
    for message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        # Poses without a child frame are assumed to be poses of the lidar itself.
        child = _plain(getattr(message, "child_frame_id", "")) or lidar
        T_child_lidar = transforms.between(child, lidar)
        if T_child_lidar is None:
            raise InputError(
                f"{where}: nothing in /tf_static joins its frame {child} to the lidar's, {lidar}; "
                f"name other poses, or none: #poses=none"
            )
        T = _pose(pose.position, pose.orientation, where)
        T_at_stamp[_stamp_ns(message.header)] = T @ T_child_lidar
    return _track(where, T_at_stamp)


def _track(where: str, T_at_stamp: dict[int, Float]) -> PoseTrack:
    """Return poses by stamp (ns) as a track in the order of time."""
    T = np.reshape([T_at_stamp[stamp] for stamp in sorted(T_at_stamp)], (-1, 4, 4))
    return PoseTrack(where, np.array(sorted(T_at_stamp), np.int64), T)


def _plain(frame: str) -> str:
    """Return the name of a frame without leading and trailing slashes, as in ROS 2."""
    return frame.strip("/")


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _pose(position: Any, rotation: Any, where: str) -> Float:
    quaternion = (rotation.w, rotation.x, rotation.y, rotation.z)
    return checks.quaternion_pose(quaternion, (position.x, position.y, position.z), where)


# The sequence


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
    """A ROS bag as a `LidarSequence`. The lidar frame is the frame of the first lidar."""

    def __init__(self, path: Path, options: str | None = None) -> None:
        """Index the bag: read all stamps, transforms and calibrations, and sample sweeps."""
        self._bag = Bag(path)
        self._topics = topics = Topics.choose(self._bag, options)
        self._index = self._bag.index([*topics.points, *topics.images])
        self._transforms = Transforms(self._bag)
        self._lidars: list[Lidar] = []
        for topic in topics.points:
            self._lidars.append(self._lidar(topic))
        self._image_topics: dict[str, str] = {}
        self._unusable: list[str] = []  # reasons why topics of images are left out
        cameras, exposed_ns = {}, {}
        for topic in topics.images:
            try:
                camera = self._camera(topic)
            except InputError as error:
                if "images" in topics.named:
                    raise
                self._unusable.append(str(error))
                continue
            self._check_size(camera, topic)
            cameras[camera.name], self._image_topics[camera.name] = camera, topic
            stamps_ns = [entry.stamp_ns for entry in self._index[topic]]
            exposed_ns[camera.name] = dict(enumerate(stamps_ns))
        self._stamps_ns = [entry.stamp_ns for entry in self._lidars[0].entries]
        truth = checks.truth_beside(path if path.is_dir() else path.parent)
        frames = range(len(self._stamps_ns))
        super().__init__(path.resolve().name, path, frames, cameras, exposed_ns, truth)

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return the chosen topics and assumptions as (label, text) pairs."""
        lines = []
        for lidar in self._lidars:
            layout, undone = lidar.layout, f", out of the world of {self._topics.poses}"
            text = f"{lidar.topic} in {lidar.frame}{undone * lidar.placed}: {layout}"
            scale = f"intensity divided by {layout.intensity_scale:g}"
            lines += [("lidar", text), ("times", f"{layout.time_words}; {scale}")]
        lines += [("images", f"{topic} ({name})") for name, topic in self._image_topics.items()]
        lines += [("no camera", text) for text in self._unusable]
        return [*lines, ("poses from", self._track_and_source[1])]

    def gaps(self) -> list[str]:
        """Return a sentence for each topic whose headers lack stamps, or whose messages repeat."""
        counts = (
            (self._bag.num_unstamped, "headers have no stamp: taken is when they were recorded"),
            (self._bag.num_twice, "messages were recorded twice and are read once"),
        )
        return [
            f"{topic}: {num_by_topic[topic]} {text}"
            for num_by_topic, text in counts
            for topic in self._index
            if num_by_topic[topic]
        ]

    def _returns(self, frame: int) -> Returns:
        # A sweep joins a message of the first lidar with the nearest messages of other lidars.
        stamp_ns = self._stamps_ns[frame]
        clouds: list[Returns] = []
        for number, lidar in enumerate(self._lidars):
            nearest = min(lidar.entries, key=lambda entry: abs(entry.stamp_ns - stamp_ns))
            entry = nearest if number else lidar.entries[frame]
            if abs(entry.stamp_ns - stamp_ns) <= self._lidars[0].period_ns // 2:
                cloud = self._returns_of(lidar, entry, stamp_ns)
                numbers = np.full(len(cloud.points), number, np.uint8)
                clouds.append(replace(cloud, lidar=numbers))
        names = ["points", "intensity", "lidar"]
        if all(cloud.offset_ns is not None for cloud in clouds):
            names.append("offset_ns")
        origins = np.stack([lidar.T_first_lidar[:3, 3] for lidar in self._lidars])
        return Returns(
            **{name: np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in names},
            scanner_origins=origins if len(self._lidars) > 1 else None,
            num_untimed=sum(cloud.num_untimed for cloud in clouds),
        )

    def _returns_of(self, lidar: Lidar, entry: Entry, stamp_ns: int) -> Returns:
        """Return a message's points in the first lidar's frame, with times since ``stamp_ns``."""
        where = f"{self._bag.path}: {lidar.topic} at {entry.stamp_ns} ns"
        columns = ros_bag.cloud_columns(self._bag.message(lidar.topic, entry), where)
        returns = lidar.layout.returns(columns, where, entry.stamp_ns)
        valid = returns.points.any(axis=1)
        if lidar.placed:
            track, source = self._track_and_source
            if track is None:
                raise InputError(f"{self.where}: registered clouds need their odometry: {source}")
            returns = track.undo_placement(returns, entry.stamp_ns)
        points = np.zeros_like(returns.points)
        points[valid] = poses.transform(lidar.T_first_lidar, returns.points[valid])
        offset_ns = returns.offset_ns
        if offset_ns is not None:
            offset_ns = offset_ns + (entry.stamp_ns - stamp_ns)
        return replace(returns, points=points, offset_ns=offset_ns)

    def _image(self, camera: Camera, number: int) -> NDArray[np.uint8]:
        topic = self._image_topics[camera.name]
        where = f"{self._bag.path}: {topic}: image {number}"
        rgb = ros_bag.image_rgb(self._bag.message(topic, self._index[topic][number]), where)
        checks.check_image_size(rgb.shape, camera, where)
        return rgb

    def _pose(self, frame: int) -> Float:
        track, _ = self._track_and_source
        return super()._pose(frame) if track is None else track.at(self.stamp_ns(frame))

    @cached_property
    def _track_and_source(self) -> tuple[PoseTrack | None, str]:
        """Poses of the first lidar (None without poses), and their source or the reason as text."""
        chosen, lidar = self._topics.poses, self._lidars[0].frame
        if not chosen:
            return None, "none, as asked for"
        named = "poses" in self._topics.named
        if chosen != "tf":
            try:
                track = _recorded_track(self._bag, chosen, self._transforms, lidar)
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
        names = ", ".join(topic.name for topic in self._bag.of_type(*_POSES))
        hint = f"; name one of {names}: #poses=" if names else ", and there is no odometry"
        return None, f"none: /tf does not tell where {lidar} was{hint}"

    def _lidar(self, topic: str) -> Lidar:
        """Find frame, mounting and point fields of a lidar from some of its messages."""
        where, entries = f"{self._bag.path}: {topic}", self._index[topic]
        columns_of_entry = sample_columns(
            entries, lambda entry: ros_bag.cloud_columns(self._bag.message(topic, entry), where)
        )
        if not columns_of_entry:
            raise InputError(f"{where}: the messages looked at hold no points")
        frame = _plain(self._bag.message(topic, next(iter(columns_of_entry))).header.frame_id)
        placed_frame = self._frame_placed_in(frame)
        frame = placed_frame or frame
        first_frame = self._lidars[0].frame if self._lidars else frame
        T = self._transforms.between(first_frame, frame)
        if T is None:
            raise InputError(
                f"{self._bag.path}: nothing in /tf_static joins the frame {frame} of {topic} to "
                f"{first_frame}; name the topic of one lidar: #points={topic}"
            )
        period_ns = median_period_ns([entry.stamp_ns for entry in entries])
        stamps_ns = [entry.stamp_ns for entry in columns_of_entry]
        layout = PointLayout.find([*columns_of_entry.values()], where, period_ns, stamps_ns)
        return Lidar(topic, frame, bool(placed_frame), entries, T, period_ns, layout)

    def _frame_placed_in(self, frame: str) -> str:
        """Return the frame that the chosen odometry places in ``frame``, "" if in another."""
        if self._topics.poses in ("", "tf"):
            return ""
        message = next(self._bag.messages(self._topics.poses), None)
        if message is None or _plain(message.header.frame_id) != frame:
            return ""
        return _plain(getattr(message, "child_frame_id", "")) or "lidar"

    def _camera(self, topic: str) -> Camera:
        """Return the camera of a topic. Raise InputError without images, CameraInfo or mounting."""
        where, namespace = f"{self._bag.path}: {topic}", _namespace(topic)
        info = f"{namespace}/camera_info"
        message = next(self._bag.messages(info), None) if info in self._bag.topics else None
        if message is None:
            raise InputError(f"{where}: no {info} with its calibration; leave it out of #images=")
        if not self._index[topic]:
            raise InputError(f"{where}: holds no images")
        image = self._bag.message(topic, self._index[topic][0])
        ros_bag.check_encoding(image, where)
        frame, lidar = _plain(image.header.frame_id), self._lidars[0].frame
        T = self._transforms.between(frame, lidar)
        if T is None:
            raise InputError(
                f"{where}: nothing in /tf_static joins the camera's frame {frame} to the "
                f"lidar's, {lidar}; record /tf_static, or leave images out: #images=none"
            )
        namespaces = [_namespace(name) for name in self._topics.images]
        name = (namespace if namespaces.count(namespace) == 1 else topic).strip("/")
        rectified = "rect" in topic.removesuffix("/compressed").rpartition("/")[2]
        name = name.replace("/", "_") or "camera"
        return ros_bag.camera_of(message, name, T, rectified, f"{self._bag.path}: {info}")

    def _check_size(self, camera: Camera, topic: str) -> None:
        """Raise InputError if the first image of a topic is not of the camera's size."""
        where, info = f"{self._bag.path}: {topic}", f"{_namespace(topic)}/camera_info"
        image = self._bag.message(topic, self._index[topic][0])
        is_raw = hasattr(image, "height")
        size = (image.height, image.width) if is_raw else ros_bag.image_rgb(image, where).shape[:2]
        message = next(self._bag.messages(info))
        binning = max(message.binning_x, message.binning_y)
        if binning > 1 and size == (message.height, message.width):
            raise InputError(
                f"{where}: {info} says binning {binning}, but the images have all of its "
                f"{message.width} x {message.height} px: they are binned already; record it with "
                f"binning_x and binning_y 0, or leave the camera out of #images="
            )
        checks.check_image_size(size, camera, where)
