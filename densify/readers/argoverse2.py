# SPDX-License-Identifier: MIT
"""Argoverse 2 sensor and lidar logs (Wilson et al., "Argoverse 2: Next Generation Datasets for
Self-Driving Perception and Forecasting", NeurIPS Datasets 2021), as downloaded::

    LOG/sensors/lidar/315966265259836000.feather             x y z intensity laser_number offset_ns
    LOG/sensors/cameras/ring_front_center/3159662652….jpg    optional
    LOG/city_SE3_egovehicle.feather                          poses of the vehicle, about 200 Hz
    LOG/calibration/egovehicle_SE3_sensor.feather, intrinsics.feather
    LOG/annotations.feather                                  optional: tracked boxes

Points are in the vehicle's frame (x forward, y left, z up; its origin on the rear axle), all
carried by the vehicle's own motion to the file's stamp, which is the *start* of the sweep;
``offset_ns`` says when each was fired. That is undone here with the poses (on a real log the rings'
elevations then spread by 0.003 degrees instead of 0.06), so that the pipeline sees each point
where and when it was measured. Coordinates are float16: 3 cm apart beyond 32 m.

Two scanners, the lower one upside down and their axes a few hundredths of a degree apart, turn half
a revolution apart: lasers 0 to 31 are ``up_lidar``, 32 to 63 ``down_lidar``
(https://github.com/argoverse/av2-api/issues/77; the rings say the same). Images are undistorted
already, so that k1 to k3 of the intrinsics do not apply; their stamps are taken for those of the
exposure. The world is the city's frame. Frames and images are numbered from 0 in the order of time.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Camera, Float
from densify.readers.arrow_columns import read_feather
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    checked_boxes,
    chosen_scene,
    numbered_files,
    quaternion_pose,
    scanner_axes,
    truth_beside,
)
from densify.readers.recorded_poses import PoseTrack

POSES = "city_SE3_egovehicle.feather"
ANNOTATIONS = "annotations.feather"
BOX_SIZE = ("length_m", "width_m", "height_m")
SCANNERS = ("up_lidar", "down_lidar")
LASERS_PER_SCANNER = 32
_WHAT = "Argoverse 2 recordings"
_POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SPLITS = ("train", "val", "test")


def open_recording(path: Path, scene: str | None) -> Argoverse2:
    """See `densify.readers.ReaderModule`. path: a log, or a split or the whole data set with the
    log's name as the scene."""
    if scene is None and (path / POSES).is_file():
        return Argoverse2(path)
    logs = {log.name: log for log in _logs(path)}
    if not logs:
        raise InputError(
            f"{path}: no Argoverse 2 log; expected {POSES} and sensors/lidar in it, or in folders "
            f"within it"
        )
    return Argoverse2(logs[chosen_scene("argoverse2", path, scene, sorted(logs))])


def _logs(path: Path) -> list[Path]:
    places = [path, *(path / split for split in _SPLITS)]
    return [found.parent for place in places for found in place.glob(f"*/{POSES}")]


class Argoverse2(FileSequence):
    """A log as a `LidarSequence`; the lidar frame is the vehicle's."""

    def __init__(self, log: Path) -> None:
        """Reads poses and calibration. Raises InputError if there are no sweeps, or a table is
        missing or malformed."""
        sweeps = numbered_files(log / "sensors" / "lidar", ".feather")
        if not sweeps:
            raise InputError(
                f"{log / 'sensors' / 'lidar'}: no sweeps; expected files such as "
                f"315966265259836000.feather"
            )
        self._stamps_ns = list(sweeps)
        self._paths = list(sweeps.values())
        self._track = _track(log / POSES)
        self._T_ego_sensor = _sensor_poses(log / "calibration" / "egovehicle_SE3_sensor.feather")
        missing = [name for name in SCANNERS if name not in self._T_ego_sensor]
        if missing:
            raise InputError(
                f"{log / 'calibration' / 'egovehicle_SE3_sensor.feather'}: no sensor "
                f"{' and '.join(missing)}; got {', '.join(self._T_ego_sensor)}"
            )
        T_ego_scanner = np.stack([self._T_ego_sensor[name] for name in SCANNERS])
        self._origins, self._axes = T_ego_scanner[:, :3, 3], scanner_axes(T_ego_scanner)
        cameras = _cameras(log, self._T_ego_sensor)
        images = {
            name: numbered_files(log / "sensors" / "cameras" / name, ".jpg", ".png")
            for name in cameras
        }
        self._images = {name: list(files.values()) for name, files in images.items()}
        super().__init__(
            log.resolve().name,
            log,
            range(len(sweeps)),
            cameras,
            {name: dict(enumerate(files)) for name, files in images.items()},
            truth_beside(log),
            dict(enumerate(self._paths)),
        )

    def stamp_ns(self, frame: int) -> int:
        """The start of the sweep."""
        self.check_frame(frame)
        return self._stamps_ns[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path = self._paths[frame]
        kinds = {"x": "m", "y": "m", "z": "m", "intensity": "n", "laser_number": "i"}
        columns = read_feather(path, {**kinds, "offset_ns": "i"}, _WHAT)
        laser = columns["laser_number"]
        if len(laser) and not 0 <= laser.min() <= laser.max() < len(SCANNERS) * LASERS_PER_SCANNER:
            raise InputError(
                f"{path}: laser_number: got {laser.min()} to {laser.max()}, expected 0 to "
                f"{len(SCANNERS) * LASERS_PER_SCANNER - 1}"
            )
        offset_ns = columns["offset_ns"].astype(np.int64)
        points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        points = self._track.as_fired(points, self._stamps_ns[frame], offset_ns)
        return path, Returns(
            points,
            (columns["intensity"] / 255.0).astype(np.float32),
            offset_ns,
            (laser // LASERS_PER_SCANNER).astype(np.uint8),
            self._origins,
            self._axes,
        )

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._images[camera][number]
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        return self._track.at(self._stamps_ns[frame])

    def boxes(self, frame: int) -> Boxes | None:
        """See `KnowsBoxes`; the test split has none. Raises InputError for a table
        that is malformed."""
        table = self._annotations
        if table is None:
            return None
        path, columns = self.where / ANNOTATIONS, table
        rows = np.flatnonzero(columns["timestamp_ns"] == self.stamp_ns(frame))
        if not len(rows):
            return None  # nothing there and not looked at are told in the same way
        size_m = np.stack([columns[name][rows] for name in BOX_SIZE], axis=1)
        T = [
            quaternion_pose(
                np.array([columns[name][row] for name in _POSE_COLUMNS[:4]]),
                np.array([columns[name][row] for name in _POSE_COLUMNS[4:]]),
                f"{path}: row {row}",
            )
            for row in rows
        ]
        return checked_boxes(columns["track_uuid"][rows], T, size_m, f"{path}: sweep {frame}")

    @cached_property
    def _annotations(self) -> dict[str, NDArray[Any]] | None:
        path = self.where / ANNOTATIONS
        if not path.is_file():
            return None
        numbers = dict.fromkeys((*BOX_SIZE, *_POSE_COLUMNS), "n")
        return read_feather(path, {"timestamp_ns": "i", "track_uuid": "s", **numbers}, _WHAT)

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) at the exposure, from the vehicle's poses."""
        exposed_ns = self.image_stamps_ns(camera)[number]
        return self._track.at(exposed_ns) @ self._T_ego_sensor[camera]


def _track(path: Path) -> PoseTrack:
    columns = read_feather(path, {"timestamp_ns": "i", **dict.fromkeys(_POSE_COLUMNS, "n")}, _WHAT)
    stamp_ns, rows = np.unique(columns["timestamp_ns"].astype(np.int64), return_index=True)
    poses = np.stack([columns[name] for name in _POSE_COLUMNS], axis=1)[rows]
    T = [
        quaternion_pose(pose[:4], pose[4:], f"{path}: pose at {ns} ns")
        for ns, pose in zip(stamp_ns, poses, strict=True)
    ]
    return PoseTrack(str(path), stamp_ns, np.stack(T) if T else np.zeros((0, 4, 4)))


def _sensor_poses(path: Path) -> dict[str, Float]:
    """T_ego_sensor by the sensor's name."""
    columns = read_feather(path, {"sensor_name": "s", **dict.fromkeys(_POSE_COLUMNS, "n")}, _WHAT)
    poses = np.stack([columns[name] for name in _POSE_COLUMNS], axis=1)
    return {
        name: quaternion_pose(pose[:4], pose[4:], f"{path}: {name}")
        for name, pose in zip(columns["sensor_name"], poses, strict=True)
    }


def _cameras(log: Path, T_ego_sensor: dict[str, Float]) -> dict[str, Camera]:
    """The cameras that have a folder of images."""
    names = [p.name for p in sorted((log / "sensors" / "cameras").glob("*")) if p.is_dir()]
    if not names:
        return {}
    path = log / "calibration" / "intrinsics.feather"
    numbers = dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), "n")
    sizes = {"width_px": "i", "height_px": "i"}
    columns = read_feather(path, {"sensor_name": "s", **numbers, **sizes}, _WHAT)
    cameras = {}
    for name in names:
        row = np.flatnonzero(columns["sensor_name"] == name)
        if len(row) != 1 or name not in T_ego_sensor:
            raise InputError(
                f"{path}: camera {name} has images, but {len(row)} rows here and "
                f"{'a' if name in T_ego_sensor else 'no'} pose in egovehicle_SE3_sensor.feather; "
                f"expected one of each"
            )
        fx, fy, cx, cy, width, height = (columns[c][row[0]] for c in (*numbers, *sizes))
        if min(fx, fy, width, height) <= 0:
            raise InputError(
                f"{path}: {name}: got focal lengths {fx:g}, {fy:g} and {width} x {height} px, "
                f"expected positive ones"
            )
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        cameras[name] = Camera(name, int(width), int(height), K, inverse(T_ego_sensor[name]))
    return cameras
