# SPDX-License-Identifier: MIT
"""Read TRI's Dataset Governance Policy (DGP) scenes: DDAD (Guizilini et al., CVPR 2020), others.

    ROOT/scene_02/scene_<hash>.json        samples, and the files, poses and stamps of their data
    ROOT/scene_02/calibration/<hash>.json  extrinsics (on the vehicle) and intrinsics, by name
    ROOT/scene_02/point_cloud/LIDAR/<stamp>.npz    ROOT/scene_02/rgb/CAMERA_01/<stamp>.jpg

Sweeps and each camera's images are numbered by time from 0; a missing file's number stays unused.
Each has a pose. Points have no times and are in the sensor's frame. Images have no distortion.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from datetime import datetime, timedelta, timezone
from os.path import isfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import described_in, read_json
from densify.geometry import poses
from densify.geometry.types import Float
from densify.readers import checks
from densify.readers.decoded_files import read_arrays
from densify.readers.file_sequence import FileSequence, Returns

_BOGUS_YEAR = 2200  # DDAD stores tenths of microseconds as microseconds


def open_recording(path: Path, scene: str | None) -> Dgp:
    """Open a scene in Toyota's Dataset Governance Policy format.

    Args:
        path: Folder of the scene, or of several scenes.
        scene: Name of one of several scenes; None for the scene in ``path``, or its only one.

    Raises:
        InputError: The folder has no scene, several and no name is given, or none of this name.
    """
    if scene is None and _scene_files(path):
        return Dgp(path)
    names = sorted(folder.name for folder in path.glob("*/") if _scene_files(folder))
    none = "no DGP scene; expected a folder with scene_<hash>.json"
    return Dgp(path / checks.chosen_scene("dgp", path, scene, names, none))


def _scene_files(folder: Path) -> list[Path]:
    return [p for p in folder.glob("scene_*.json") if not p.name.startswith("scene_dataset")]


class _Datum(NamedTuple):
    """A sweep or image, its time, and the (4,4) pose of its sensor at that time."""

    path: Path
    stamp_ns: int
    T_world_sensor: Float
    columns: tuple[str, ...]  # of a sweep
    size_px: tuple[int, int]  # width and height of an image


class Dgp(FileSequence):
    """A DGP scene as a `LidarSequence`, with poses of its images."""

    def __init__(self, path: Path) -> None:
        """Read the scene of a folder with scene_<hash>.json."""
        sweeps, self._images, calibration = _read_scene(min(_scene_files(path)))
        lidar = min(sweeps)
        self._sweeps = sweeps[lidar]
        self._stamps_ns = {number: sweep.stamp_ns for number, sweep in self._sweeps.items()}
        T_ego_sensor, lenses = _read_calibration(calibration)
        missing = [name for name in (lidar, *self._images) if name not in lenses]
        if missing:
            raise InputError(
                f"{calibration}: no calibration of {missing[0]}; got {', '.join(map(str, lenses))}"
            )
        T_ego_lidar, cameras = T_ego_sensor[lidar], {}
        for name, data in self._images.items():
            size_px, where = next(iter(data.values())).size_px, f"{calibration}: {name}"
            T_cam_lidar = poses.inverse(T_ego_sensor[name]) @ T_ego_lidar
            cameras[name] = checks.pinhole(name, size_px, lenses[name], T_cam_lidar, where)
        # DDAD merges several solid-state scanners into the vehicle's frame, with its origin on the
        # ground, and does not publish the origin of the rays. Scan lines are smoothest as seen from
        # 1.55 m above the ground: the mean position of the cameras is used.
        self._origins_m = None
        if np.array_equal(T_ego_lidar, np.eye(4)) and cameras:
            origins_m = [poses.inverse(camera.T_cam_lidar)[:3, 3] for camera in cameras.values()]
            self._origins_m = np.mean(origins_m, axis=0)[None]
        super().__init__(
            path.resolve().name,
            path,
            tuple(self._sweeps),
            cameras,
            exposed_ns={
                name: {number: datum.stamp_ns for number, datum in data.items()}
                for name, data in self._images.items()
            },
            truth=checks.truth_beside(path),
            files={number: sweep.path for number, sweep in self._sweeps.items()},
            images={
                name: {number: datum.path for number, datum in data.items()}
                for name, data in self._images.items()
            },
        )

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the recorded (4,4) pose of a camera in the world at the exposure of an image."""
        self.check_image(camera, number)
        return self._images[camera][number].T_world_sensor

    def _returns(self, frame: int) -> Returns:
        rows = read_arrays(self._files[frame], ("data",))["data"]
        columns = dict(zip(self._sweeps[frame].columns, rows.T, strict=True))
        points = np.column_stack([columns[name] for name in "XYZ"]).astype(np.float64)
        brightness = columns.get("INTENSITY")
        intensity = None if brightness is None else np.clip(brightness, 0, 1).astype(np.float32)
        return Returns(points, intensity, scanner_origins=self._origins_m)

    def _pose(self, frame: int) -> Float:
        return self._sweeps[frame].T_world_sensor


_Numbered = dict[str, dict[int, _Datum]]


def _read_scene(file: Path) -> tuple[_Numbered, _Numbered, Path]:
    """Return sweeps and images, each by sensor and number, and the path of the calibration file."""
    content = read_json(file)
    sweeps: _Numbered = defaultdict(dict)
    images: _Numbered = defaultdict(dict)
    with described_in(file, "a DGP scene with samples and their data"):
        data = {entry["key"]: entry for entry in content["data"]}
        keys = {key for sample in content["samples"] for key in sample["datum_keys"]}
        next_number: Counter[str] = Counter()  # by sensor
        entries = (data[key] for key in keys)
        for entry in sorted(entries, key=lambda entry: entry["id"]["timestamp"]):
            kind = next(iter(entry["datum"]))
            name = entry["id"]["name"]
            if kind in ("point_cloud", "image"):
                datum = _datum(file, kind, entry)
                if isfile(datum.path):
                    (images if kind == "image" else sweeps)[name][next_number[name]] = datum
            next_number[name] += 1
        key = content["samples"][0]["calibration_key"]
    if not sweeps:
        raise InputError(f"{file}: none of its sweeps is there; expected point_cloud/LIDAR/*.npz")
    calibration = checks.file_within(file.parent, f"calibration/{key}.json", file)
    return sweeps, dict(sorted(images.items())), calibration


def _datum(file: Path, kind: str, entry: Mapping[str, Any]) -> _Datum:
    datum, where = entry["datum"][kind], f"{file}: datum {entry['key']}"
    return _Datum(
        checks.file_within(file.parent, datum["filename"], where),
        _stamp_ns(entry["id"]["timestamp"]),
        _read_pose(datum["pose"], where),
        columns=tuple(datum.get("point_format", ())),
        size_px=(int(datum.get("width", 0)), int(datum.get("height", 0))),
    )


def _stamp_ns(text: str) -> int:
    """Return the nanoseconds since 1970 of an ISO date. Raise ValueError if the text is no date."""
    date = datetime.fromisoformat(text.replace("Z", "+00:00"))
    microseconds = (date - datetime(1970, 1, 1, tzinfo=timezone.utc)) // timedelta(microseconds=1)
    return microseconds * (100 if date.year >= _BOGUS_YEAR else 1000)


def _read_pose(pose: Mapping[str, Any], where: str) -> Float:
    """Return the (4,4) pose of an entry. Messages begin with ``where``."""
    rotation, translation = pose["rotation"], pose["translation"]
    quaternion = [rotation[key] for key in ("qw", "qx", "qy", "qz")]
    return checks.quaternion_pose(quaternion, [translation[key] for key in "xyz"], where)


def _read_calibration(file: Path) -> tuple[dict[str, Float], dict[str, list[float]]]:
    """Return T_ego_sensor (4,4), and fx fy cx cy in pixels, of each sensor by its name."""
    content, T_ego_sensor, lenses = read_json(file), {}, {}
    with described_in(file, "names, and extrinsics and intrinsics of each"):
        sensors = zip(content["names"], content["extrinsics"], content["intrinsics"], strict=True)
        for name, extrinsic, lens in sensors:
            T_ego_sensor[name] = _read_pose(extrinsic, f"{file}: extrinsics of {name}")
            lenses[name] = [float(lens[key]) for key in ("fx", "fy", "cx", "cy")]
    return T_ego_sensor, lenses
