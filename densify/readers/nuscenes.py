# SPDX-License-Identifier: MIT
"""nuScenes (Caesar et al., CVPR 2020), without its devkit::

    ROOT/v1.0-trainval/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor}.json
    ROOT/v1.0-trainval/sample_annotation.json    optional: tracked boxes
    ROOT/samples/LIDAR_TOP/*.pcd.bin, ROOT/sweeps/LIDAR_TOP/*.pcd.bin    key frames, and the others
    ROOT/samples/CAM_FRONT/*.jpg ...

A scene is named by ``#scene-0061``. Its sweeps, key frames or not, are numbered from 0 in the order
of time, and so are each camera's images. A file that is not there leaves a gap. Images are
undistorted, with the stamps of the exposure. Poses are the vehicle's in the map's frame, one for
each record; all poses of a scene give the vehicle's path.

nuScenes: one HDL-32E at 20 Hz. Points are in the scanner's frame (x right, y forward, z up),
compensated to the stamp, which is that of the *last* packet. There are no point times. Rows are
columns of 32 rings in the order of firing, 46.08 µs apart (HDL-32E manual, 2018, section 9.3), so
column c of n fired (c + 1 - n) · 46.08 µs after the stamp. The compensation is undone with that: on
a real sweep at 9 m/s the elevations of a ring then spread by 0.0016 degrees instead of 0.073. Rows
without a return then lie at the scanner's origin and are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers.extras import described_in
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    pinhole,
    truth_beside,
)
from densify.readers.nuscenes_tables import (
    EXPECTED,
    Annotations,
    Record,
    find_records,
    pose_of,
    read_table,
    stamp_ns,
)
from densify.readers.recorded_poses import PoseTrack

_NUM_RINGS = 32
_COLUMN_NS = 46_080  # from column to column of an HDL-32E
_NO_RETURN_M = 0.05


def open_recording(path: Path, scene: str | None) -> NuScenes:
    """See `densify.readers.ReaderModule`. path: the folder that holds the tables, or the one above
    it, which may hold several versions."""
    folders = [path] if (path / "sample_data.json").is_file() else []
    folders = folders or sorted(found.parent for found in path.glob("v*/sample_data.json"))
    if not folders:
        raise InputError(
            f"{path}: no nuScenes tables; expected a folder such as v1.0-mini with scene.json and "
            f"sample_data.json in it"
        )
    scenes: dict[str, tuple[Path, str]] = {}
    for folder in folders:
        for token, record in read_table(folder / "scene.json").items():
            scenes.setdefault(str(record.get("name")), (folder, token))
    name = chosen_scene("nuscenes", path, scene, list(scenes))
    found = Scene.read(*scenes[name], name)
    if len(found.lidars) > 1:
        raise InputError(f"{path}: {name} has the lidars {', '.join(found.lidars)}, expected one")
    return NuScenes(found)


@dataclass(frozen=True)
class Channel:
    """One sensor of a scene. stamps_ns: of its records, ascending; files: theirs. T_ego_sensor:
    (4,4) for each. size_px: of its images. intrinsics: of the first record."""

    stamps_ns: Sequence[int]
    files: Sequence[Path]
    T_ego_sensor: Sequence[Float]
    size_px: tuple[int, int]
    intrinsics: Any

    def on_disk(self) -> dict[int, Path]:
        """Return the files that are there, by number."""
        return {i: file for i, file in enumerate(self.files) if isfile(file)}


@dataclass(frozen=True)
class Scene:
    """tables: their folder. token: of the scene. lidars, cameras: by channel, sorted. track: of the
    vehicle."""

    name: str
    tables: Path
    token: str
    lidars: Mapping[str, Channel]
    cameras: Mapping[str, Channel]
    track: PoseTrack

    @staticmethod
    def read(tables: Path, token: str, name: str) -> Scene:
        """Raises InputError if a table is missing or malformed, or the scene has no sweeps."""
        file, poses_file = tables / "sample_data.json", tables / "ego_pose.json"
        with described_in(file, EXPECTED):
            samples = find_records(tables / "sample.json", "scene_token", {token})
            data = find_records(file, "sample_token", set(samples))
            records = sorted(data.values(), key=stamp_ns)
            wanted = {record["ego_pose_token"] for record in records}
            poses = find_records(poses_file, "token", wanted)
            if not data or len(poses) < len(wanted):
                raise InputError(
                    f"{poses_file}: got {len(poses)} poses for {name}, expected the {len(wanted)} "
                    f"of its {len(data)} records in sample_data.json"
                )
            lidars, cameras = (_channels(tables, records, kind) for kind in ("lidar", "camera"))
            T_world_ego = {
                stamp_ns(record): pose_of(record, f"{poses_file}: record {token}")
                for token, record in poses.items()
            }
        if not lidars:
            raise InputError(f"{file}: no lidar data of {name}")
        stamps_ns = sorted(T_world_ego)
        T = np.stack([T_world_ego[ns] for ns in stamps_ns])
        track = PoseTrack(str(poses_file), np.array(stamps_ns, np.int64), T)
        return Scene(name, tables, token, lidars, cameras, track)


def _channels(tables: Path, records: Sequence[Record], modality: str) -> dict[str, Channel]:
    """Return the sensors of one kind by name. records: of the sample data, in the order of time."""
    path = tables / "calibrated_sensor.json"
    calibrated, sensors = read_table(path), read_table(tables / "sensor.json")
    found: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        sensor = sensors[calibrated[record["calibrated_sensor_token"]]["sensor_token"]]
        if sensor["modality"] == modality:
            found[sensor["channel"]].append(record)
    channels = {}
    for name, of in sorted(found.items()):
        tokens = [record["calibrated_sensor_token"] for record in of]
        T = {t: pose_of(calibrated[t], f"{path}: record {t}") for t in dict.fromkeys(tokens)}
        channels[name] = Channel(
            [stamp_ns(record) for record in of],
            [tables.parent / record["filename"] for record in of],
            [T[token] for token in tokens],
            (int(of[0].get("width") or 0), int(of[0].get("height") or 0)),
            calibrated[tokens[0]].get("camera_intrinsic"),
        )
    return channels


class NuScenes(FileSequence):
    """A scene of nuScenes as a `LidarSequence`; the lidar frame is the scanner's."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError if no sweep is on the disk, or a camera is malformed."""
        self._scene, self._lidar = scene, next(iter(scene.lidars.values()))
        self._T_ego_lidar, track = self._lidar.T_ego_sensor[0], scene.track
        self._track = PoseTrack(track.where, track.stamp_ns, track.T_world_ego @ self._T_ego_lidar)
        root, there = scene.tables.parent, self._lidar.on_disk()
        if not there:
            raise InputError(
                f"{root}: none of the {len(self._lidar.files)} sweeps of {scene.name} are there; "
                f"expected files such as {self._lidar.files[0]}"
            )
        images = {name: channel.on_disk() for name, channel in scene.cameras.items()}
        super().__init__(
            scene.name,
            root,
            list(there),
            {name: self._camera(name, channel) for name, channel in scene.cameras.items()},
            {n: {i: scene.cameras[n].stamps_ns[i] for i in files} for n, files in images.items()},
            truth_beside(root),
            images=images,
        )

    def stamp_ns(self, frame: int) -> int:
        """Return the stamp in the table."""
        self.check_frame(frame)
        return self._lidar.stamps_ns[frame]

    def _camera(self, name: str, channel: Channel) -> Camera:
        where = f"{self._scene.tables / 'calibrated_sensor.json'}: {name}"
        with described_in(where, "camera_intrinsic of 3 x 3 numbers"):
            K = np.array(channel.intrinsics, np.float64).reshape(3, 3)
        T_cam_lidar = inverse(channel.T_ego_sensor[0]) @ self._T_ego_lidar
        fx_fy_cx_cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return pinhole(name, channel.size_px, fx_fy_cx_cy, T_cam_lidar, where)

    def _pose(self, frame: int) -> Float:
        return self._track.at(self._lidar.stamps_ns[frame])

    def boxes(self, frame: int) -> Boxes | None:
        """See `LidarSequence`; the test split has none. Raises InputError for a malformed table."""
        self.check_frame(frame)
        if self._annotations is None:
            return None
        return self._annotations.at(self._lidar.stamps_ns[frame], inverse(self._pose(frame)))

    @cached_property
    def _annotations(self) -> Annotations | None:
        return Annotations.read(self._scene.tables, self._scene.token)

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the (4,4) pose of an image."""
        T_world_ego = self._scene.track.at(self.image_stamps_ns(camera)[number])
        return T_world_ego @ self._scene.cameras[camera].T_ego_sensor[number]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path = self._lidar.files[frame]
        data = read_bytes(path)
        if len(data) % 20:
            raise InputError(
                f"{path}: truncated: got {len(data)} bytes, expected a multiple of 20 (x y z "
                f"intensity ring as float32); fetch the file again"
            )
        rows = np.frombuffer(data, "<f4").reshape(-1, 5).astype(np.float64)
        ring = rows[:, 4]
        if not np.isin(ring, np.arange(_NUM_RINGS)).all():
            raise InputError(
                f"{path}: got rings from {ring.min():g} to {ring.max():g}, expected whole numbers "
                f"from 0 to {_NUM_RINGS - 1} in the fifth column"
            )
        column: Int = np.cumsum(np.diff(ring, prepend=0.0) < 0, dtype=np.int64)
        offset_ns: Int = (column - column[-1:]) * _COLUMN_NS
        points = self._track.as_fired(rows[:, :3], self._lidar.stamps_ns[frame], offset_ns)
        points[np.linalg.norm(points, axis=1) < _NO_RETURN_M] = 0.0
        return path, Returns(points, (rows[:, 3] / 255).astype(np.float32), offset_ns)
