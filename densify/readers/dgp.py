# SPDX-License-Identifier: MIT
"""Scenes in the format of TRI's Dataset Governance Policy (DGP): DDAD (Guizilini et al., "3D
Packing for Self-Supervised Monocular Depth Estimation", CVPR 2020) and its relatives::

    ROOT/scene_02/scene_<hash>.json        samples, and the files, poses and stamps of their data
    ROOT/scene_02/calibration/<hash>.json  extrinsics (on the vehicle) and intrinsics, by name
    ROOT/scene_02/point_cloud/LIDAR/<stamp>.npz    ROOT/scene_02/rgb/CAMERA_01/<stamp>.jpg

- A scene's folder, or its name behind ``#``; the list of scenes in the root names some that may not
  be there and is not read. Sweeps are numbered from 0 in the order of time, each camera's images
  likewise; what is not on the disk leaves a gap.
- Stamps are ISO dates. DDAD's are tenths of microseconds taken for microseconds, of the year 2464:
  what lies beyond 2200 is divided by ten. DDAD's images are stamped 9 ms before
  the sweep, and their poses are those of 5 to 6 ms later.
- Points have no times, so that nothing can be undone: ``offset_ns`` is None. They are in the frame
  of the sweep's sensor, and poses (one for every sweep and image) are the sensors'.
- DDAD's sweeps are put together from several solid-state scanners, in the vehicle's frame, whose
  origin is on the ground: its lidar has no extrinsics. Where rays start is not said. Scan lines of
  three sides are smoothest from 1.54 to 1.56 m above the ground, as high as the cameras, so that
  the rays are taken to start in the cameras' midst.
- Images are pinholes without distortion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers.decoded_files import read_arrays
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    quaternion_pose,
    truth_beside,
)

_BOGUS_YEAR = 2200
_FIELDS = ("X", "Y", "Z")


def open_recording(path: Path, scene: str | None) -> Dgp:
    """See `densify.readers.ReaderModule`. path: a scene's folder, or one that holds some."""
    if scene is None and find_scene(path):
        return Dgp(path)
    names = sorted(folder.name for folder in path.glob("*/") if find_scene(folder))
    if not names:
        raise InputError(f"{path}: no DGP scene; expected a folder with scene_<hash>.json")
    return Dgp(path / chosen_scene("dgp", path, scene, names))


def find_scene(folder: Path) -> Path | None:
    """The file that describes the folder's scene, None if there is none."""
    found = [p for p in folder.glob("scene_*.json") if not p.name.startswith("scene_dataset")]
    return min(found, default=None)


@dataclass(frozen=True)
class _Datum:
    """One sweep or image. size_px: of an image. T_world_sensor: (4,4)."""

    path: Path
    stamp_ns: int
    T_world_sensor: Float
    fields: tuple[str, ...]
    size_px: tuple[int, int]


class Dgp(FileSequence):
    """A scene as a `LidarSequence` with poses of its images."""

    def __init__(self, path: Path) -> None:
        """path: the scene's folder. Raises InputError if its description or calibration is missing
        or malformed, or none of its sweeps is there."""
        file = find_scene(path)
        if file is None:
            raise InputError(f"{path}: no DGP scene; expected scene_<hash>.json in it")
        sweeps, images, calibration = _read_scene(file)
        lidar = min(sweeps)
        self._sweeps = sweeps[lidar]
        self._images = images
        T_ego_sensor, K = _read_calibration(calibration)
        T_ego_lidar = _of_sensor(T_ego_sensor, lidar, calibration)
        cameras = {}
        for name, of_camera in images.items():
            T_cam_lidar = poses.inverse(_of_sensor(T_ego_sensor, name, calibration)) @ T_ego_lidar
            of_name = _of_sensor(K, name, calibration)
            if of_name[0, 0] <= 0 or of_name[1, 1] <= 0:
                raise InputError(f"{calibration}: {name}: expected positive fx and fy")
            size_px = next(iter(of_camera.values())).size_px
            cameras[name] = Camera(name, *size_px, of_name, T_cam_lidar)
        self._origins_m = None
        if np.array_equal(T_ego_lidar, np.eye(4)) and cameras:
            places = [poses.inverse(camera.T_cam_lidar)[:3, 3] for camera in cameras.values()]
            self._origins_m = np.mean(places, axis=0)[None]
        exposed_ns = {n: {i: d.stamp_ns for i, d in data.items()} for n, data in images.items()}
        super().__init__(
            path.resolve().name,
            path,
            tuple(self._sweeps),
            cameras,
            exposed_ns,
            truth_beside(path),
        )

    def stamp_ns(self, frame: int) -> int:
        """The data set's own."""
        self.check_frame(frame)
        return self._sweeps[frame].stamp_ns

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) the data set's own pose of an image."""
        self.check_image(camera, number)
        return self._images[camera][number].T_world_sensor

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        datum = self._sweeps[frame]
        columns = _read_points(datum)
        points = np.column_stack([columns[name] for name in _FIELDS]).astype(np.float64)
        brightness = columns.get("INTENSITY")
        intensity = None if brightness is None else np.clip(brightness, 0, 1).astype(np.float32)
        return datum.path, Returns(points, intensity, scanner_origins=self._origins_m)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._images[camera][number].path
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        return self._sweeps[frame].T_world_sensor


_Numbered = dict[str, dict[int, _Datum]]


def _read_scene(file: Path) -> tuple[_Numbered, _Numbered, Path]:
    """Sweeps and images that are there, by sensor and number, and the calibration's file."""
    content = read_json(file)
    found: dict[str, _Numbered] = {"point_cloud": {}, "image": {}}
    try:
        data = {entry["key"]: entry for entry in content["data"]}
        keys = {key for sample in content["samples"] for key in sample["datum_keys"]}
        missing = keys - set(data)
        if missing:
            raise KeyError(f"{min(missing)} among its data, which a sample names")
        ids = {key: (data[key]["id"]["timestamp"], data[key]["id"]["name"]) for key in keys}
        entries = [data[key] for key in sorted(keys, key=lambda key: ids[key])]
        for kind, by_sensor in found.items():
            every: dict[str, list[Any]] = {}
            for entry in (e for e in entries if kind in e["datum"]):
                every.setdefault(entry["id"]["name"], []).append(entry)
            for name, of_sensor in every.items():
                numbered = {i: _datum(file, kind, entry) for i, entry in enumerate(of_sensor)}
                there = {i: datum for i, datum in numbered.items() if isfile(datum.path)}
                if there:
                    by_sensor[name] = there
        key = content["samples"][0]["calibration_key"]
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise InputError(
            f"{file}: no {error}; expected a DGP scene with samples and their data; fetch it again"
        ) from None
    if not found["point_cloud"]:
        raise InputError(f"{file}: none of its sweeps is there; expected point_cloud/LIDAR/*.npz")
    return found["point_cloud"], found["image"], file.parent / "calibration" / f"{key}.json"


def _datum(file: Path, kind: str, entry: Mapping[str, Any]) -> _Datum:
    datum, where = entry["datum"][kind], f"{file}: datum {entry['key']}"
    return _Datum(
        file.parent / datum["filename"],
        _stamp_ns(entry["id"]["timestamp"], where),
        _read_pose(datum["pose"], where),
        tuple(datum.get("point_format", ())),
        (int(datum.get("width", 0)), int(datum.get("height", 0))),
    )


def _stamp_ns(text: Any, where: str) -> int:
    try:
        date = datetime.fromisoformat(str(text).replace("Z", "+00:00"))
        since = date - datetime(1970, 1, 1, tzinfo=timezone.utc)
    except (TypeError, ValueError):
        raise InputError(
            f"{where}: timestamp: got {text!r}, expected a date such as 2019-06-27T14:30:25.002790Z"
        ) from None
    microseconds = since // timedelta(microseconds=1)
    return microseconds * (100 if date.year >= _BOGUS_YEAR else 1000)


def _read_pose(given: Mapping[str, Any], where: str) -> Float:
    turn, place = given["rotation"], given["translation"]
    quaternion = [turn[key] for key in ("qw", "qx", "qy", "qz")]
    return quaternion_pose(quaternion, [place[key] for key in "xyz"], where)


def _read_calibration(file: Path) -> tuple[dict[str, Float], dict[str, Float]]:
    """T_ego_sensor (4,4) and K (3,3) by name."""
    given = read_json(file)
    try:
        names: Sequence[str] = given["names"]
        T_ego_sensor = {
            name: _read_pose(extrinsic, f"{file}: extrinsics of {name}")
            for name, extrinsic in zip(names, given["extrinsics"], strict=True)
        }
        K = {
            name: np.array(
                [[i["fx"], i.get("skew", 0.0), i["cx"]], [0, i["fy"], i["cy"]], [0, 0, 1]], float
            )
            for name, i in zip(names, given["intrinsics"], strict=True)
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{file}: {error}; expected names, and extrinsics and intrinsics of each"
        ) from None
    return T_ego_sensor, K


def _of_sensor(values: Mapping[str, Float], name: str, file: Path) -> Float:
    if name not in values or not np.isfinite(values[name]).all():
        raise InputError(
            f"{file}: no finite calibration of {name}; got {', '.join(map(str, values))}"
        )
    return values[name]


def _read_points(datum: _Datum) -> dict[str, Float]:
    """Columns by name; no Python objects are read."""
    arrays = read_arrays(datum.path, ("data",))
    if "data" not in arrays:
        raise InputError(f"{datum.path}: holds no array data, expected its points there")
    points = arrays["data"]
    fits = points.ndim == 2 and points.shape[1] == len(datum.fields) and points.dtype.kind in "fiu"
    if not fits or not set(_FIELDS) <= set(datum.fields):
        raise InputError(
            f"{datum.path}: got an array {points.shape} of {points.dtype}, expected numbers, a "
            f"column for each of {' '.join(datum.fields) or 'X Y Z INTENSITY'}, X Y Z among them"
        )
    return dict(zip(datum.fields, points.T, strict=True))
