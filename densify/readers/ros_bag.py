# SPDX-License-Identifier: MIT
"""Read messages of ROS bags without ROS; one scan indexes header stamps, decoding is on demand."""

from __future__ import annotations

import heapq
import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple
from urllib.parse import parse_qsl
from zlib import crc32

from densify.config.errors import InputError
from densify.config.file_content import needed, open_file, reason

_MCAP = b"\x89MCAP0\r\n"  # begins and ends a file
_MEND = "a bag that was cut off can be mended: rosbag reindex, ros2 bag reindex, mcap recover"

_DRIVERS = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\n"
_LIVOX_POINT += "uint8 tag\nuint8 line"
_LIVOX = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
)
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_DEFINITIONS = {"tf2_msgs/msg/TFMessage": _TRANSFORMS, "tf/msg/tfMessage": _TRANSFORMS}
for _package in _DRIVERS:
    _DEFINITIONS[f"{_package}/msg/CustomPoint"] = _LIVOX_POINT
    _DEFINITIONS[f"{_package}/msg/CustomMsg"] = f"{_LIVOX}{_package}/CustomPoint[] points"

_CLOUDS = ("sensor_msgs/msg/PointCloud2", *(f"{package}/msg/CustomMsg" for package in _DRIVERS))
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (
    _ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
_USAGE = "#points=/topic,/topic&images=/topic,/topic&poses=/topic, tf or none"
_NO_PICTURES = re.compile(r"depth|disparity|theora|mask|confidence")


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
    """A ROS 1 or ROS 2 bag, opened for reading."""

    def __init__(self, path: Path) -> None:
        # A .bag, .db3 or .mcap file, the folder of a ROS 2 bag, or a folder of .bag files that are
        # parts of one recording
        self.path = path
        self._files = _bag_files(path)
        self._is_ros2 = not (self._files[0].suffix == ".bag" and self._files[0].is_file())
        self._types = message_types(self._is_ros2)
        for file in self._files:
            for data_file in [file] if file.is_file() else file.glob("*.*"):
                open_file(data_file).close()  # raises a clear error for an unreadable file
        package = needed(f"rosbags.rosbag{2 if self._is_ros2 else 1}", "ros", "ROS bags")
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
        """Index the messages of the topics by ascending stamp.

        Messages without a stamp are counted. A message that was recorded twice is indexed once and
        counted.
        """
        entries_of_topic: dict[str, list[Entry]] = {topic: [] for topic in topics}
        last = dict.fromkeys(topics, (-1, 0))  # time of recording and turn of the last message
        indexed: set[tuple[str, int, int]] = set()
        for topic, log_ns, raw, _ in self._messages(topics) if topics else ():
            turn = last[topic][1] + 1 if last[topic][0] == log_ns else 0
            last[topic] = log_ns, turn
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
        """Decode the message of an index entry; raise InputError if it is missing or damaged."""
        recorded = list(self._messages([topic], entry.log_ns, entry.log_ns + 1))
        if len(recorded) <= entry.turn:
            raise InputError(f"{self.path}: no message of {topic} at {entry.log_ns} ns any more")
        _, _, raw, type_ = recorded[entry.turn]
        return self._decoded(raw, type_, topic)

    def messages(self, topic: str) -> Iterator[Any]:
        """Yield all decoded messages of a topic in the order of recording."""
        for name, _, raw, type_ in self._messages([topic]):
            yield self._decoded(raw, type_, name)

    def _messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes, str]]:
        """Yield topic, recording time (ns), raw bytes and message type, by recording time."""
        streams = []
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            if wanted:  # an empty list would mean all
                streams.append(reader.messages(wanted, start_ns, stop_ns))
        with self._lock:
            try:
                for connection, log_ns, raw in heapq.merge(*streams, key=lambda record: record[1]):
                    yield connection.topic, log_ns, raw, connection.msgtype
            except Exception as error:  # the parser may raise any type
                raise self._unreadable(error) from error

    def _decoded(self, raw: bytes, type_: str, topic: str) -> Any:
        decode = self._types.deserialize_cdr if self._is_ros2 else self._types.deserialize_ros1
        try:
            return decode(raw, type_)
        except Exception as error:  # the parser may raise any type
            raise InputError(
                f"{self.path}: {topic}: a message of {len(raw)} bytes is no whole {type_} "
                f"({reason(error)})"
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
    typesys = needed("rosbags.typesys", "ros", "ROS bags")
    stores = typesys.Stores
    types = typesys.get_typestore(stores.ROS2_JAZZY if is_ros2 else stores.ROS1_NOETIC)
    for name, text in _DEFINITIONS.items():
        if name not in types.types:
            types.register(typesys.get_types_from_msg(text, name))
    return types


def _mcap_profile(file: Path) -> str | None:
    """Return the profile that a whole MCAP file states, "" for none; None for other files."""
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
        files = sorted(path.glob(f"*{suffix}")) if path.is_dir() else []
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


@dataclass(frozen=True)
class Topics:
    """The topics of a bag that are used."""

    points: tuple[str, ...]  # topics of the lidars. Each message of the first topic is a sweep.
    images: tuple[str, ...]  # topics of the cameras' images
    poses: str  # topic of the poses, ``tf`` for /tf, or "" to read no poses
    # Options that the user gave (points, images, poses). A problem with a named topic is an error;
    # other unusable topics are skipped.
    named: Collection[str]

    @staticmethod
    def choose(bag: Bag, options: str | None) -> Topics:
        """Choose the topics to read, by the user's options (after ``#``) and the message types."""
        chosen = dict(parse_qsl(options or "", keep_blank_values=True))
        wrong = [key for key in chosen if key not in ("points", "images", "poses")]
        if wrong or (options and not chosen):
            raise InputError(
                f"{bag.path}#{options}: got {wrong[0] if wrong else options}, expected {_USAGE}"
            )
        images = _guessed_images([topic.name for topic in bag.of_type(*_IMAGES)])
        odometry = bag.of_type(_ODOMETRY)
        poses = chosen.get("poses") or (odometry[0].name if len(odometry) == 1 else "tf")
        if "points" not in chosen:
            chosen["points"] = _only_cloud(bag)
        if "images" in chosen:
            named = chosen["images"].replace("none", "")
            images = named.split(",") if named else []
        _check_topics(bag, "points", chosen["points"].split(","), _CLOUDS)
        _check_topics(bag, "images", images, _IMAGES)
        _check_topics(bag, "poses", [poses] if poses not in ("none", "tf") else [], POSES)
        points = tuple(chosen["points"].split(","))
        return Topics(points, tuple(images), poses.replace("none", ""), chosen.keys())


def _only_cloud(bag: Bag) -> str:
    """Return the only topic of point clouds; raise InputError for no or several topics."""
    clouds = bag.of_type(*_CLOUDS)
    if len(clouds) == 1:
        return clouds[0].name
    if clouds:
        raise InputError(
            f"{bag.path}: several topics could be the sweeps: {_listed(clouds)}; name one "
            f"or all lidars of the vehicle: --data 'ros:{bag.path}#points=/topic,/topic'"
        )
    raise InputError(
        f"{bag.path}: no PointCloud2; got {_listed(list(bag.topics.values())) or 'no messages'}; "
        f"play raw packets through the sensor's driver and record the points that come out"
    )


def _guessed_images(topics: Sequence[str]) -> list[str]:
    """Return one image topic for each camera, preferably rectified, then uncompressed."""
    best: dict[str, str] = {}
    for topic in sorted(topics, key=lambda t: ("rect" not in t, t.endswith("/compressed"), t)):
        if not _NO_PICTURES.search(topic.lower()):
            best.setdefault(place_of(topic), topic)
    return sorted(best.values())


def place_of(topic: str) -> str:
    """Return the camera's namespace: ``/front/image_raw/compressed`` gives ``/front``."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _check_topics(bag: Bag, option: str, names: Sequence[str], types: Sequence[str]) -> None:
    for name in names:
        topic = bag.topics.get(name)
        if topic is None or topic.type not in types:
            got = "no such topic" if topic is None else f"a topic of {topic.type}"
            fit = _listed(bag.of_type(*types)) or "none"
            raise InputError(f"{bag.path}: {option}={name}: {got}; topics that fit: {fit}")


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.type.rpartition('/')[2]}, {t.num_messages})" for t in topics)
