# SPDX-License-Identifier: MIT
"""A scene of nuScenes or TruckScenes: what its tables tell of sensors, cameras and poses. See
`densify.readers.nuscenes.reader`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os.path import isfile
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Camera, Float
from densify.readers.file_sequence import FileSequence, quaternion_pose, truth_beside
from densify.readers.nuscenes.annotations import Annotations
from densify.readers.nuscenes.tables import Record, find_records, read_table
from densify.readers.recorded_poses import PoseTrack

_LIDARS, _CAMERAS = "lidar", "camera"


@dataclass(frozen=True)
class Channel:
    """One sensor of a scene. records: its sample_data in the order of time. stamps_ns: of them.
    T_ego_sensor: (4,4) for each. calibration: of the first."""

    records: Sequence[Record]
    stamps_ns: Sequence[int]
    T_ego_sensor: Sequence[Float]
    calibration: Record

    def on_disk(self, root: Path) -> list[int]:
        """Numbers of the records whose file is there."""
        files = [root / record.text("filename") for record in self.records]
        return [i for i, file in enumerate(files) if isfile(file)]  # no name is too long for it


@dataclass(frozen=True)
class Scene:
    """What the tables tell. tables: their folder. token: of the scene. lidars, cameras: by channel,
    sorted. track: of the vehicle."""

    name: str
    tables: Path
    token: str
    lidars: Mapping[str, Channel]
    cameras: Mapping[str, Channel]
    track: PoseTrack

    @staticmethod
    def read(tables: Path, token: str, name: str) -> Scene:
        """tables: the folder that holds them. token: of the scene. Raises InputError if a table is
        missing or malformed, or the scene has no sweeps."""
        channels, track = _read_scene(tables, token, name)
        if not channels[_LIDARS]:
            raise InputError(f"{tables / 'sample_data.json'}: no lidar data of {name}")
        return Scene(name, tables, token, channels[_LIDARS], channels[_CAMERAS], track)

    @property
    def root(self) -> Path:
        """The folder that file names start from."""
        return self.tables.parent


class SceneSequence(FileSequence):
    """A scene but for how its sweeps are stored."""

    def __init__(self, scene: Scene, T_ego_frame: Float) -> None:
        """T_ego_frame: (4,4) the frame of the points. The sweeps are those of the first lidar.
        Raises InputError if none is on the disk, or a camera is malformed."""
        self._scene, self._T_ego_frame = scene, T_ego_frame
        self._lidar = next(iter(scene.lidars.values()))
        frames = self._lidar.on_disk(scene.root)
        if not frames:
            raise InputError(
                f"{scene.root}: none of the {len(self._lidar.records)} sweeps of {scene.name} are "
                f"there; expected files such as {self._lidar.records[0].text('filename')}"
            )
        cameras = scene.cameras.items()
        super().__init__(
            scene.name,
            scene.root,
            frames,
            {name: self._camera(name, data) for name, data in cameras},
            {
                name: {i: data.stamps_ns[i] for i in data.on_disk(scene.root)}
                for name, data in cameras
            },
            truth_beside(scene.root),
        )

    def stamp_ns(self, frame: int) -> int:
        """As the table says."""
        self.check_frame(frame)
        return self._lidar.stamps_ns[frame]

    def _file(self, record: Record) -> Path:
        return self._scene.root / record.text("filename")

    def _camera(self, channel: str, data: Channel) -> Camera:
        K = data.calibration.numbers("camera_intrinsic", 3, 3)
        width, height = (data.records[0].whole(side) for side in ("width", "height"))
        if min(K[0, 0], K[1, 1], width, height) <= 0:
            raise InputError(
                f"{data.calibration.where}: got focal lengths {K[0, 0]:g}, {K[1, 1]:g} and "
                f"{width} x {height} px, expected positive ones"
            )
        T_cam_frame = inverse(data.T_ego_sensor[0]) @ self._T_ego_frame
        return Camera(channel, width, height, K, T_cam_frame)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._file(self._scene.cameras[camera].records[number])
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        return self._scene.track.at(self._lidar.stamps_ns[frame]) @ self._T_ego_frame

    def boxes(self, frame: int) -> Boxes | None:
        """See `KnowsBoxes`; the test split has none. Raises InputError for a table
        that is malformed."""
        self.check_frame(frame)
        if self._annotations is None:
            return None
        return self._annotations.at(self._lidar.stamps_ns[frame], inverse(self._pose(frame)))

    @cached_property
    def _annotations(self) -> Annotations | None:
        return Annotations.read(self._scene.tables, self._scene.token)

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) of the image's own pose of the vehicle."""
        exposed_ns = self.image_stamps_ns(camera)[number]
        T_ego_cam = self._scene.cameras[camera].T_ego_sensor[number]
        return self._scene.track.at(exposed_ns) @ T_ego_cam


def _read_scene(
    tables: Path, token: str, name: str
) -> tuple[dict[str, dict[str, Channel]], PoseTrack]:
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
        modality: {name: _channel_of(found[name], calibrated) for name in sorted(found)}
        for modality, found in grouped.items()
    }
    return channels, _track(poses_file, list(poses.values()))


def _channel_of(records: list[Record], calibrated: Mapping[str, Record]) -> Channel:
    links = [_linked(record, "calibrated_sensor_token", calibrated) for record in records]
    poses = {id(link): _pose(link) for link in links}
    return Channel(
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
