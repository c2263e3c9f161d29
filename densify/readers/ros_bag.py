# SPDX-License-Identifier: MIT
"""Read ROS bags without ROS: index header stamps in one scan, and decode messages on demand."""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import import_extra, open_file, reason
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.decoded_files import decode_image

_MCAP = b"\x89MCAP0\r\n"  # begins and ends a file
_MEND = "a bag that was cut off can be mended: rosbag reindex, ros2 bag reindex, mcap recover"

_LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
_LIVOX_CLOUD = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
)
_LIVOX = {"x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "offset_time": "u4", "line": "u1"}
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_DEFINITIONS = dict.fromkeys(TRANSFORMS, "geometry_msgs/TransformStamped[] transforms")
for _package in _LIVOX_PACKAGES:
    _DEFINITIONS[f"{_package}/msg/CustomPoint"] = _LIVOX_POINT
    _DEFINITIONS[f"{_package}/msg/CustomMsg"] = f"{_LIVOX_CLOUD}{_package}/CustomPoint[] points"

CLOUDS = ("sensor_msgs/msg/PointCloud2", *(f"{name}/msg/CustomMsg" for name in _LIVOX_PACKAGES))
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LENSES = {  # densify's lens model, and allowed numbers of coefficients
    "plumb_bob": ("pinhole", (4, 5)),
    "radtan": ("pinhole", (4, 5)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "thin_prism": ("pinhole", (12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
    "kannala_brandt4": ("fisheye", (4,)),
}
_ENCODINGS = {  # channels, type of a value, and OpenCV's conversion to RGB
    "rgb8": (3, "u1", None),
    "bgr8": (3, "u1", "COLOR_BGR2RGB"),
    "rgba8": (4, "u1", "COLOR_RGBA2RGB"),
    "bgra8": (4, "u1", "COLOR_BGRA2RGB"),
    "8uc3": (3, "u1", "COLOR_BGR2RGB"),
    "mono8": (1, "u1", "COLOR_GRAY2RGB"),
    "8uc1": (1, "u1", "COLOR_GRAY2RGB"),
    "mono16": (1, "u2", "COLOR_GRAY2RGB"),
    "16uc1": (1, "u2", "COLOR_GRAY2RGB"),
    # OpenCV names a mosaic by the second row's second and third pixel, ROS by its first two
    "bayer_rggb8": (1, "u1", "COLOR_BayerBG2RGB"),
    "bayer_bggr8": (1, "u1", "COLOR_BayerRG2RGB"),
    "bayer_gbrg8": (1, "u1", "COLOR_BayerGR2RGB"),
    "bayer_grbg8": (1, "u1", "COLOR_BayerGB2RGB"),
    "yuv422": (2, "u1", "COLOR_YUV2RGB_UYVY"),
    "uyvy": (2, "u1", "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "u1", "COLOR_YUV2RGB_YUYV"),
    "yuyv": (2, "u1", "COLOR_YUV2RGB_YUYV"),
}


class Entry(NamedTuple):
    """Index entry that finds one message of a topic."""

    stamp_ns: int  # time in the header of the message; the time of recording if the header has 0
    log_ns: int  # time at which the message was recorded
    turn: int  # index of the message among the topic's messages with the same ``log_ns``


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    type: str  # message type in ROS 2 notation, such as sensor_msgs/msg/PointCloud2
    num_messages: int


class Bag:
    """A ROS 1 or ROS 2 bag, opened for reading. A missing or damaged bag raises InputError."""

    def __init__(self, path: Path) -> None:
        # Path of a .bag, .db3 or .mcap file, of a ROS 2 bag's folder, or of a folder with the .bag
        # files of one recording
        self.path = path
        self._files = _bag_files(path)
        self._is_ros2 = not (self._files[0].suffix == ".bag" and self._files[0].is_file())
        self._types = message_types(self._is_ros2)
        for file in self._files:
            for data_file in [file] if file.is_file() else file.glob("*.*"):
                open_file(data_file).close()  # raises a clear error for an unreadable file
        package = import_extra(f"rosbags.rosbag{2 if self._is_ros2 else 1}", "ros", "ROS bags")
        self._lock = RLock()
        # Indexed messages without a header stamp, and messages recorded twice, by topic
        self.num_unstamped = Counter[str]()
        self.num_twice = Counter[str]()
        try:
            self._readers = [package.Reader(file) for file in self._files]
            for reader in self._readers:
                reader.open()
            self.topics: Mapping[str, Topic] = _topics(self._readers)
        except Exception as error:  # a damaged bag makes the parser raise anything
            raise self._unreadable(error) from error

    def of_type(self, *types: str) -> list[Topic]:
        """Return the topics whose message type is one of ``types``, sorted by name."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def index(self, topics: Collection[str]) -> dict[str, list[Entry]]:
        """Return each topic's entries by ascending stamp, without decoding the messages.

        A message recorded twice has one entry. This adds to ``num_unstamped`` and ``num_twice``.
        """
        entries_of_topic: dict[str, list[Entry]] = {topic: [] for topic in topics}
        num_recorded_at = Counter[tuple[str, int]]()
        indexed = set[tuple[str, int, int]]()
        for connection, log_ns, raw in self._messages(topics):
            topic = connection.topic
            turn = num_recorded_at[topic, log_ns]
            num_recorded_at[topic, log_ns] += 1
            try:
                stamp_ns = _stamp_ns(raw, self._is_ros2)
            except struct.error:
                raise InputError(f"{self.path}: {topic}: a message of {len(raw)} bytes") from None
            content = topic, stamp_ns or log_ns, crc32(raw)
            self.num_twice[topic] += content in indexed
            if content not in indexed:
                entries_of_topic[topic].append(Entry(stamp_ns or log_ns, log_ns, turn))
                self.num_unstamped[topic] += not stamp_ns
            indexed.add(content)
        return {topic: sorted(entries) for topic, entries in entries_of_topic.items()}

    def message(self, topic: str, entry: Entry) -> Any:
        """Return the decoded message of an index entry. Raise InputError if damaged or missing."""
        recorded = list(self._messages([topic], entry.log_ns, entry.log_ns + 1))
        if len(recorded) <= entry.turn:
            raise InputError(f"{self.path}: no message of {topic} at {entry.log_ns} ns any more")
        return self._decoded(*recorded[entry.turn])

    def messages(self, topic: str) -> Iterator[Any]:
        """Yield all decoded messages of a topic in the order of recording."""
        for recorded in self._messages([topic]):
            yield self._decoded(*recorded)

    def _messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Any, int, bytes]]:
        """Yield rosbags' connection, recording time (ns) and raw bytes of messages, by the time."""
        streams = []
        for reader in self._readers:
            connections = [c for c in reader.connections if c.topic in topics]
            if connections:  # an empty list would mean all
                streams.append(reader.messages(connections, start_ns, stop_ns))
        with self._lock:
            try:
                yield from heapq.merge(*streams, key=lambda record: record[1])
            except Exception as error:  # the parser may raise any type
                raise self._unreadable(error) from error

    def _decoded(self, connection: Any, log_ns: int, raw: bytes) -> Any:
        decode = self._types.deserialize_cdr if self._is_ros2 else self._types.deserialize_ros1
        try:
            return decode(raw, connection.msgtype)
        except Exception as error:  # the parser may raise any type
            raise InputError(
                f"{self.path}: {connection.topic}: a message of {len(raw)} bytes is no whole "
                f"{connection.msgtype} ({reason(error)})"
            ) from error

    def _unreadable(self, error: Exception) -> InputError:
        for file in self._files:
            profile = _mcap_profile(file)
            if profile is not None and profile != "ros2":
                written = f"messages of {profile}" if profile else "messages of other programs"
                return InputError(
                    f"{file}: is a whole MCAP file with {written}, as densify export writes it; "
                    f"expected a bag that ROS 2 recorded (profile ros2)"
                )
        return InputError(f"{self.path}: not a whole bag: {reason(error)}; {_MEND}")


def message_types(is_ros2: bool) -> Any:
    """Return the rosbags type store with the standard, /tf and Livox message types."""
    # Definitions in a bag are not used, because rosbags turns definitions into executable code.
    typesys = import_extra("rosbags.typesys", "ros", "ROS bags")
    stores = typesys.Stores
    types = typesys.get_typestore(stores.ROS2_JAZZY if is_ros2 else stores.ROS1_NOETIC)
    for name, text in _DEFINITIONS.items():
        if name not in types.types:
            types.register(typesys.get_types_from_msg(text, name))
    return types


def _mcap_profile(file: Path) -> str | None:
    """Return the profile that a whole MCAP file states, "" for none, or None for other files."""
    if not file.is_file():
        return None
    with open_file(file) as opened:
        begin = opened.read(4096)
        opened.seek(max(0, opened.seek(0, 2) - len(_MCAP)))
        if not begin.startswith(_MCAP) or opened.read() != _MCAP or len(begin) < 21:
            return None
    # The header record follows: its kind (1 byte) and length (8), then length and text of a string.
    (num_bytes,) = struct.unpack_from("<I", begin, 17)
    return begin[21 : 21 + num_bytes].decode("utf-8", "replace")


def _topics(readers: Sequence[Any]) -> dict[str, Topic]:
    """Return the topics with messages over all files of the recording, by name."""
    topic_of_name: dict[str, Topic] = {}
    for connection in (c for reader in readers for c in reader.connections if c.msgcount):
        name = connection.topic
        before = topic_of_name.get(name, Topic(name, connection.msgtype, 0))
        type_ = before.type if before.type == connection.msgtype else "of several types"
        topic_of_name[name] = Topic(name, type_, before.num_messages + connection.msgcount)
    return dict(sorted(topic_of_name.items()))


def _bag_files(path: Path) -> list[Path]:
    """Return the paths to open: a file, a ROS 2 bag's folder, or all .bag files in a folder."""
    suffixes = (".bag", ".db3", ".mcap")
    if (path.is_file() and path.suffix in suffixes) or (path / "metadata.yaml").is_file():
        return [path]
    packed = [path] if path.suffix == ".zstd" and path.is_file() else sorted(path.glob("*.zstd"))
    if packed:
        raise InputError(
            f"{packed[0]}: is compressed as a whole; name the bag's folder with its metadata.yaml, "
            f"or decompress it by zstd -d {packed[0].name} and name {packed[0].stem}"
        )
    for suffix in suffixes:
        files = sorted(path.glob(f"*{suffix}"))
        if files and (suffix == ".bag" or len(files) == 1):
            return files
        if files:
            raise InputError(
                f"{path}: {len(files)} {suffix} files without metadata.yaml; name one of them, or "
                f"write it with ros2 bag reindex"
            )
    raise InputError(
        f"{path}: no bag; expected a .bag, .mcap or .db3 file, or a ROS 2 bag's folder"
    )


def _stamp_ns(raw: bytes, is_ros2: bool) -> int:
    """Return the stamp (ns) of the header with which a raw message begins, 0 if not set."""
    if is_ros2:  # a CDR header of 4 bytes comes first; byte 1 is the byte order
        seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    else:  # a sequence number of 4 bytes comes first
        seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


# Contents of messages


def cloud_columns(message: Any, where: str) -> dict[str, NDArray[Any]]:
    """Return the single numbers of a cloud message by name, (N,) as stored, or raise InputError."""
    if not hasattr(message, "point_step"):
        rows = [tuple(getattr(point, name) for name in _LIVOX) for point in message.points]
        table = np.array(rows, list(_LIVOX.items()))
        return {name: table[name] for name in _LIVOX}
    order = ">" if message.is_bigendian else "<"
    formats: dict[str, str] = {}
    offsets: list[int] = []
    for entry in message.fields:
        if entry.count > 1 or not entry.name or entry.name in formats:
            continue
        kind = _DATATYPES.get(entry.datatype)
        if kind is None or entry.offset + int(kind[1]) > message.point_step:
            raise InputError(
                f"{where}: field {entry.name}: got type {entry.datatype} at byte {entry.offset} of "
                f"{message.point_step}, expected one of ROS's eight types inside the point"
            )
        formats[entry.name] = order + kind
        offsets.append(entry.offset)
    layout: Any = {"names": [*formats], "formats": [*formats.values()], "offsets": offsets}
    # Some drivers leave the step of an only row at zero.
    step = message.row_step or message.width * message.point_step * (message.height == 1)
    points_of_rows = _rows(message, step, message.point_step, where)
    points = points_of_rows.reshape(-1).view(np.dtype(layout | {"itemsize": message.point_step}))
    return {name: points[name] for name in formats}


def _rows(message: Any, step: int, item_bytes: int, where: str) -> NDArray[np.uint8]:
    """Return a message's data without row padding, as bytes (height, width · item_bytes)."""
    data, used = np.ascontiguousarray(message.data, np.uint8), message.width * item_bytes
    if step < used or len(data) < message.height * step:
        raise InputError(
            f"{where}: got {len(data)} bytes and rows of {step}, expected {message.height} rows of "
            f"{message.width} times {item_bytes} bytes"
        )
    rows = data[: message.height * step].reshape(message.height, step)
    return np.ascontiguousarray(rows[:, :used])


def check_encoding(message: Any, where: str) -> None:
    """Raise InputError for an Image or CompressedImage message in an encoding that is not read."""
    if hasattr(message, "format"):
        begin = bytes(np.asarray(message.data[:8], np.uint8))
        if not begin.startswith((b"\xff\xd8", b"\x89PNG")):
            raise InputError(
                f"{where}: got images of the format {message.format!r}, expected JPEG or PNG; "
                f"leave the camera out: name others with #images="
            )
    elif message.encoding.lower() not in _ENCODINGS:
        raise InputError(
            f"{where}: got the encoding {message.encoding}, expected one of "
            f"{', '.join(_ENCODINGS)}; leave the camera out: name others with #images="
        )


def image_rgb(message: Any, where: str) -> NDArray[np.uint8]:
    """Return an Image or CompressedImage message as (H,W,3) uint8 RGB, or raise InputError."""
    import cv2

    check_encoding(message, where)
    if hasattr(message, "format"):
        bgr = decode_image(np.ascontiguousarray(message.data, np.uint8).tobytes(), where)
        return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
    channels, kind, conversion = _ENCODINGS[message.encoding.lower()]
    pixels = _rows(message, message.step, channels * int(kind[1]), where)
    if kind == "u2":
        order = ">" if message.is_bigendian else "<"
        pixels = (pixels.view(order + kind) >> 8).astype(np.uint8)
    pixels = pixels.reshape(message.height, message.width, channels)
    if conversion is None:
        return pixels
    return np.ascontiguousarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), dtype=np.uint8)


def camera_of(info: Any, name: str, T_optical_lidar: Float, rectified: bool, where: str) -> Camera:
    """Return the camera of a CameraInfo message, adjusted for binning and region of interest.

    Args:
        info: Decoded CameraInfo message.
        name: Name of the camera.
        T_optical_lidar: (4,4) pose of the lidar in the message's optical frame.
        rectified: True for rectified images, which use P and the rotation R; raw images use K and
            the distortion D.
        where: Topic, with which the message of an InputError begins.
    """
    matrix = {  # ROS 1 writes K, ROS 2 k
        key: np.asarray(getattr(info, key if hasattr(info, key) else key.upper()), np.float64)
        for key in "kdrp"
    }
    K = (matrix["p"].reshape(3, 4)[:, :3] if rectified else matrix["k"].reshape(3, 3)).copy()
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or abs(K[2, 2] - 1) > 1e-6:
        raise InputError(
            f"{where}: got {'P' if rectified else 'K'} = {np.round(K.ravel(), 4).tolist()}, "
            f"expected a calibration with positive focal lengths"
        )
    if min(info.width, info.height) < 1:
        raise InputError(f"{where}: got {info.width} x {info.height} px, expected the image's size")
    T, model, distortion = T_optical_lidar, "pinhole", tuple[float, ...]()
    if not rectified:
        model, distortion = _lens(info.distortion_model, tuple(matrix["d"].tolist()), where)
    elif matrix["r"].any():  # drivers leave zeros where they do not say
        T = checks.pose(np.column_stack([matrix["r"].reshape(3, 3), np.zeros(3)]), where) @ T
    camera = Camera(name, int(info.width), int(info.height), K, T, distortion, model)
    return _binned(camera, info)


def _lens(named: str, distortion: tuple[float, ...], where: str) -> tuple[str, tuple[float, ...]]:
    """Return densify's lens model and coefficients for ROS's distortion model and D."""
    model, counts = _LENSES.get(named, ("pinhole", ()))
    if not any(distortion) and model == "pinhole":
        return "pinhole", ()
    if len(distortion) not in counts:
        raise InputError(
            f"{where}: got {len(distortion)} coefficients of the distortion model {named!r}, "
            f"expected one of {', '.join(_LENSES)}, with "
            f"{' or '.join(str(n) for n in counts) or 'its'} coefficients; name rectified images "
            f"with #images="
        )
    return model, distortion


def _binned(camera: Camera, info: Any) -> Camera:
    """Adjust a camera to the region of interest and the binning of a CameraInfo."""
    # Binning averages sensor pixels. Coordinates from the image's corner, which lies half a pixel
    # before the centre of the first pixel, shrink by the binning.
    region = info.roi
    binning = np.array([max(1, info.binning_x), max(1, info.binning_y)])
    size = [region.width or camera.width_px, region.height or camera.height_px]
    K = camera.K.copy()
    K[:2, 2] -= (region.x_offset, region.y_offset)
    K[:2, 2] = (K[:2, 2] + 0.5) / binning - 0.5
    K[[0, 1], [0, 1]] /= binning
    width_px, height_px = (int(size[axis] // binning[axis]) for axis in range(2))
    return replace(camera, K=K, width_px=width_px, height_px=height_px)
