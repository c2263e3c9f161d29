# SPDX-License-Identifier: MIT
"""Messages of ROS 1 and ROS 2 bags, by the rosbags package: no ROS is needed.

A bag is read through once, to learn the time stamp in the header of every message that matters;
of a large bag that index is kept in the user's cache. Messages are then read one at a time.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Int
from densify.readers.extras import needed

_LARGE_BYTES = 2**28
_KEPT_BYTES = 2**30
_MEND = "a bag that was cut off can be mended: rosbag reindex, ros2 bag reindex, mcap recover"


_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_LIVOX_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line"""
_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
{}/CustomPoint[] points"""
_DEFINITIONS = {"tf2_msgs/msg/TFMessage": _TRANSFORMS, "tf/msg/tfMessage": _TRANSFORMS}
for _package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces"):
    _DEFINITIONS[f"{_package}/msg/CustomPoint"] = _LIVOX_POINT
    _DEFINITIONS[f"{_package}/msg/CustomMsg"] = _LIVOX.format(_package)


class Entry(NamedTuple):
    """Where a message is. stamp_ns: of its header, or when it was recorded if that is 0. log_ns:
    when it was recorded; turn: which of the topic's messages recorded then."""

    stamp_ns: int
    log_ns: int
    turn: int


@dataclass(frozen=True)
class Topic:
    """type: such as sensor_msgs/msg/PointCloud2, whichever ROS it is from."""

    name: str
    type: str
    num_messages: int


class Bag:
    """path: a .bag, .db3 or .mcap file, a ROS 2 bag's folder, or a folder of .bag files that are
    parts of one recording. topics: by name."""

    def __init__(self, path: Path) -> None:
        """Raises InputError if it is no bag, or a damaged one."""
        self.path = path
        self._files = bag_files(path)
        self._is_ros2 = not (self._files[0].suffix == ".bag" and self._files[0].is_file())
        self._types = message_types(self._is_ros2)
        package = needed(f"rosbags.rosbag{2 if self._is_ros2 else 1}", "ros", "ROS bags")
        self._lock = RLock()
        try:
            self._readers = [package.Reader(file) for file in self._files]
            for reader in self._readers:
                reader.open()
            self.topics: Mapping[str, Topic] = _topics(self._readers)
        except Exception as error:  # a damaged bag makes the parser raise anything
            raise self._unreadable(error) from error

    def of_type(self, *types: str) -> list[Topic]:
        """Topics of one of these types, by name."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def index(self, topics: Collection[str]) -> dict[str, list[Entry]]:
        """Every message of these topics, whose types begin with a header, by ascending stamp."""
        names, files = sorted(topics), self._contents()
        size = sum(file.stat().st_size for file in files)
        if size < _LARGE_BYTES:
            found = self._read_index(names)
        else:
            from densify.config.cache import Cache

            state = [(str(f.absolute()), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
            found = Cache(_KEPT_BYTES).get(
                "bag", dict[str, Int], [state, names], lambda: self._read_index(names)
            )
        return {name: [Entry(*row) for row in found[name].tolist()] for name in names}

    def message(self, topic: str, entry: Entry) -> Any:
        """Raises InputError if it cannot be read."""
        found = list(self._messages([topic], entry.log_ns, entry.log_ns + 1))
        if len(found) <= entry.turn:
            raise InputError(f"{self.path}: no message of {topic} at {entry.log_ns} ns any more")
        _, _, raw, type_ = found[entry.turn]
        return self._decoded(raw, type_, topic)

    def messages(self, topic: str) -> Iterator[Any]:
        """All of a topic, in the order in which they were recorded."""
        for name, _, raw, type_ in self._messages([topic]):
            yield self._decoded(raw, type_, name)

    def _read_index(self, topics: Sequence[str]) -> dict[str, Int]:
        """(n,3) of each topic, the rows `Entry`s."""
        found: dict[str, list[Entry]] = {topic: [] for topic in topics}
        for topic, log_ns, raw, _ in self._messages(topics) if topics else ():
            before = found[topic][-1] if found[topic] else None
            turn = before.turn + 1 if before is not None and before.log_ns == log_ns else 0
            try:
                stamp_ns = _stamp_ns(raw, self._is_ros2)
            except struct.error:
                raise InputError(f"{self.path}: {topic}: a message of {len(raw)} bytes") from None
            found[topic].append(Entry(stamp_ns or log_ns, log_ns, turn))
        return {t: np.array(sorted(e), np.int64).reshape(-1, 3) for t, e in found.items()}

    def _messages(
        self, topics: Sequence[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes, str]]:
        parts = []
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            if wanted:  # none would mean all
                parts.append(reader.messages(wanted, start_ns, stop_ns))
        with self._lock:
            try:
                for connection, log_ns, raw in heapq.merge(*parts, key=lambda part: part[1]):
                    yield connection.topic, log_ns, raw, connection.msgtype
            except Exception as error:  # as above
                raise self._unreadable(error) from error

    def _decoded(self, raw: bytes, type_: str, topic: str) -> Any:
        try:
            if self._is_ros2:
                return self._types.deserialize_cdr(raw, type_)
            return self._types.deserialize_ros1(raw, type_)
        except Exception as error:  # as above
            raise InputError(
                f"{self.path}: {topic}: a message of {len(raw)} bytes is no whole {type_} "
                f"({' '.join(str(error).split()) or type(error).__name__})"
            ) from error

    def _contents(self) -> list[Path]:
        return [
            f for one in self._files for f in (sorted(one.iterdir()) if one.is_dir() else [one])
        ]

    def _unreadable(self, error: Exception) -> InputError:
        reason = " ".join(str(error).split()) or type(error).__name__
        return InputError(f"{self.path}: not a whole bag: {reason}; {_MEND}")


def message_types(is_ros2: bool) -> Any:
    """The messages that are read and written, as ROS defines them, and never as a bag does: rosbags
    makes code of definitions."""
    typesys = needed("rosbags.typesys", "ros", "ROS bags")
    stores = typesys.Stores
    types = typesys.get_typestore(stores.ROS2_JAZZY if is_ros2 else stores.ROS1_NOETIC)
    for name, text in _DEFINITIONS.items():
        if name not in types.types:
            types.register(typesys.get_types_from_msg(text, name))
    return types


def _topics(readers: Sequence[Any]) -> dict[str, Topic]:
    """Those with messages, of all parts of the recording, by name."""
    found: dict[str, Topic] = {}
    for reader in readers:
        for connection in reader.connections:
            name, before = connection.topic, found.get(connection.topic)
            num = connection.msgcount + (before.num_messages if before else 0)
            same = before is None or before.type == connection.msgtype
            type_ = connection.msgtype if same else "of several types"
            if num:
                found[name] = Topic(name, type_, num)
    return dict(sorted(found.items()))


def bag_files(path: Path) -> list[Path]:
    """What is to be opened: the file, a ROS 2 bag's folder, or the bags in a folder. Raises
    InputError if there are none."""
    suffixes = (".bag", ".db3", ".mcap")
    if path.is_file() and path.suffix in suffixes:
        return [path]
    if (path / "metadata.yaml").is_file():
        return [path]
    for suffix in suffixes:
        found = sorted(path.glob(f"*{suffix}")) if path.is_dir() else []
        if found and (suffix == ".bag" or len(found) == 1):
            return found
        if found:
            raise InputError(
                f"{path}: {len(found)} {suffix} files without metadata.yaml; name one of them, or "
                f"write it with ros2 bag reindex"
            )
    raise InputError(
        f"{path}: no bag; expected a .bag, .mcap or .db3 file, or a ROS 2 bag's folder"
    )


def _stamp_ns(raw: bytes, is_ros2: bool) -> int:
    """The stamp in the header that a message begins with."""
    if is_ros2:  # an encapsulation of four bytes, whose second tells the order
        seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    else:  # a sequence number
        seconds, nanoseconds = struct.unpack_from("<II", raw, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
