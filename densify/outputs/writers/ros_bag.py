# SPDX-License-Identifier: MIT
"""Writes a street as a ROS bag with its truth, which `densify.readers.ros.reader` opens::

/points                        PointCloud2: x y z intensity t, t in ns since the stamp, which is
                               the sweep's start; with padding, as drivers have it
/CAMERA/image_rect_color       (image_raw of lenses) rgb8 in ROS 2, /compressed PNG in ROS 1
/CAMERA/camera_info            with each image
/odom                          Odometry of base_link, 100 Hz
/tf_static                     base_link to lidar and cameras
truth/                         beside the bag, as in `densify.readers.truth_files`
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float
from densify.outputs.writers.excerpt import Excerpt, new_folder, quaternion
from densify.readers.extras import needed
from densify.readers.ros.bag import message_types
from densify.street.sensors import SENSORS

T_BASE_LIDAR = np.eye(4)
T_BASE_LIDAR[:3, 3] = [1.2, 0.0, 1.6]
_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4"],
        "offsets": [0, 4, 8, 16, 20],
        "itemsize": 32,
    }
)
_DATATYPES = {"<f4": 7, "<u4": 6}
_POSE_STEP_NS = 10_000_000


class _Message(NamedTuple):
    """One to be written; log_ns: when it would have been recorded."""

    log_ns: int
    topic: str
    type: str
    content: Any


def write_bag(excerpt: Excerpt, place: Path, overwrite: bool, is_ros2: bool) -> Path:
    """See `TreeWriter`; the bag and its truth are in the folder ``place``. The
    format has room for a single scanner, and for cameras without rolling shutters."""
    _check(excerpt)
    types = message_types(is_ros2)
    street = excerpt.street
    half_ns = street.simulator.period_ns // 2
    messages = _Messages(excerpt, types.types, is_ros2)
    frames = excerpt.frames
    with new_folder(place, overwrite) as folder:
        found = [*messages.frames(), *messages.odometry()]
        for _, frame in excerpt.numbered():
            found.append(messages.sweep(frame, street.stamp_ns(frame) - half_ns))
        for name in excerpt.cameras:
            found += messages.images(name)
        found.sort(key=lambda message: message.log_ns)
        _write(folder, found, types, is_ros2)
        stamps_ns = [street.stamp_ns(frame) - half_ns for frame in frames]
        excerpt.write_truth(folder / "truth", stamps_ns)
    return place


def _check(excerpt: Excerpt) -> None:
    street = excerpt.street
    if len(street.simulator.sensor.scanners) > 1:
        fit = [s.name for s in SENSORS.values() if len(s.scanners) == 1]
        raise InputError(
            f"{street.name}: cannot be written as a ROS bag, whose messages have one scanner each; "
            f"choose among {', '.join(fit)}"
        )
    for name in excerpt.cameras:
        if street.cameras[name].row_time_s:
            raise InputError(
                f"{street.name}: camera {name} cannot be written as a ROS bag, which does not know "
                f"rolling shutters; leave it out"
            )


def _write(folder: Path, messages: list[_Message], types: Any, is_ros2: bool) -> None:
    if is_ros2:
        package = needed("rosbags.rosbag2", "ros", "ROS bags")
        plugin = package.StoragePlugin.MCAP
        aside = folder / "bag"  # the package makes the folder itself
        writer = package.Writer(aside, version=9, storage_plugin=plugin)
    else:
        writer = needed("rosbags.rosbag1", "ros", "ROS bags").Writer(folder / "street.bag")
    serialize = types.serialize_cdr if is_ros2 else types.serialize_ros1
    with writer as bag:
        topics = sorted({(message.topic, message.type) for message in messages})
        connections = {t: bag.add_connection(t, type_, typestore=types) for t, type_ in topics}
        for message in messages:
            data = serialize(message.content, message.type)
            bag.write(connections[message.topic], message.log_ns, data)
    if is_ros2:
        for file in aside.iterdir():
            file.rename(folder / file.name)
        aside.rmdir()


@dataclass(frozen=True)
class _Messages:
    """What is written of an excerpt. types: the classes of messages, by name."""

    excerpt: Excerpt
    types: Any
    is_ros2: bool

    def sweep(self, frame: int, stamp_ns: int) -> _Message:
        returns = self.excerpt.returns(frame)
        points = np.zeros(len(returns.points), _POINT)
        for axis, column in zip("xyz", returns.points.T, strict=True):
            points[axis] = column
        points["intensity"] = returns.intensity * 255
        points["t"] = returns.offset_ns - (stamp_ns - self.excerpt.street.stamp_ns(frame))
        fields = [
            self._make("sensor_msgs/msg/PointField", name, offset, _DATATYPES[kind.str], 1)
            for name, (kind, offset) in ((n, f[:2]) for n, f in (_POINT.fields or {}).items())
        ]
        header = self._header(stamp_ns, "lidar")
        step, num = _POINT.itemsize, len(points)
        layout = (header, 1, num, fields, False, step, step * num)
        data = points.view(np.uint8).reshape(-1)
        content = self._make("sensor_msgs/msg/PointCloud2", *layout, data, True)
        log_ns = stamp_ns + self.excerpt.street.simulator.period_ns
        return _Message(log_ns, "/points", "sensor_msgs/msg/PointCloud2", content)

    def images(self, name: str) -> Iterator[_Message]:
        camera = self.excerpt.street.cameras[name]
        exposed_ns = self.excerpt.street.image_stamps_ns(name)
        last = "image_rect_color" if camera.is_rectified else "image_raw"
        values: tuple[Any, ...]
        for number in self.excerpt.image_numbers(name):
            stamp_ns = exposed_ns[number]
            header = self._header(stamp_ns, f"{name}_optical")
            if self.is_ros2:
                rgb = self.excerpt.street.image(name, number)
                height, width = rgb.shape[:2]
                kind, topic = "sensor_msgs/msg/Image", f"/{name}/{last}"
                values = (header, height, width, "rgb8", 0, 3 * width, rgb.reshape(-1))
            else:
                data = np.frombuffer(self.excerpt.encoded_image(name, number), np.uint8)
                kind, topic = "sensor_msgs/msg/CompressedImage", f"/{name}/{last}/compressed"
                values = (header, "rgb8; png compressed bgr8", data)
            yield _Message(stamp_ns, topic, kind, self._make(kind, *values))
            info = self._info(camera, header)
            yield _Message(stamp_ns, f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", info)

    def odometry(self) -> Iterator[_Message]:
        track = self.excerpt.poses(inverse(T_BASE_LIDAR), _POSE_STEP_NS)
        still = self._make(
            "geometry_msgs/msg/Twist", self._vector((0, 0, 0)), self._vector((0, 0, 0))
        )
        for stamp_ns, T in zip(track.stamp_ns.tolist(), track.T_world_ego, strict=True):
            place = self._make("geometry_msgs/msg/Point", *map(float, T[:3, 3]))
            pose = self._make("geometry_msgs/msg/Pose", place, self._turn(T))
            content = self._make(
                "nav_msgs/msg/Odometry",
                self._header(stamp_ns, "odom"),
                "base_link",
                self._make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
                self._make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36)),
            )
            yield _Message(stamp_ns, "/odom", "nav_msgs/msg/Odometry", content)

    def frames(self) -> Iterator[_Message]:
        """/tf_static, recorded first."""
        stamp_ns = self.excerpt.street.stamp_ns(self.excerpt.frames[0]) - 200_000_000
        standing = {"lidar": T_BASE_LIDAR}
        for name in self.excerpt.cameras:
            T_cam_lidar = self.excerpt.street.cameras[name].T_cam_lidar
            standing[f"{name}_optical"] = T_BASE_LIDAR @ inverse(T_cam_lidar)
        transforms = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                self._header(stamp_ns, "base_link"),
                child,
                self._make("geometry_msgs/msg/Transform", self._vector(T[:3, 3]), self._turn(T)),
            )
            for child, T in standing.items()
        ]
        content = self._make("tf2_msgs/msg/TFMessage", transforms)
        yield _Message(stamp_ns, "/tf_static", "tf2_msgs/msg/TFMessage", content)

    def _info(self, camera: Camera, header: Any) -> Any:
        K = camera.K
        model = "equidistant" if camera.model == "fisheye" else "plumb_bob"
        distortion = np.array(camera.distortion or (0.0,) * 5)
        P = np.column_stack([K, np.zeros(3)])
        region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        matrices = (distortion, K.reshape(-1), np.eye(3).reshape(-1), P.reshape(-1))
        values = (header, camera.height_px, camera.width_px, model, *matrices, 0, 0, region)
        return self._make("sensor_msgs/msg/CameraInfo", *values)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(int(stamp_ns), 10**9))
        before = () if self.is_ros2 else (0,)  # a sequence number
        return self._make("std_msgs/msg/Header", *before, stamp, frame)

    def _vector(self, values: Any) -> Any:
        return self._make("geometry_msgs/msg/Vector3", *map(float, values))

    def _turn(self, T: Float) -> Any:
        w, x, y, z = map(float, quaternion(T))
        return self._make("geometry_msgs/msg/Quaternion", x, y, z, w)

    def _make(self, type_: str, *values: Any) -> Any:
        return self.types[type_](*values)
