# SPDX-License-Identifier: MIT
"""Tables of nuScenes: JSON files of flat records with a token, and their boxes.

The tables of a whole data set have millions of records. Of large files only the records asked for
are parsed.
"""

from __future__ import annotations

import mmap
import re
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import open_file, parse_json, read_json, reason
from densify.geometry.poses import interpolate
from densify.geometry.types import Boxes, Float, Int
from densify.readers.extras import described_in
from densify.readers.file_sequence import checked_boxes, quaternion_pose

_RECORD = re.compile(rb"\{[^{}]*\}")
_LENGTH_WIDTH_HEIGHT = [1, 0, 2]  # of the table's width, length, height
EXPECTED = "a table of nuScenes: records of tokens, stamps and poses"

Record = dict[str, Any]


def stamp_ns(record: Record) -> int:
    """Return the time of a record; the tables have microseconds."""
    return int(np.int64(int(record["timestamp"]) * 1000))


def pose_of(record: Record, where: str) -> Float:
    """Return the (4,4) of its rotation and translation."""
    return quaternion_pose(record["rotation"], record["translation"], where)


def read_table(path: Path) -> dict[str, Record]:
    """Return all records by token. Raises InputError if the file is missing or no such table."""
    with described_in(path, EXPECTED):
        return {str(record["token"]): record for record in read_json(_existing(path))}


def find_records(path: Path, key: str, wanted: Collection[str]) -> dict[str, Record]:
    """Return the records, by token, whose ``key`` is one of ``wanted``; others are not parsed.

    Raises InputError if the file is missing or cut off, or one of the records is malformed.
    """
    pattern = re.compile(rb'"%s"\s*:\s*"([^"]*)"' % key.encode())
    names = frozenset(name.encode() for name in wanted)
    found = []
    try:
        with (
            open_file(_existing(path)) as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            if data[:4096].lstrip()[:1] != b"[" or data[-4096:].rstrip()[-1:] != b"]":
                raise ValueError("it does not begin with [ or end with ]")
            for match in _RECORD.finditer(data):
                of = pattern.search(match[0])
                if of and of[1] in names:
                    found.append(parse_json(match[0], path))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not a whole JSON table: {reason(error)}; fetch it again"
        ) from error
    with described_in(path, EXPECTED):
        return {str(record["token"]): record for record in found}


def _existing(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"{path}: no such table; fetch the data set's metadata")
    return path


class KeyBox(NamedTuple):
    """T_world_box: (4,4). size_m: (3,) length, width, height."""

    T_world_box: Float
    size_m: Float


@dataclass(frozen=True)
class Annotations:
    """Boxes of a scene's key frames (2 Hz), from ``sample_annotation.json``.

    key_ns: (n,) ascending stamps of the key frames. boxes: per key frame, by the object's token.

    Between two key frames an object moves straight and turns evenly, as in the devkit's
    ``get_boxes``. An object that only one of the two has is carried on at its speed and gets no
    track: nobody drew where it really is (the devkit lets it stand). There are no boxes before the
    first key frame and after the last.
    """

    where: str
    key_ns: Int
    boxes: tuple[Mapping[str, KeyBox], ...]

    @staticmethod
    def read(tables: Path, scene: str) -> Annotations | None:
        """scene: its token. None without the table, or without a box in the scene. Raises
        InputError if a record is malformed, or an object is twice in a key frame."""
        path = tables / "sample_annotation.json"
        if not path.is_file():
            return None
        samples = find_records(tables / "sample.json", "scene_token", {scene})
        found: dict[str, dict[str, KeyBox]] = defaultdict(dict)
        with described_in(path, EXPECTED):
            stamps_ns = {token: stamp_ns(record) for token, record in samples.items()}
            for token, record in find_records(path, "sample_token", samples).items():
                where, boxes = f"{path}: record {token}", found[record["sample_token"]]
                if record["instance_token"] in boxes:
                    raise InputError(
                        f"{where}: a second box of the instance {record['instance_token']} in the "
                        f"sample {record['sample_token']}, expected one"
                    )
                size_m = np.array(record["size"], np.float64)[_LENGTH_WIDTH_HEIGHT]
                boxes[record["instance_token"]] = KeyBox(pose_of(record, where), size_m)
        order = sorted(stamps_ns, key=stamps_ns.__getitem__)
        key_ns = np.array([stamps_ns[token] for token in order], np.int64)
        return Annotations(str(path), key_ns, tuple(found[t] for t in order)) if found else None

    def at(self, stamp_ns: int, T_lidar_world: Float) -> Boxes | None:
        """Return the boxes of that time in a lidar frame, None outside the key frames."""
        if not self.key_ns[0] <= stamp_ns <= self.key_ns[-1]:
            return None
        after = int(np.searchsorted(self.key_ns, stamp_ns))
        before = after if self.key_ns[after] == stamp_ns else after - 1
        here, there = self.boxes[before], self.boxes[after]
        track = [name if name in here and name in there else "" for name in {**here, **there}]
        found = [self._box(name, before, after, stamp_ns) for name in {**here, **there}]
        return checked_boxes(
            track,
            T_lidar_world @ np.reshape([box.T_world_box for box in found], (-1, 4, 4)),
            np.reshape([box.size_m for box in found], (-1, 3)),
            f"{self.where}: at {stamp_ns} ns",
        )

    def _box(self, instance: str, before: int, after: int, stamp_ns: int) -> KeyBox:
        """Interpolate, or extrapolate from the two nearest key frames that have the object."""
        boxes = self.boxes
        for first, last in ((before, after), (after, after + 1), (before - 1, before)):
            inside = 0 <= first < last < len(boxes)
            if inside and instance in boxes[first] and instance in boxes[last]:
                here, there = boxes[first][instance], boxes[last][instance]
                span_ns = self.key_ns[last] - self.key_ns[first]
                share = float((stamp_ns - self.key_ns[first]) / span_ns)
                T = interpolate(here.T_world_box, there.T_world_box, share)
                return KeyBox(T, (there if share > 0.5 else here).size_m)
        return {**boxes[before], **boxes[after]}[instance]
