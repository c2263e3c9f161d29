# SPDX-License-Identifier: MIT
"""Boxes of nuScenes and TruckScenes, ``sample_annotation.json``: those of the key frames, twice a
second, in the world.

Between two key frames an object is taken to go straight and to turn evenly, as the devkit's
``get_boxes`` has it (nuscenes-devkit, nuscenes/nuscenes.py). One that only one of the two knows is
carried on at the speed it has there, but followed to no other sweep: where it really is nobody drew
(the devkit lets it stand). Before the first key frame and after the last there are no boxes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Boxes, Float, Int
from densify.readers.file_sequence import checked_boxes, quaternion_pose
from densify.readers.nuscenes.tables import Record, find_records

TABLE = "sample_annotation.json"
_LENGTH_WIDTH_HEIGHT = [1, 0, 2]  # of the table's width, length, height


@dataclass(frozen=True)
class KeyBox:
    """T_world_box: (4,4). size_m: (3,) length, width, height."""

    T_world_box: Float
    size_m: Float


@dataclass(frozen=True)
class Annotations:
    """A scene's. key_ns: (n,) ascending stamps of its key frames. boxes: by key frame's place in
    ``key_ns``, and in each by the object's token."""

    where: str
    key_ns: Int
    boxes: tuple[Mapping[str, KeyBox], ...]

    @staticmethod
    def read(tables: Path, scene: str) -> Annotations | None:
        """scene: its token. None if there is no such table, or nothing of the scene in it. Raises
        InputError if a record is malformed, or an object is twice in one key frame."""
        path = tables / TABLE
        if not path.is_file():
            return None
        samples = find_records(tables / "sample.json", "scene_token", {scene})
        stamps_ns = {token: r.whole("timestamp") * 1000 for token, r in samples.items()}
        found: dict[str, dict[str, KeyBox]] = defaultdict(dict)
        for record in find_records(path, "sample_token", samples).values():
            instance, of_sample = record.text("instance_token"), record.text("sample_token")
            if instance in found[of_sample]:
                raise InputError(
                    f"{record.where}: a second box of the instance {instance} in the sample "
                    f"{of_sample}, expected one"
                )
            found[of_sample][instance] = _key_box(record)
        order = sorted(stamps_ns, key=stamps_ns.__getitem__)
        key_ns = np.array([stamps_ns[token] for token in order], np.int64)
        if not found or not len(key_ns):
            return None
        return Annotations(str(path), key_ns, tuple(found[token] for token in order))

    def at(self, stamp_ns: int, T_lidar_world: Float) -> Boxes | None:
        """The boxes of that time, in a lidar frame; None outside the key frames."""
        if not self.key_ns[0] <= stamp_ns <= self.key_ns[-1]:
            return None
        after = int(np.searchsorted(self.key_ns, stamp_ns))
        before = after if self.key_ns[after] == stamp_ns else after - 1
        track, found = [], []
        for instance in {**self.boxes[before], **self.boxes[after]}:
            followed = instance in self.boxes[before] and instance in self.boxes[after]
            track.append(instance if followed else "")
            found.append(self._box(instance, before, after, stamp_ns))
        return checked_boxes(
            track,
            T_lidar_world @ np.reshape([box.T_world_box for box in found], (-1, 4, 4)),
            np.reshape([box.size_m for box in found], (-1, 3)),
            f"{self.where}: at {stamp_ns} ns",
        )

    def _box(self, instance: str, before: int, after: int, stamp_ns: int) -> KeyBox:
        """Between two key frames, or carried on from the two nearest that know the object."""
        boxes = self.boxes
        for first, last in ((before, after), (after, after + 1), (before - 1, before)):
            inside = 0 <= first < last < len(boxes)
            if inside and instance in boxes[first] and instance in boxes[last]:
                here, there = boxes[first][instance], boxes[last][instance]
                span_ns = self.key_ns[last] - self.key_ns[first]
                share = float((stamp_ns - self.key_ns[first]) / span_ns)
                T = poses.interpolate(here.T_world_box, there.T_world_box, share)
                nearer = there if share > 0.5 else here
                return KeyBox(T, nearer.size_m)
        return {**boxes[before], **boxes[after]}[instance]


def _key_box(record: Record) -> KeyBox:
    rotation, translation = record.numbers("rotation", 4), record.numbers("translation", 3)
    size_m = record.numbers("size", 3)[_LENGTH_WIDTH_HEIGHT]
    return KeyBox(quaternion_pose(rotation, translation, record.where), size_m)
