# SPDX-License-Identifier: MIT
"""nuScenes (Caesar et al., CVPR 2020) and MAN TruckScenes (Fent et al., NeurIPS Datasets 2024),
which have the same tables, without their devkits::

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

TruckScenes: several lidars at 10 Hz, each sweep a ``.pcd`` file in its scanner's frame with x y z
intensity timestamp. The timestamp is the firing time of a point in microseconds, and points are not
compensated (https://github.com/TUMFTM/truckscenes-devkit, issues 9 and 11). A sweep is one of the
first lidar by name, with the nearest of the others, in the vehicle's frame (x forward, y left,
z up); its stamp is the first lidar's in the table. Some lidars are on the cabin, which sways on the
chassis; the calibration takes it as rigid. Built on the documentation; not tried on real files.
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
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Bool, Boxes, Camera, Float, Float32, Int
from densify.readers.extras import described_in
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    pinhole,
    scanner_axes,
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
from densify.readers.point_fields import full_scale, scaled
from densify.readers.point_files import read_table as read_points
from densify.readers.recorded_poses import PoseTrack

_NUM_RINGS = 32
_COLUMN_NS = 46_080  # from column to column of an HDL-32E
_NO_RETURN_M = 0.05
_FIELDS = ("x", "y", "z", "intensity", "timestamp")
_PERIOD_NS = 100_000_000
_MOST_LATE_NS = 500_000_000


def open_recording(path: Path, scene: str | None) -> SceneSequence:
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
    lidars = list(found.lidars.values())
    if lidars[0].files[0].suffix == ".pcd":
        return TruckScenes(found)
    if len(lidars) > 1:
        raise InputError(
            f"{path}: {name} has the lidars {', '.join(found.lidars)}, expected one in .pcd.bin "
            f"files, as nuScenes has, or several in .pcd files, as TruckScenes has"
        )
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


class SceneSequence(FileSequence):
    """A scene; derived classes read its sweeps, which are those of the first lidar."""

    def __init__(self, scene: Scene, T_ego_frame: Float) -> None:
        """T_ego_frame: (4,4) the frame of the points. Raises InputError if no sweep is on the disk,
        or a camera is malformed."""
        self._scene, self._T_ego_frame = scene, T_ego_frame
        self._lidar = next(iter(scene.lidars.values()))
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
        T_cam_frame = inverse(channel.T_ego_sensor[0]) @ self._T_ego_frame
        fx_fy_cx_cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        return pinhole(name, channel.size_px, fx_fy_cx_cy, T_cam_frame, where)

    def _pose(self, frame: int) -> Float:
        return self._scene.track.at(self._lidar.stamps_ns[frame]) @ self._T_ego_frame

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


class NuScenes(SceneSequence):
    """A scene of nuScenes as a `LidarSequence`; the lidar frame is the scanner's."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, next(iter(scene.lidars.values())).T_ego_sensor[0])
        track = scene.track
        self._track = PoseTrack(track.where, track.stamp_ns, track.T_world_ego @ self._T_ego_frame)

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


class TruckScenes(SceneSequence):
    """A scene of TruckScenes as a `LidarSequence`; the lidar frame is the vehicle's."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, np.eye(4))
        steps = np.diff(self._lidar.stamps_ns)
        self._period_ns = np.median(steps) if len(steps) else _PERIOD_NS

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        stamp_ns = self._lidar.stamps_ns[frame]
        parts, mounts = [], []
        for number, channel in enumerate(self._scene.lidars.values()):
            near = int(np.argmin(np.abs(np.array(channel.stamps_ns) - stamp_ns)))
            mounts.append(channel.T_ego_sensor[near])
            if abs(channel.stamps_ns[near] - stamp_ns) <= self._period_ns / 2:
                parts.append(_truck_sweep(channel, number, near, stamp_ns))
        points, intensity, offset_ns, lidar = (np.concatenate(c) for c in zip(*parts, strict=True))
        T = np.stack(mounts)
        returns = Returns(points, intensity, offset_ns, lidar, T[:, :3, 3], scanner_axes(T))
        return self._lidar.files[frame], returns


def _truck_sweep(
    channel: Channel, number: int, near: int, stamp_ns: int
) -> tuple[Float, Float32, Int, NDArray[np.uint8]]:
    """Return points, intensities, times and number of one scanner."""
    path = channel.files[near]
    columns = read_points(path).columns
    absent = [name for name in _FIELDS if name not in columns]
    if absent:
        raise InputError(f"{path}: no field {', '.join(absent)}; got {', '.join(columns)}")
    fired = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    valid: Bool = np.asarray(np.isfinite(fired).all(axis=1) & fired.any(axis=1))
    points = np.where(valid[:, None], transform(channel.T_ego_sensor[near], fired), np.nan)
    offset_ns = columns["timestamp"].astype(np.int64) * 1000 - stamp_ns
    late_ns = np.abs(offset_ns[valid]).max(initial=0)
    if late_ns > _MOST_LATE_NS:
        raise InputError(
            f"{path}: timestamp: got points {late_ns * 1e-9:g} s from the sweep's stamp, "
            f"expected microseconds within {_MOST_LATE_NS * 1e-9:g} s of it"
        )
    brightness = scaled(columns["intensity"], full_scale(columns["intensity"]))
    return points, brightness, offset_ns, np.full(len(points), number, np.uint8)
