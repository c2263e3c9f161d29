# SPDX-License-Identifier: MIT
"""Read nuScenes (Caesar et al., CVPR 2020) without its devkit; ``#scene-0061`` names a scene.

    ROOT/v1.0-trainval/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor}.json
    ROOT/v1.0-trainval/sample_annotation.json    optional: tracked boxes
    ROOT/{samples,sweeps}/LIDAR_TOP/*.pcd.bin    ROOT/samples/CAM_FRONT/*.jpg ...

Sweeps and each camera's images are numbered by time from 0; a missing file's number is skipped.
Images are undistorted and stamped at the exposure.

The scanner is one HDL-32E at 20 Hz. Points are in the scanner's frame (x right, y forward, z up),
ego-motion compensated to the sweep's stamp, the time of the *last* packet, and have no times. A
file lists the firings in order, 32 rings each, 46.08 µs apart (HDL-32E manual, 9.3): firing c of n
is (c + 1 - n) · 46.08 µs after the stamp. With these times the compensation is undone.
"""

from __future__ import annotations

import codecs
import mmap
import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os.path import isfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import (
    described_in,
    open_file,
    parse_json,
    read_bytes,
    read_json,
    reason,
)
from densify.geometry.poses import interpolate, inverse
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers import checks
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.recorded_poses import PoseTrack

_COLUMN_NS = 46_080  # between two firings of an HDL-32E
_NO_RETURN_M = 0.05
_FIRST_CAMERA = "CAM_FRONT"
_RECORD = re.compile(rb"\{[^{}]*\}")
_LENGTH_WIDTH_HEIGHT = [1, 0, 2]  # of the table's width, length, height
_EXPECTED = "a table of nuScenes: records of tokens, stamps and poses"

Record = dict[str, Any]


def stamp_ns(record: Record) -> int:
    """Return the time of a record in nanoseconds since 1970. Tables have microseconds."""
    return int(np.int64(int(record["timestamp"]) * 1000))


def _pose_of(record: Record, path: Path) -> Float:
    """Return the (4,4) pose (m) of a record of the table at ``path``."""
    where = f"{path}: record {record['token']}"
    return checks.quaternion_pose(record["rotation"], record["translation"], where)


def read_table(path: Path) -> dict[str, Record]:
    """Return the records of a JSON table by token. Raise InputError if missing or damaged."""
    with described_in(path, _EXPECTED):
        return {str(record["token"]): record for record in read_json(_existing(path))}


def find_records(path: Path, key: str, wanted: Collection[str]) -> dict[str, Record]:
    """Return the records of a JSON table whose field ``key`` is in ``wanted``, by token."""
    pattern = re.compile(rb'"%s"\s*:\s*"([^"]*)"' % key.encode())
    names = frozenset(name.encode() for name in wanted)
    records = []
    try:
        with (
            open_file(_existing(path)) as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            # The records are searched as text, because tables have millions of records.
            begin = data[:4096].removeprefix(codecs.BOM_UTF8).lstrip()
            if begin[:1] != b"[" or data[-4096:].rstrip()[-1:] != b"]":
                raise ValueError("it does not begin with [ or end with ]")
            for match in _RECORD.finditer(data):
                token = pattern.search(match[0])
                if token and token[1] in names:
                    records.append(parse_json(match[0], path))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not a whole JSON table: {reason(error)}; fetch it again"
        ) from error
    with described_in(path, _EXPECTED):
        return {str(record["token"]): record for record in records}


def _existing(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"{path}: no such table; fetch the data set's metadata")
    return path


class KeyBox(NamedTuple):
    """The annotated box of one object in one key frame."""

    T_world_box: Float  # (4,4) pose of the box in the world: origin in its middle, x front, z up
    size_m: Float  # (3,) length, width, height


@dataclass(frozen=True)
class Annotations:
    """The boxes of a scene's n key frames (2 Hz). Between key frames, boxes are interpolated."""

    where: str  # path of the table, for messages
    key_ns: Int  # (n,) ascending times of the key frames
    boxes: tuple[Mapping[str, KeyBox], ...]  # boxes of each key frame, by the token of the object

    @staticmethod
    def read(tables: Path, scene: str) -> Annotations | None:
        """Read the boxes of the scene with this token, or return None without any box of it."""
        path = tables / "sample_annotation.json"
        if not path.is_file():
            return None
        samples = find_records(tables / "sample.json", "scene_token", {scene})
        with described_in(path, _EXPECTED):
            order = sorted(samples, key=lambda token: stamp_ns(samples[token]))
            boxes: dict[str, dict[str, KeyBox]] = {token: {} for token in order}
            for token, record in find_records(path, "sample_token", samples).items():
                sample, instance = record["sample_token"], record["instance_token"]
                if instance in boxes[sample]:
                    raise InputError(
                        f"{path}: record {token}: a second box of the instance {instance} in the "
                        f"sample {sample}, expected one"
                    )
                size_m = np.array(record["size"], np.float64)[_LENGTH_WIDTH_HEIGHT]
                boxes[sample][instance] = KeyBox(_pose_of(record, path), size_m)
        key_ns = np.array([stamp_ns(samples[token]) for token in order], np.int64)
        return Annotations(str(path), key_ns, (*boxes.values(),)) if any(boxes.values()) else None

    def at(self, stamp_ns: int, T_lidar_world: Float) -> Boxes | None:
        """Return the boxes at a time, interpolated, lidar frame, or None outside the key frames."""
        if not self.key_ns[0] <= stamp_ns <= self.key_ns[-1]:
            return None
        after = int(np.searchsorted(self.key_ns, stamp_ns))
        before = after if self.key_ns[after] == stamp_ns else after - 1
        earlier, later = self.boxes[before], self.boxes[after]
        names = [*{**earlier, **later}]
        key_boxes = [self._box(name, before, after, stamp_ns) for name in names]
        return checks.boxes(
            [name if name in earlier and name in later else "" for name in names],
            T_lidar_world @ np.reshape([box.T_world_box for box in key_boxes], (-1, 4, 4)),
            np.reshape([box.size_m for box in key_boxes], (-1, 3)),
            f"{self.where}: at {stamp_ns} ns",
        )

    def _box(self, instance: str, before: int, after: int, stamp_ns: int) -> KeyBox:
        """Return an object's box at a time, from its boxes in key frames at or near this time."""
        # At constant velocity and turn rate, as in the devkit. An object in only one of the two is
        # extrapolated from its nearest motion; it gets no track name, as its position is unknown.
        for row in (before, after, before - 1):
            pair = [boxes.get(instance) for boxes in self.boxes[max(row, 0) : row + 2]]
            if row >= 0 and len(pair) == 2 and pair[0] and pair[1]:
                span_ns = self.key_ns[row + 1] - self.key_ns[row]
                fraction = float((stamp_ns - self.key_ns[row]) / span_ns)
                T = interpolate(pair[0].T_world_box, pair[1].T_world_box, fraction)
                return KeyBox(T, (pair[1] if fraction > 0.5 else pair[0]).size_m)
        return {**self.boxes[before], **self.boxes[after]}[instance]


def open_recording(path: Path, scene: str | None) -> NuScenes:
    """Return the scene ``scene`` of the folder of the JSON tables, or of this folder's parent."""
    folders = [path] if (path / "sample_data.json").is_file() else []
    folders = folders or sorted(file.parent for file in path.glob("v*/sample_data.json"))
    if not folders:
        raise InputError(
            f"{path}: no nuScenes tables; expected a folder such as v1.0-mini with scene.json and "
            f"sample_data.json in it"
        )
    scenes: dict[str, tuple[Path, str]] = {}
    for folder in folders:
        for token, record in read_table(folder / "scene.json").items():
            scenes.setdefault(str(record.get("name")), (folder, token))
    name = checks.chosen_scene("nuscenes", path, scene, list(scenes), "no scene in scene.json")
    return NuScenes(*scenes[name], name)


class Datum(NamedTuple):
    """A sweep or image of a scene."""

    stamp_ns: int
    path: Path  # path of its file, which may be missing on the disk
    T_ego_sensor: Float  # (4,4) pose of the sensor in the vehicle's frame
    size_px: tuple[int, int]  # width and height of an image; zeros for a sweep
    intrinsics: Any  # camera matrix (3 x 3) as parsed from JSON


def _read_path(tables: Path, token: str, name: str) -> tuple[list[Record], PoseTrack]:
    """Return a scene's sample data in the order of time, and the vehicle's path T_world_ego."""
    file, poses_file = tables / "sample_data.json", tables / "ego_pose.json"
    samples = find_records(tables / "sample.json", "scene_token", {token})
    records = sorted(find_records(file, "sample_token", samples).values(), key=stamp_ns)
    wanted = {record["ego_pose_token"] for record in records}
    poses = find_records(poses_file, "token", wanted)
    if not records or len(poses) < len(wanted):
        raise InputError(
            f"{poses_file}: got {len(poses)} poses for {name}, expected the {len(wanted)} of its "
            f"{len(records)} records in sample_data.json"
        )
    T_world_ego = {stamp_ns(pose): _pose_of(pose, poses_file) for pose in poses.values()}
    stamps_ns = sorted(T_world_ego)
    T = np.stack([T_world_ego[ns] for ns in stamps_ns])
    return records, PoseTrack(str(poses_file), np.array(stamps_ns, np.int64), T)


def _channels(tables: Path, records: Sequence[Record]) -> dict[str, dict[str, dict[int, Datum]]]:
    """Return sweeps and images by modality, channel and number from records in order of time."""
    path, table = tables / "calibrated_sensor.json", tables / "sample_data.json"
    calibrated, sensors = read_table(path), read_table(tables / "sensor.json")
    tokens = {record["calibrated_sensor_token"] for record in records}
    T = {token: _pose_of(calibrated[token], path) for token in tokens}
    channels: Any = defaultdict(lambda: defaultdict(dict))
    for record in records:
        token = record["calibrated_sensor_token"]
        sensor = sensors[calibrated[token]["sensor_token"]]
        channel = channels[sensor["modality"]][sensor["channel"]]
        channel[len(channel)] = Datum(
            stamp_ns(record),
            checks.file_within(tables.parent, record["filename"], table),
            T_ego_sensor=T[token],
            size_px=(int(record.get("width") or 0), int(record.get("height") or 0)),
            intrinsics=calibrated[token].get("camera_intrinsic"),
        )
    return channels


class NuScenes(FileSequence):
    """A nuScenes scene as a `LidarSequence` in the frame of the scanner itself."""

    def __init__(self, tables: Path, token: str, name: str) -> None:
        self._tables, self._token, root = tables, token, tables.parent
        with described_in(tables / "sample_data.json", _EXPECTED):
            records, self._ego = _read_path(tables, token, name)
            channels = _channels(tables, records)
        lidars, images = channels["lidar"], channels["camera"]
        names = sorted(images, key=lambda name: (name != _FIRST_CAMERA, name))
        self._images = {name: images[name] for name in names}
        if len(lidars) != 1:
            lidar_names = ", ".join(lidars) or "none"
            raise InputError(f"{root}: got the lidars {lidar_names} of {name}, expected one")
        (lidar,) = lidars.values()
        self._T_ego_lidar = lidar[0].T_ego_sensor
        self._stamps_ns = {number: sweep.stamp_ns for number, sweep in lidar.items()}
        T_world_lidar = self._ego.T_world_ego @ self._T_ego_lidar
        self._track = replace(self._ego, T_world_ego=T_world_lidar)
        sweeps = _on_disk(lidar)
        if not sweeps:
            raise InputError(
                f"{root}: none of the {len(lidar)} sweeps of {name} are there; expected files such "
                f"as {lidar[0].path}"
            )
        files = {camera: _on_disk(data) for camera, data in self._images.items()}
        super().__init__(
            name,
            root,
            list(sweeps),
            cameras={c: self._camera(c, data[0]) for c, data in self._images.items()},
            exposed_ns={
                camera: {number: images[camera][number].stamp_ns for number in numbers}
                for camera, numbers in files.items()
            },
            truth=checks.truth_beside(root),
            files=sweeps,
            images=files,
        )

    def _camera(self, name: str, image: Datum) -> Camera:
        where = f"{self._tables / 'calibrated_sensor.json'}: {name}"
        with described_in(where, "camera_intrinsic of 3 x 3 numbers"):
            K = np.array(image.intrinsics, np.float64).reshape(3, 3)
        T_cam_lidar = inverse(image.T_ego_sensor) @ self._T_ego_lidar
        fx_fy_cx_cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return checks.pinhole(name, image.size_px, fx_fy_cx_cy, T_cam_lidar, where)

    def _pose(self, frame: int) -> Float:
        return self._track.at(self._stamps_ns[frame])

    def boxes(self, frame: int) -> Boxes | None:
        """Return a sweep's boxes, lidar frame, or None without annotations at its time."""
        self.check_frame(frame)
        if self._annotations is None:
            return None
        return self._annotations.at(self._stamps_ns[frame], inverse(self._pose(frame)))

    @cached_property
    def _annotations(self) -> Annotations | None:
        return Annotations.read(self._tables, self._token)

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the (4,4) pose T_world_cam at the exposure of image ``number`` of a camera."""
        T_world_ego = self._ego.at(self.image_stamps_ns(camera)[number])
        return T_world_ego @ self._images[camera][number].T_ego_sensor

    def _returns(self, frame: int) -> Returns:
        data = read_bytes(self._files[frame])
        rows = np.frombuffer(data, "<f4").reshape(-1, 5).astype(np.float64)  # x y z intensity ring
        # A new firing begins where the ring number falls.
        column: Int = np.cumsum(np.diff(rows[:, 4], prepend=0.0) < 0, dtype=np.int64)
        offset_ns: Int = (column - column[-1:]) * _COLUMN_NS
        points = self._track.undo_compensation(rows[:, :3], self._stamps_ns[frame], offset_ns)
        points[np.linalg.norm(points, axis=1) < _NO_RETURN_M] = 0.0
        return Returns(points, (rows[:, 3] / 255).astype(np.float32), offset_ns)


def _on_disk(data: Mapping[int, Datum]) -> dict[int, Path]:
    """Return the existing files by number."""
    return {number: datum.path for number, datum in data.items() if isfile(datum.path)}
