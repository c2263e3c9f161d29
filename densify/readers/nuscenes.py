# SPDX-License-Identifier: MIT
"""nuScenes (Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020),
without its devkit::

    ROOT/v1.0-trainval/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor}.json
    ROOT/samples/LIDAR_TOP/*.pcd.bin, ROOT/sweeps/LIDAR_TOP/*.pcd.bin    key frames, and the others
    ROOT/samples/CAM_FRONT/*.jpg ...

A scene is named by ``#scene-0061``. Its sweeps, key frames or not, are numbered from 0 in the order
of time, images likewise by camera; what is not on the disk leaves a gap. ``prev`` and ``next`` are
not used. Images are undistorted; their stamps are those of the exposure. Poses are the vehicle's in
the map's frame; every record has its own, and all of a scene together tell where the vehicle was at
any time.

nuScenes: one HDL-32E at 20 Hz. Points are in the scanner's frame (x right, y forward, z up), all
carried by the vehicle's own motion to the stamp, which is that of the *last* packet. There are no
times per point; rows are columns of 32 rings in the order in which they fired, 46.08 µs apart
(HDL-32E manual, 2018, section 9.3), so that column c of n fired (c + 1 - n) · 46.08 µs after the
stamp. The compensation is undone with that (on a real sweep at 9 m/s the rings' elevations then
spread by 0.0016 degrees instead of 0.073). Rows without a return lie at the scanner's origin then
and are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.errors import InputError
from densify.geometry.poses import inverse
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    quaternion_pose,
    truth_beside,
)
from densify.readers.files import read_bytes
from densify.readers.json_tables import Record, find_records, read_table
from densify.readers.pose_track import PoseTrack
from densify.types import Camera, Float, Int

NUM_RINGS = 32
COLUMN_NS = 46_080
"""From column to column of an HDL-32E."""

_NO_RETURN_M = 0.05
_LIDARS, _CAMERAS = "lidar", "camera"


def open_recording(path: Path, scene: str | None) -> NuScenes:
    """See `densify.readers.ReaderModule`. path: the folder that holds the tables, or the one above
    it, which may hold several versions."""
    folders = _versions(path)
    if not folders:
        raise InputError(
            f"{path}: no nuScenes tables; expected a folder such as v1.0-mini with scene.json and "
            f"sample_data.json in it"
        )
    scenes: dict[str, tuple[Path, str]] = {}
    for folder in folders:
        for token, record in read_table(folder / "scene.json").items():
            scenes.setdefault(record.text("name"), (folder, token))
    name = chosen_scene("nuscenes", path, scene, list(scenes))
    return NuScenes(*scenes[name], name)


def _versions(path: Path) -> list[Path]:
    if (path / "sample_data.json").is_file():
        return [path]
    return sorted(found.parent for found in path.glob("v*/sample_data.json"))


@dataclass(frozen=True)
class _Channel:
    """One sensor of a scene. records: its sample_data in the order of time. stamps_ns: of them.
    T_ego_sensor: (4,4) for each. calibration: of the first."""

    records: Sequence[Record]
    stamps_ns: Sequence[int]
    T_ego_sensor: Sequence[Float]
    calibration: Record

    def on_disk(self, root: Path) -> list[int]:
        """Numbers of the records whose file is there."""
        return [
            i for i, record in enumerate(self.records) if (root / record.text("filename")).is_file()
        ]


class NuScenes(FileSequence):
    """A scene as a `densify.types.LidarSequence`."""

    def __init__(self, tables: Path, token: str, name: str) -> None:
        """tables: the folder that holds them. token: of the scene. Raises InputError if a table is
        missing or malformed, or the scene has no sweeps."""
        self._root = tables.parent
        by_modality, self._track = _read_scene(tables, token, name)
        lidars = by_modality[_LIDARS]
        if not lidars:
            raise InputError(f"{tables / 'sample_data.json'}: no lidar data of {name}")
        if len(lidars) > 1:
            raise InputError(
                f"{tables}: {name} has the lidars {', '.join(lidars)}; only nuScenes with its "
                f"LIDAR_TOP is read"
            )
        self._lidar = next(iter(lidars.values()))
        self._channels = by_modality[_CAMERAS]
        self._T_ego_lidar = self._lidar.T_ego_sensor[0]
        track = self._track
        self._scanner_track = PoseTrack(
            track.where, track.stamp_ns, track.T_world_ego @ self._T_ego_lidar
        )
        frames = self._lidar.on_disk(self._root)
        if not frames:
            raise InputError(
                f"{self._root}: none of the {len(self._lidar.records)} sweeps of {name} are there; "
                f"expected files such as {self._lidar.records[0].text('filename')}"
            )
        super().__init__(
            name,
            self._root,
            frames,
            {channel: self._camera(channel, data) for channel, data in self._channels.items()},
            {
                channel: {i: data.stamps_ns[i] for i in data.on_disk(self._root)}
                for channel, data in self._channels.items()
            },
            truth_beside(self._root),
        )

    def stamp_ns(self, frame: int) -> int:
        """When the last packet arrived."""
        self.check_frame(frame)
        return self._lidar.stamps_ns[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path = self._root / self._lidar.records[frame].text("filename")
        data = read_bytes(path)
        if len(data) % 20:
            raise InputError(
                f"{path}: truncated: got {len(data)} bytes, expected a multiple of 20 (x y z "
                f"intensity ring as float32); fetch the file again"
            )
        rows = np.frombuffer(data, "<f4").reshape(-1, 5).astype(np.float64)
        ring = rows[:, 4]
        if len(ring) and not ((ring >= 0) & (ring < NUM_RINGS) & (ring % 1 == 0)).all():
            raise InputError(
                f"{path}: got rings from {ring.min():g} to {ring.max():g}, expected whole numbers "
                f"from 0 to {NUM_RINGS - 1} in the fifth column"
            )
        column: Int = np.cumsum(np.diff(ring, prepend=0.0) < 0, dtype=np.int64)
        offset_ns: Int = (column - column[-1:]) * COLUMN_NS
        points = self._scanner_track.as_fired(rows[:, :3], self._lidar.stamps_ns[frame], offset_ns)
        points[np.linalg.norm(points, axis=1) < _NO_RETURN_M] = 0.0
        return path, Returns(points, (rows[:, 3] / 255).astype(np.float32), offset_ns)

    def _camera(self, channel: str, data: _Channel) -> Camera:
        K = data.calibration.numbers("camera_intrinsic", 3, 3)
        width, height = (data.records[0].whole(side) for side in ("width", "height"))
        if min(K[0, 0], K[1, 1], width, height) <= 0:
            raise InputError(
                f"{data.calibration.where}: got focal lengths {K[0, 0]:g}, {K[1, 1]:g} and "
                f"{width} x {height} px, expected positive ones"
            )
        T_cam_lidar = inverse(data.T_ego_sensor[0]) @ self._T_ego_lidar
        return Camera(channel, width, height, K, T_cam_lidar)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._root / self._channels[camera].records[number].text("filename")
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        return self._scanner_track.at(self._lidar.stamps_ns[frame])

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) of the image's own pose of the vehicle."""
        exposed_ns = self.image_stamps_ns(camera)[number]
        return self._track.at(exposed_ns) @ self._channels[camera].T_ego_sensor[number]


def _read_scene(
    tables: Path, token: str, name: str
) -> tuple[dict[str, dict[str, _Channel]], PoseTrack]:
    """Lidars and cameras of a scene by modality and channel, sorted by name, and the vehicle's
    path."""
    samples = find_records(tables / "sample.json", "scene_token", {token})
    data = find_records(tables / "sample_data.json", "sample_token", set(samples))
    poses_file = tables / "ego_pose.json"
    wanted = {record.text("ego_pose_token") for record in data.values()}
    poses = find_records(poses_file, "token", wanted)
    if not data or len(poses) < len(wanted):
        raise InputError(
            f"{poses_file}: got {len(poses)} poses for {name}, expected the {len(wanted)} of its "
            f"{len(data)} records in sample_data.json"
        )
    calibrated = read_table(tables / "calibrated_sensor.json")
    sensors = read_table(tables / "sensor.json")
    grouped: dict[str, dict[str, list[Record]]] = {_LIDARS: {}, _CAMERAS: {}}
    for record in sorted(data.values(), key=lambda r: r.whole("timestamp")):
        calibration = _linked(record, "calibrated_sensor_token", calibrated)
        sensor = _linked(calibration, "sensor_token", sensors)
        if sensor.text("modality") in grouped:
            channel = sensor.text("channel")
            grouped[sensor.text("modality")].setdefault(channel, []).append(record)
    channels = {
        modality: {name: _channel(found[name], calibrated) for name in sorted(found)}
        for modality, found in grouped.items()
    }
    return channels, _track(poses_file, list(poses.values()))


def _channel(records: list[Record], calibrated: Mapping[str, Record]) -> _Channel:
    links = [_linked(record, "calibrated_sensor_token", calibrated) for record in records]
    poses = {id(link): _pose(link) for link in links}
    return _Channel(
        records,
        [record.whole("timestamp") * 1000 for record in records],
        [poses[id(link)] for link in links],
        links[0],
    )


def _track(path: Path, records: Sequence[Record]) -> PoseTrack:
    by_stamp = {record.whole("timestamp") * 1000: record for record in records}
    stamps_ns = sorted(by_stamp)
    T_world_ego = np.stack([_pose(by_stamp[ns]) for ns in stamps_ns])
    return PoseTrack(str(path), np.array(stamps_ns, np.int64), T_world_ego)


def _pose(record: Record) -> Float:
    rotation, translation = record.numbers("rotation", 4), record.numbers("translation", 3)
    return quaternion_pose(rotation, translation, record.where)


def _linked(record: Record, key: str, table: Mapping[str, Record]) -> Record:
    token = record.text(key)
    if token not in table:
        raise InputError(f"{record.where}: {key}: got {token}, which its table does not have")
    return table[token]
