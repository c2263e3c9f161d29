# SPDX-License-Identifier: MIT
"""Read the folders of finished runs, with thresholds on confidence and age."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json, read_yaml
from densify.geometry import poses
from densify.geometry.types import CameraView, Float, Float32, ObjectTrack
from densify.outputs.cloud_laz import StoredCloud, read_cloud
from densify.outputs.depth_png import (
    map_path,
    metres,
    read_stored,
    stored_age,
    stored_confidence,
)
from densify.outputs.scene_file import SceneFile, damage_named, read_scene, read_tracks
from densify.readers.decoded_files import decode_image

_KINDS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
}
_UNOBSERVED = np.array([140, 140, 140], np.uint8)


class Kept(NamedTuple):
    """A share of pixels with a depth, or a number of points, and how much the thresholds keep."""

    before: float  # value without thresholds on confidence and age
    after: float  # value within the thresholds


class FinishedRun:
    """The folder of one densified key sweep. Files are read on demand and may raise InputError."""

    def __init__(
        self,
        folder: Path,
        min_confidence: float = 0.0,
        max_age_ms: float | None = None,
        cameras: Sequence[str] | None = None,
    ) -> None:
        """Open a folder. Arguments as in `densify.outputs.export.export_run`."""
        path = folder / "run.yaml"
        if not path.is_file():
            raise InputError(
                f"{folder}: {_what_is_there(folder)}; expected the folder of a finished run and "
                f"key, such as densify-out/street/000120"
            )
        with damage_named(path):
            record = read_yaml(path)[0]
            # stamp_ns: the key sweep's reference time in ns since 1970; data: text of --data
            self.key, self.stamp_ns = int(record["key"]), int(record["stamp_ns"])
            self.data = str(record["data"])
            last = self.data.rstrip("/").rpartition("/")[2]
            self.recording = str(record.get("recording") or last)
        self.folder, self._chosen = folder, cameras
        self._min_confidence = stored_confidence(min_confidence)
        self._max_age = stored_age(np.inf if max_age_ms is None else max_age_ms / 1000)
        # Camera -> measured, filled -> share of pixels, for the maps read so far
        self.density: dict[str, dict[str, Kept]] = {}
        self._num_points: dict[Path, Kept] = {}

    @cached_property
    def cameras(self) -> list[str]:
        """The names of the chosen maps: CAMERA, or CAMERA/NUMBER of one image."""
        names = map_names(self.folder / "depth")
        if not names:
            raise InputError(f"{self.folder}: no depth maps in it; run densify with a camera first")
        there = sorted({name.partition("/")[0] for name in names})
        if unknown := {*(self._chosen or ())} - {*there}:
            raise InputError(f"--camera {min(unknown)}: expected one of {', '.join(there)}")
        return [n for n in names if n.partition("/")[0] in (self._chosen or there)]

    @cached_property
    def scene(self) -> SceneFile:
        """The content of scene.json."""
        return read_scene(self.folder / "scene" / "scene.json")

    @cached_property
    def views(self) -> dict[str, CameraView]:
        """The camera and pose of each chosen map, by name."""
        return {name: view for name, view in self.scene.views.items() if name in self.cameras}

    @cached_property
    def tracks(self) -> list[ObjectTrack]:
        """The tracks of moving objects, each with a pose at the key sweep."""
        return read_tracks(self.folder / "movers.json")

    @property
    def num_points(self) -> Kept | None:
        """The number of points in the clouds read so far, None before the first cloud."""
        counts = self._num_points.values()
        return Kept(sum(k.before for k in counts), sum(k.after for k in counts)) if counts else None

    def measure(self, camera: str) -> str:
        """Return ``z`` (depth along the camera's axis) or ``range`` (distance from the lens)."""
        path = self.folder / "metrics.json"
        with damage_named(path):
            return str(read_json(path)["measure"][camera])

    def jpeg(self, camera: str) -> bytes | None:
        """Return the bytes of a map's image file, None if the run has no image."""
        path = map_path(self.folder / "scene", "image", camera, ".jpg")
        if camera not in self.scene.views or not path.is_file():
            return None
        known, data = self.scene.views[camera].camera, read_bytes(path)
        height, width = decode_image(data, path).shape[:2]
        if (width, height) != (known.width_px, known.height_px):
            raise InputError(
                f"{path}: got {width} x {height} px, expected {known.width_px} x "
                f"{known.height_px} as scene.json says; densify the key again"
            )
        return data

    def maps(self, camera: str) -> dict[str, NDArray[Any]]:
        """Return kind (as in `_KINDS`) -> (H,W) stored values, 0 beyond a threshold."""
        maps: dict[str, NDArray[Any]] = {}
        for kind, dtype in _KINDS.items():
            path = map_path(self.folder, kind, camera)
            maps[kind] = read_stored(path, dtype, f"a map of {kind}")
            is_same = maps[kind].shape == maps["depth"].shape
            if is_same and kind in ("confidence", "age"):
                is_same = np.array_equal(maps[kind] > 0, maps["depth_filled"] > 0)
            if not is_same:
                raise InputError(f"{path}: does not belong to the others; densify the key again")
        keep = (maps["confidence"] >= self._min_confidence) & (maps["age"] <= self._max_age)
        self.density[camera] = {
            product: Kept(float((maps[kind] > 0).mean()), float(((maps[kind] > 0) & keep).mean()))
            for product, kind in (("measured", "depth"), ("filled", "depth_filled"))
        }
        return {kind: stored * keep for kind, stored in maps.items()}

    def full_m(self, camera: str) -> Float32:
        """Return (H,W) filled depth in metres, completed with a prior if given, 0 for no depth."""
        if self.measure(camera) != "z":
            raise InputError(
                f"{camera}: its depth is the range from the lens, and the form takes camera z; "
                f"densify it with --set project.depth=z, or leave it out by naming the others with "
                f"--camera"
            )
        stored, path = (
            self.maps(camera)["depth_filled"],
            map_path(self.folder, "depth_full", camera),
        )
        if path.is_file():
            full = read_stored(path, np.uint16, "a map of depth_full")
            stored = np.where(stored > 0, stored, full)
        return metres(stored)

    def cloud(self) -> StoredCloud:
        """Return the accumulated points within the thresholds."""
        return self._read(self.folder / "cloud.laz")

    def mover_clouds(self) -> list[StoredCloud]:
        """Return a cloud for each separated object (``movers=separate``), within the thresholds."""
        paths = sorted(self.folder.glob("movers/*/cloud.laz"))
        return [self._read(path) for path in paths]

    def _read(self, path: Path) -> StoredCloud:
        cloud = read_cloud(path)
        age = stored_age(1e-9 * np.abs(cloud.stamp_ns - self.stamp_ns))
        keep = (stored_confidence(cloud.confidence) >= self._min_confidence) & (
            age <= self._max_age
        )
        self._num_points[path] = Kept(len(keep), int(keep.sum()))
        return cloud.select(keep)


def map_names(*folders: Path) -> list[str]:
    """Return the names of the maps in folders: CAMERA, or CAMERA/NUMBER of one image."""
    paths = {path.relative_to(folder) for folder in folders for path in folder.rglob("*.png")}
    return sorted(path.with_suffix("").as_posix() for path in paths)


def finished_runs(
    folder: Path,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    cameras: Sequence[str] | None = None,
) -> list[FinishedRun]:
    """Return the run in a folder, or the runs below it by parent folder and frame number."""
    places = sorted(
        path.parent for level in ("*", "*/*") for path in folder.glob(f"{level}/run.yaml")
    )
    if (folder / "run.yaml").is_file() or not places:
        places = [folder]
    runs = [FinishedRun(place, min_confidence, max_age_ms, cameras) for place in places]
    return sorted(runs, key=lambda run: (run.folder.parent, run.key))


def _what_is_there(folder: Path) -> str:
    """Return what a folder without run.yaml is, as a clause for an error."""
    if (folder / "dataset.json").is_file():
        return (
            "holds a training set of maps alone (--layout kitti-depth), and the other formats need "
            "clouds, ages and images; make the set with --layout densify to export it"
        )
    return "no run.yaml in it"


class ShownSweep(NamedTuple):
    """A sweep as measured, for display, with its registered pose."""

    frame: int  # frame number
    stamp_ns: int  # reference time in ns since 1970
    T_key_lidar: Float  # (4,4) pose in the key sweep's lidar frame
    points: StoredCloud  # points of the sweep. ``points.rigid_points`` are the measured positions.


class Shot(NamedTuple):
    """An image of a camera (name and exposure time), with its depth maps."""

    name: str  # name of the map
    view: CameraView  # camera and pose
    stamp_ns: int  # time of the exposure in ns since 1970
    jpeg: bytes | None  # bytes of the image file, None without an image
    maps_m: dict[str, Float32]  # "depth" and "depth_filled" -> (H,W) float32 metres, 0 for no depth
    is_pinhole: bool  # True if the camera has no distortion and depth is along its axis


class Timeline(NamedTuple):
    """All that a viewer shows of one densified key sweep: cloud, sweeps and camera images."""

    run: FinishedRun  # the finished run of this key sweep
    # (4,4) pose of the key sweep. The world is the first key sweep's lidar frame.
    T_world_key: Float
    cloud: StoredCloud  # accumulated points at the key sweep's time, key sweep's lidar frame
    # Sweeps of the window as measured, ascending in time; the key sweep alone if the viewer shows
    # several runs
    sweeps: list[ShownSweep]
    shots: list[Shot]  # camera images with their depth maps, one `Shot` for each chosen map


def timelines(runs: Sequence[FinishedRun]) -> Iterator[Timeline]:
    """Yield one run with all sweeps of its window, or several runs with their key sweeps."""
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        cloud, sweeps = run.cloud(), []
        for sweep in run.scene.table["sweeps"]:
            frame, since_s, T = sweep["frame"], sweep["since_key_s"], sweep["T_key_lidar"]
            if frame == run.key or (len(runs) == 1 and None not in (since_s, T)):
                own = cloud.select((cloud.frame == frame) & ~cloud.far)
                stamp_ns = run.stamp_ns + round(1e9 * (since_s or 0.0))
                sweeps.append(ShownSweep(frame, stamp_ns, np.array(T), own))
        shots = [_shot(run, name) for name in run.views]
        yield Timeline(run, T_world_key, cloud, sweeps, shots)


def key_poses(runs: Sequence[FinishedRun]) -> Iterator[Float]:
    """Yield ``T_world_key`` (4,4) of each run. The world is the first key sweep's lidar frame."""
    T_world_key = np.eye(4)
    for before, run in zip([None, *runs], runs, strict=False):
        if before is not None:  # one key sweep must be in the window of the other
            T_world_key = T_world_key @ _relative_pose(before, run)
        yield T_world_key


def colours(cloud: StoredCloud) -> NDArray[np.uint8]:
    """Return (N,3) uint8 RGB colours, gray for points that no camera observed."""
    return np.where(cloud.rgb.any(axis=1, keepdims=True), cloud.rgb, _UNOBSERVED)


def _relative_pose(run: FinishedRun, other: FinishedRun) -> Float:
    """Return the (4,4) pose T_run_other from ``other``'s key sweep to ``run``'s key sweep."""
    if other.key in run.scene.T_key_lidar:
        return run.scene.T_key_lidar[other.key]
    if run.key in other.scene.T_key_lidar:
        return poses.inverse(other.scene.T_key_lidar[run.key])
    raise InputError(
        f"{other.folder}: neither key {other.key} nor {run.key} is in the other's window, and "
        f"their relative pose is unknown; densify keys nearer to each other"
    )


def _shot(run: FinishedRun, name: str) -> Shot:
    view, maps = run.views[name], run.maps(name)
    stamp_ns = run.stamp_ns + round(1e9 * view.late_s)
    maps_m = {kind: metres(maps[kind]) for kind in ("depth", "depth_filled")}
    is_pinhole = view.camera.is_rectified and run.measure(name) == "z"
    return Shot(name, view, stamp_ns, run.jpeg(name), maps_m, is_pinhole)
