# SPDX-License-Identifier: MIT
"""Read Argoverse 2 sensor and lidar logs as downloaded (Wilson et al., NeurIPS Datasets 2021).

    LOG/sensors/lidar/315966265259836000.feather             x y z intensity laser_number offset_ns
    LOG/sensors/cameras/ring_front_center/3159662652….jpg    optional
    LOG/city_SE3_egovehicle.feather                          poses of the vehicle, about 200 Hz
    LOG/calibration/egovehicle_SE3_sensor.feather, intrinsics.feather
    LOG/annotations.feather                                  optional: tracked boxes

Points are in the vehicle's frame (x forward, y left, z up), float16, ego-motion compensated to the
file's stamp, the *start* of the sweep; poses and ``offset_ns`` undo this. Lasers 0 to 31 are
``up_lidar``, 32 to 63 ``down_lidar``, upside down, half a revolution apart (issue 77 of av2-api).
Images are undistorted (k1 to k3 do not apply). Sweeps and images are numbered by time from 0.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers import checks
from densify.readers.decoded_files import read_arrow
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.recorded_poses import PoseTrack

BOX_SIZE = ("length_m", "width_m", "height_m")
SCANNERS = ("up_lidar", "down_lidar")
LASERS_PER_SCANNER = 32
_TRACK = "city_SE3_egovehicle.feather"
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_FX_FY_CX_CY = ("fx_px", "fy_px", "cx_px", "cy_px")


def open_recording(path: Path, scene: str | None) -> Argoverse2:
    """Return the log in a folder, or the log ``scene`` in the folder of a split or the data set."""
    if scene is None and (path / _TRACK).is_file():
        return Argoverse2(path)
    folders = (path, path / "train", path / "val", path / "test")
    log_folders = [file.parent for folder in folders for file in folder.glob(f"*/{_TRACK}")]
    logs = {log.name: log for log in log_folders}
    none = f"no Argoverse 2 log; expected {_TRACK} and sensors/lidar in it, or in folders within it"
    return Argoverse2(logs[checks.chosen_scene("argoverse2", path, scene, sorted(logs), none)])


class Argoverse2(FileSequence):
    """An Argoverse 2 log in the vehicle's frame. The reference time of a sweep is its start."""

    def __init__(self, log: Path) -> None:
        sweeps = checks.numbered_files(log / "sensors" / "lidar", ".feather")
        if not sweeps:
            raise InputError(
                f"{log / 'sensors' / 'lidar'}: no sweeps; expected files such as "
                f"315966265259836000.feather"
            )
        self._stamps_ns = list(sweeps)
        path = log / _TRACK
        columns = _read(path, {"timestamp_ns": "i"}, _POSE)
        stamp_ns, rows = np.unique(columns["timestamp_ns"].astype(np.int64), return_index=True)
        self._track = PoseTrack(str(path), stamp_ns, _poses(columns, path, rows))
        path = log / "calibration" / "egovehicle_SE3_sensor.feather"
        columns = _read(path, {"sensor_name": "s"}, _POSE)
        poses = _poses(columns, path, np.arange(len(columns["sensor_name"])))
        self._T_ego_sensor = dict(zip(columns["sensor_name"], poses, strict=True))
        missing = [name for name in SCANNERS if name not in self._T_ego_sensor]
        if missing:
            raise InputError(
                f"{path}: no sensor {' and '.join(missing)}; got {', '.join(self._T_ego_sensor)}"
            )
        self._T_ego_scanner = np.stack([self._T_ego_sensor[name] for name in SCANNERS])
        cameras = _cameras(log, self._T_ego_sensor)
        folder = log / "sensors" / "cameras"
        images = {name: checks.numbered_files(folder / name, ".jpg", ".png") for name in cameras}
        super().__init__(
            log.resolve().name,
            log,
            range(len(sweeps)),
            cameras,
            exposed_ns={name: dict(enumerate(files)) for name, files in images.items()},
            truth=checks.truth_beside(log),
            files=dict(enumerate(sweeps.values())),
            images={name: dict(enumerate(files.values())) for name, files in images.items()},
        )

    def _returns(self, frame: int) -> Returns:
        # Coordinates and intensity may be NaN ("m"), the numbers of lasers and ns are whole ("i").
        kinds = {**dict.fromkeys("xyz", "m"), "intensity": "m", "laser_number": "i"}
        columns = _read(self._files[frame], {**kinds, "offset_ns": "i"})
        offset_ns = columns["offset_ns"].astype(np.int64)
        points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        return Returns(
            self._track.undo_compensation(points, self._stamps_ns[frame], offset_ns),
            (columns["intensity"] / 255.0).astype(np.float32),
            offset_ns,
            lidar=columns["laser_number"].astype(np.int64) // LASERS_PER_SCANNER,
            scanner_origins=self._T_ego_scanner[:, :3, 3],
            R_scanner_lidar=checks.scanner_axes(self._T_ego_scanner),
        )

    def _pose(self, frame: int) -> Float:
        return self._track.at(self._stamps_ns[frame])

    def boxes(self, frame: int) -> Boxes | None:
        """Return a sweep's boxes in the lidar frame, or None without annotations of this sweep."""
        path, columns = self.where / "annotations.feather", self._annotations
        stamp_ns = self.stamp_ns(frame)
        rows = np.flatnonzero(columns["timestamp_ns"] == stamp_ns) if columns else np.zeros(0, int)
        if not len(rows):
            return None  # no boxes and not annotated look the same
        size_m = np.stack([columns[name][rows] for name in BOX_SIZE], axis=1)
        T = _poses(columns, path, rows)
        return checks.boxes(columns["track_uuid"][rows], T, size_m, f"{path}: sweep {frame}")

    @cached_property
    def _annotations(self) -> dict[str, NDArray[Any]]:
        """Columns of the boxes of all sweeps, empty without a file of boxes."""
        path = self.where / "annotations.feather"
        kinds = {"timestamp_ns": "i", "track_uuid": "s"}
        return _read(path, kinds, (*BOX_SIZE, *_POSE)) if path.is_file() else {}

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the (4,4) pose of a camera in the city frame at the exposure of an image."""
        exposed_ns = self.image_stamps_ns(camera)[number]
        return self._track.at(exposed_ns) @ self._T_ego_sensor[camera]


def _read(
    path: Path, kinds: dict[str, str], numbers: tuple[str, ...] = ()
) -> dict[str, NDArray[Any]]:
    """Return the columns of a table: ``kinds`` as for `read_arrow`, ``numbers`` finite."""
    kinds = {**kinds, **dict.fromkeys(numbers, "n")}
    return read_arrow(path, kinds, ("argoverse", "Argoverse 2 recordings"))


def _poses(columns: dict[str, NDArray[Any]], path: Path, rows: Int) -> Float:
    """Return the (n,4,4) poses in the rows with the indices ``rows`` (n,) of a table."""
    table = np.stack([columns[name] for name in _POSE], axis=1)
    T = [checks.quaternion_pose(table[r, :4], table[r, 4:], f"{path}: row {r}") for r in rows]
    return np.reshape(T, (-1, 4, 4))


def _cameras(log: Path, T_ego_sensor: dict[str, Float]) -> dict[str, Camera]:
    """Return the calibrated cameras, by name, that have a folder of images in the log."""
    names = [p.name for p in sorted((log / "sensors" / "cameras").glob("*")) if p.is_dir()]
    if not names:
        return {}
    path = log / "calibration" / "intrinsics.feather"
    kinds = {"sensor_name": "s", "width_px": "i", "height_px": "i"}
    columns, cameras = _read(path, kinds, _FX_FY_CX_CY), {}
    for name in names:
        rows = np.flatnonzero(columns["sensor_name"] == name).tolist()
        if len(rows) != 1 or name not in T_ego_sensor:
            raise InputError(
                f"{path}: camera {name} has images, but {len(rows)} rows here and "
                f"{'a' if name in T_ego_sensor else 'no'} pose in egovehicle_SE3_sensor.feather; "
                f"expected one of each"
            )
        (row,) = rows
        size_px = int(columns["width_px"][row]), int(columns["height_px"][row])
        lens = [columns[key][row] for key in _FX_FY_CX_CY]
        T_cam_ego = inverse(T_ego_sensor[name])
        cameras[name] = checks.pinhole(name, size_px, lens, T_cam_ego, f"{path}: {name}")
    return cameras
