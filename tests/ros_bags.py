# SPDX-License-Identifier: MIT
"""Small bags with messages of any kind, for tests of the reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from densify.readers.ros_bag import message_types

STAMP_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class Record(NamedTuple):
    log_ns: int
    topic: str
    type: str
    message: Any


class Maker:
    """Messages, and bags of them. suffix: .db3, .mcap or .bag."""

    def __init__(self, suffix: str = ".db3") -> None:
        self.is_ros2 = suffix != ".bag"
        self.suffix = suffix
        self.types = message_types(self.is_ros2)
        self.written: list[Record] = []

    def make(self, type_: str, *values: Any) -> Any:
        return self.types.types[type_](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/msg/Header", *(() if self.is_ros2 else (7,)), stamp, frame)

    def put(self, topic: str, type_: str, log_ns: int, *values: Any) -> None:
        """values: of the message's fields, in order."""
        self.written.append(Record(log_ns, topic, type_, self.make(type_, *values)))

    def cloud(
        self,
        columns: dict[str, np.ndarray],
        stamp_ns: int = STAMP_NS,
        topic: str = "/points",
        frame: str = "lidar",
        height: int = 1,
        row_padding: int = 0,
        big: bool = False,
    ) -> None:
        """columns: by name, in order; 3 bytes stand between them."""
        kinds = [column.dtype.str[1:] for column in columns.values()]
        ends = np.cumsum([column.dtype.itemsize + 3 for column in columns.values()]).tolist()
        layout: Any = {
            "names": [*columns],
            "formats": [(">" if big else "<") + kind for kind in kinds],
            "offsets": [0, *ends[:-1]],
            "itemsize": ends[-1],
        }
        points = np.zeros(len(columns["x"]), np.dtype(layout))
        for name, column in columns.items():
            points[name] = column
        fields = [
            self.make("sensor_msgs/msg/PointField", name, offset, KINDS[kind], 1)
            for name, offset, kind in zip(columns, layout["offsets"], kinds, strict=True)
        ]
        rows = points.view(np.uint8).reshape(height, -1)
        data = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=9)
        shape = (self.header(stamp_ns, frame), height, len(points) // height)
        content = (fields, big, ends[-1], data.shape[1], data.reshape(-1), False)
        self.put(topic, "sensor_msgs/msg/PointCloud2", stamp_ns + PERIOD_NS, *shape, *content)

    def sweeps(self, num: int = 2, first_ns: int = STAMP_NS, **options: Any) -> None:
        for i in range(num):
            self.cloud(scan(), first_ns + i * PERIOD_NS, **options)

    def image(
        self,
        data: np.ndarray,
        encoding: str,
        topic: str = "/front/image_raw",
        step: int = 0,
        stamp_ns: int = STAMP_NS + 1,
        frame: str = "front_optical",
    ) -> None:
        """data: (H,W,...) as stored; step: bytes of a row, more than it needs."""
        raw = np.ascontiguousarray(data)
        height, width = raw.shape[:2]
        rows = raw.view(np.uint8).reshape(height, -1)
        step = step or rows.shape[1]
        rows = np.pad(rows, ((0, 0), (0, step - rows.shape[1])))
        header = self.header(stamp_ns, frame)
        values = (header, height, width, encoding, 0, step, rows.reshape(-1))
        self.put(topic, "sensor_msgs/msg/Image", stamp_ns + 1, *values)

    def compressed(
        self,
        data: bytes,
        topic: str = "/front/image_rect_color/compressed",
        stamp_ns: int = STAMP_NS + 5,
        frame: str = "front_optical",
    ) -> None:
        """data: of a PNG file."""
        values = (self.header(stamp_ns, frame), "png", np.frombuffer(data, np.uint8))
        self.put(topic, "sensor_msgs/msg/CompressedImage", stamp_ns + 1, *values)

    def info(self, topic: str = "/front/camera_info", size=(6, 8), **changes: Any) -> None:
        """changes: frame, model, d, k, r, p, binning, roi (x, y, height, width)."""
        K = changes.get("k", [100.0, 0, 3.5, 0, 110, 2.5, 0, 0, 1])
        P = changes.get("p", [90.0, 0, 3, 0, 0, 90, 2, 0, 0, 0, 1, 0])
        R = changes.get("r", np.eye(3).ravel())
        region = changes.get("roi", (0, 0, 0, 0))
        roi = self.make("sensor_msgs/msg/RegionOfInterest", *region, False)
        arrays = [np.array(a, float) for a in (changes.get("d", []), K, R, P)]
        header = self.header(STAMP_NS + 1, changes.get("frame", "front_optical"))
        values = (header, *size, changes.get("model", "plumb_bob"), *arrays)
        binning = changes.get("binning", (0, 0))
        self.put(topic, "sensor_msgs/msg/CameraInfo", STAMP_NS + 2, *values, *binning, roi)

    def transform(
        self, parent: str, child: str, T: np.ndarray, topic: str = "/tf_static", stamp_ns=STAMP_NS
    ) -> None:
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, T[:3, 3]))
        content = self.make("geometry_msgs/msg/Transform", vector, self.turn(T))
        header = self.header(stamp_ns, parent)
        stamped = self.make("geometry_msgs/msg/TransformStamped", header, child, content)
        self.put(topic, "tf2_msgs/msg/TFMessage", stamp_ns, [stamped])

    def turn(self, T: np.ndarray) -> Any:
        quaternion = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
        return self.make("geometry_msgs/msg/Quaternion", *quaternion)

    def odometry(self, T: np.ndarray, stamp_ns: int, child: str = "base") -> None:
        place = self.make("geometry_msgs/msg/Point", *map(float, T[:3, 3]))
        pose = self.make("geometry_msgs/msg/Pose", place, self.turn(T))
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/msg/Twist", zero, zero)
        cover = [
            self.make(f"geometry_msgs/msg/{name}WithCovariance", value, np.zeros(36))
            for name, value in (("Pose", pose), ("Twist", twist))
        ]
        header = self.header(stamp_ns, "odom")
        self.put("/odom", "nav_msgs/msg/Odometry", stamp_ns, header, child, *cover)

    def write(self, folder: Path, compressed: bool = False) -> Path:
        """The bag: a ROS 2 bag's folder, or a .bag file. compressed: its files as a whole."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.is_ros2:
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

            plugin = StoragePlugin.MCAP if self.suffix == ".mcap" else StoragePlugin.SQLITE3
            place = folder / "drive"
            writer: Any = Writer(place, version=9, storage_plugin=plugin)
            if compressed:
                writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
            serialize: Any = self.types.serialize_cdr
        else:
            from rosbags.rosbag1 import Writer as Writer1

            place = folder / "drive.bag"
            writer, serialize = Writer1(place), self.types.serialize_ros1
        with writer as bag:
            added = {
                topic: bag.add_connection(topic, type_, typestore=self.types)
                for topic, type_ in sorted({(r.topic, r.type) for r in self.written})
            }
            for record in sorted(self.written, key=lambda record: record.log_ns):
                data = serialize(record.message, record.type)
                bag.write(added[record.topic], record.log_ns, data)
        return place


def scan(num: int = 60) -> dict[str, np.ndarray]:
    """A ring, with times in nanoseconds since the stamp."""
    azimuth = np.linspace(-np.pi, np.pi, num, endpoint=False)
    return {
        "x": (8 * np.cos(azimuth)).astype("f4"),
        "y": (8 * np.sin(azimuth)).astype("f4"),
        "z": np.full(num, -0.5, "f4"),
        "intensity": np.arange(num).astype("f4"),
        "t": (np.arange(num) * (PERIOD_NS // num)).astype("u4"),
        "ring": np.zeros(num, "u2"),
    }
