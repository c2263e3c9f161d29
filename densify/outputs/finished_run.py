# SPDX-License-Identifier: MIT
"""Read the folder of a key that `key_outputs` writes, and export it for other tools."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from densify.config.errors import InputError, did_you_mean, shorten_message
from densify.config.file_content import import_extra, read_bytes, read_json, read_yaml
from densify.config.plugins import EXPORTS
from densify.geometry import poses
from densify.geometry.arrays import joined_rows
from densify.geometry.types import Camera, CameraView, Float, Float32, ObjectTrack
from densify.outputs.cloud_files import StoredCloud, read_cloud, save_ply
from densify.outputs.depth_png import (
    PixelType,
    age_of,
    confidence_of,
    map_path,
    metres,
    read_stored,
    stored_age,
    stored_confidence,
)
from densify.outputs.folders import plain, writing
from densify.readers import checks
from densify.readers.decoded_files import decode_image
from densify.version import __version__

_KINDS: Mapping[str, PixelType] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
}


class Thresholds(NamedTuple):
    """Limits that select which pixels and points of a run are read. By default, all are read."""

    min_confidence: float = 0.0  # least confidence, 0 to 1
    # Greatest time from the source sweep to the image's exposure (pixels) or the key sweep
    # (points), None for any. A filled pixel has the age of the nearest measured pixel.
    max_age_ms: float | None = None
    cameras: Sequence[str] | None = None  # names of the cameras, None for all


EVERYTHING = Thresholds()


class Kept(NamedTuple):
    """A share of pixels with a depth, or a number of points, before and after the thresholds."""

    before: float  # share or number without thresholds on confidence and age
    after: float  # share or number within the thresholds


@dataclass(frozen=True)
class SceneFile:
    """The content of scene.json."""

    table: Mapping[str, Any]  # the parsed JSON of the whole file
    views: Mapping[str, CameraView]  # name of the depth map -> its camera and pose
    # Frame number of a sweep of the window -> (4,4) pose in the key sweep's lidar frame
    T_key_lidar: Mapping[int, Float]


class LoadedMaps(NamedTuple):
    """The maps of one image, which are 0 where no depth is."""

    depth_m: Float32  # (H,W) measured depth in metres
    filled_m: Float32  # (H,W) measured and filled depth in metres
    confidence: Float32  # (H,W) 0 to 1
    age_s: Float32  # (H,W) time from the measurement to the exposure in seconds


@dataclass(frozen=True)
class LoadedResult:
    """The arrays of a finished run, as `load_result` returns them."""

    folder: Path  # the run's folder
    key: int  # frame number of the key sweep
    depth: Mapping[str, LoadedMaps]  # name of the depth map: CAMERA, or CAMERA/NUMBER
    cloud: StoredCloud  # points at the key sweep's time, in its lidar frame
    tracks: Sequence[ObjectTrack]  # moving objects, largest first
    metrics: Mapping[str, Any]  # the content of metrics.json

    def __repr__(self) -> str:
        return (
            f"LoadedResult(key {self.key}: depth {', '.join(self.depth)}; "
            f"{len(self.cloud.points):,} points, {len(self.tracks)} moving objects)"
        )


def load_result(folder: str | Path) -> LoadedResult:
    """Return the arrays of a finished run from its folder, such as densify-out/street/000120.

    Raise InputError if a file of the run is missing or damaged.
    """
    run = FinishedRun(Path(folder))
    with _damage_named(run.folder / "metrics.json"):
        metrics = read_json(run.folder / "metrics.json")
    depth = {}
    for name in run.chosen_maps:
        maps = run.maps(name)
        depth[name] = LoadedMaps(
            metres(maps["depth"]),
            metres(maps["depth_filled"]),
            confidence_of(maps["confidence"]),
            age_of(maps["age"]),
        )
    return LoadedResult(run.folder, run.key, depth, run.whole_cloud(), run.tracks, metrics)


class FinishedRun:
    """The folder of one densified key sweep. Files are read on demand and may raise InputError."""

    def __init__(self, folder: Path, thresholds: Thresholds = EVERYTHING) -> None:
        """Open a run's folder to read within ``thresholds``. Raise InputError if it has no run."""
        path, problem = folder / "run.yaml", "no run.yaml in it"
        if (folder / "dataset.json").is_file():
            problem = (
                "holds a training set of maps alone (--layout kitti-depth), and the other formats "
                "need clouds, ages and images; make the set with --layout densify to export it"
            )
        if not path.is_file():
            raise InputError(
                f"{folder}: {problem}; expected the folder of a finished run and key, such as "
                f"densify-out/street/000120"
            )
        with _damage_named(path):
            record = read_yaml(path)[0]
            self.key = int(record["key"])
            self.stamp_ns = int(record["stamp_ns"])  # reference time of the key sweep, since 1970
            data = str(record["data"])  # text of --data
            self.recording = str(record.get("recording") or data.rstrip("/").rpartition("/")[2])
        self.folder = folder
        self._cameras = thresholds.cameras
        self._min_confidence = stored_confidence(thresholds.min_confidence)
        max_age_ms = np.inf if thresholds.max_age_ms is None else thresholds.max_age_ms
        self._max_age = stored_age(max_age_ms / 1000)
        # Name of a map -> measured, filled -> share of pixels, for the maps read so far
        self.density: dict[str, dict[str, Kept]] = {}
        self._num_points: dict[Path, Kept] = {}

    @cached_property
    def chosen_maps(self) -> list[str]:
        """The names of the chosen cameras' depth maps: CAMERA, or CAMERA/NUMBER of one image.

        Raise InputError if the run has no depth maps, or if a chosen camera is unknown.
        """
        names = map_names(self.folder / "depth")
        if not names:
            raise InputError(f"{self.folder}: no depth maps in it; run densify with a camera first")
        existing = sorted({name.partition("/")[0] for name in names})
        if unknown := {*(self._cameras or ())} - {*existing}:
            raise InputError(f"camera {min(unknown)}: expected one of {', '.join(existing)}")
        chosen = self._cameras or existing
        return [name for name in names if name.partition("/")[0] in chosen]

    @cached_property
    def scene(self) -> SceneFile:
        """The content of scene.json."""
        return read_scene(self.folder / "scene" / "scene.json")

    @cached_property
    def tracks(self) -> list[ObjectTrack]:
        """The tracks of moving objects, each with a pose at the key sweep."""
        return read_tracks(self.folder / "movers.json")

    @property
    def num_points(self) -> Kept | None:
        """The number of points in the clouds read so far, None before the first cloud."""
        counts = self._num_points.values()
        return Kept(sum(k.before for k in counts), sum(k.after for k in counts)) if counts else None

    def measure(self, name: str) -> str:
        """Return "z" if a map has depth along the camera's axis, "range" if from the lens."""
        path = self.folder / "metrics.json"
        with _damage_named(path):
            return str(read_json(path)["measure"][name])

    def require_z(self, name: str) -> None:
        """Raise InputError unless a map has depth along the camera's axis."""
        if self.measure(name) != "z":
            raise InputError(
                f"{name}: its depth is the range from the lens, and the form takes camera z; "
                f"densify it with --set project.depth=z, or leave it out by naming the others with "
                f"--camera"
            )

    def jpeg(self, name: str) -> bytes | None:
        """Return the bytes of a map's image file, None if the run has no image."""
        path = map_path(self.folder / "scene", "image", name, ".jpg")
        if name not in self.scene.views or not path.is_file():
            return None
        data, expected = read_bytes(path), self.scene.views[name].camera
        height, width = decode_image(data, path).shape[:2]
        if (width, height) != (expected.width_px, expected.height_px):
            raise InputError(
                f"{path}: got {width} x {height} px, expected {expected.width_px} x "
                f"{expected.height_px} as scene.json says; densify the key again"
            )
        return data

    def maps(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the stored values (H,W) of an image's maps, 0 beyond a threshold.

        The keys are depth, depth_filled, confidence and age, values of `densify.outputs.depth_png`.
        This also enters the shares of pixels into ``density``. Raise InputError if a map is damaged
        or does not belong to the others.
        """
        maps: dict[str, NDArray[Any]] = {}
        for kind, dtype in _KINDS.items():
            path = map_path(self.folder, kind, name)
            maps[kind] = read_stored(path, dtype, f"a map of {kind}")
            is_same = maps[kind].shape == maps["depth"].shape
            if is_same and kind in ("confidence", "age"):
                is_same = np.array_equal(maps[kind] > 0, maps["depth_filled"] > 0)
            if not is_same:
                raise InputError(f"{path}: does not belong to the others; densify the key again")
        keep = (maps["confidence"] >= self._min_confidence) & (maps["age"] <= self._max_age)
        self.density[name] = {
            product: Kept(float((maps[kind] > 0).mean()), float(((maps[kind] > 0) & keep).mean()))
            for product, kind in (("measured", "depth"), ("filled", "depth_filled"))
        }
        return {kind: stored * keep for kind, stored in maps.items()}

    def full_m(self, name: str) -> Float32:
        """Return filled depth (H,W) in metres, completed with the prior if any, 0 for none.

        The thresholds leave out filled depth, and keep depth from the prior.
        """
        stored = self.maps(name)["depth_filled"]
        path = map_path(self.folder, "depth_full", name)
        if path.is_file():
            full = read_stored(path, np.uint16, "a map of depth_full")
            filled_path = map_path(self.folder, "depth_filled", name)
            filled = read_stored(filled_path, np.uint16, "a map of depth_filled")
            stored = np.where(filled > 0, stored, full)
        return metres(stored)

    def cloud(self) -> StoredCloud:
        """Return the accumulated points within the thresholds."""
        return self._read(self.folder / "cloud.laz")

    def whole_cloud(self) -> StoredCloud:
        """Return `cloud`, followed by the points of separated objects (``movers=separate``)."""
        movers = sorted(self.folder.glob("movers/*/cloud.laz"))
        return joined_rows([self.cloud(), *map(self._read, movers)])

    def _read(self, path: Path) -> StoredCloud:
        cloud = read_cloud(path)
        age = stored_age(1e-9 * np.abs(cloud.stamp_ns - self.stamp_ns))
        is_sure = stored_confidence(cloud.confidence) >= self._min_confidence
        keep = is_sure & (age <= self._max_age)
        self._num_points[path] = Kept(len(keep), int(keep.sum()))
        return cloud.select(keep)


def finished_runs(folder: Path, thresholds: Thresholds = EVERYTHING) -> list[FinishedRun]:
    """Return the run in a folder, else the runs up to two levels below, by parent and key."""
    paths = [path for depth in ("*", "*/*") for path in folder.glob(f"{depth}/run.yaml")]
    folders = sorted(path.parent for path in paths)
    if (folder / "run.yaml").is_file() or not folders:
        folders = [folder]
    runs = [FinishedRun(folder, thresholds) for folder in folders]
    return sorted(runs, key=lambda run: (run.folder.parent, run.key))


def key_poses(runs: Sequence[FinishedRun]) -> Iterator[Float]:
    """Yield ``T_world_key`` (4,4) of each run. The world is the first key sweep's lidar frame."""
    T_world_key = np.eye(4)
    for previous, run in zip([None, *runs], runs, strict=False):
        if previous is not None:
            T_world_key = T_world_key @ _relative_pose(previous, run)
        yield T_world_key


def _relative_pose(run: FinishedRun, next_run: FinishedRun) -> Float:
    """Return the (4,4) pose of the next run's key sweep in the lidar frame of the key sweep."""
    if next_run.key in run.scene.T_key_lidar:
        return run.scene.T_key_lidar[next_run.key]
    if run.key in next_run.scene.T_key_lidar:
        return poses.inverse(next_run.scene.T_key_lidar[run.key])
    raise InputError(
        f"{next_run.folder}: neither key {next_run.key} nor {run.key} is in the other's window, "
        f"and their relative pose is unknown; densify keys nearer to each other"
    )


def map_names(*folders: Path) -> list[str]:
    """Return the names of the maps in folders: CAMERA, or CAMERA/NUMBER of one image."""
    paths = {path.relative_to(folder) for folder in folders for path in folder.rglob("*.png")}
    return sorted(path.with_suffix("").as_posix() for path in paths)


def read_scene(path: Path) -> SceneFile:
    """Return the content of scene.json. Raise InputError if it is damaged."""
    with _damage_named(path):
        table = read_json(path)
        T_key_lidar = {sweep["frame"]: sweep["T_key_lidar"] for sweep in table["sweeps"]}
        return SceneFile(
            table,
            {name: _view(view) for name, view in table["views"].items()},
            {f: checks.pose(T, "T_key_lidar") for f, T in T_key_lidar.items() if T is not None},
        )


def read_tracks(path: Path) -> list[ObjectTrack]:
    """Return the tracks of moving objects in movers.json. Raise InputError if it is damaged."""
    with _damage_named(path):
        table = read_json(path)
        tracks = [_track(entry) for entry in table["objects"]]
        if any(table["key"] not in track.frames for track in tracks):
            raise ValueError("an object has no pose at the key")
        return tracks


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Turn errors by unexpected file content within the block into InputError with the path."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, InputError) as error:
        if str(error).startswith(str(path)):
            raise
        reason = shorten_message(f"{type(error).__name__}: {error}")
        raise InputError(
            f"{path}: damaged, or of another version ({reason}); densify the key again"
        ) from error


def _view(entry: Mapping[str, Any]) -> CameraView:
    """Return the camera and pose of an entry in scene.json."""
    values = {field.name: entry[field.name] for field in fields(Camera)} | {
        "K": _array(entry["K"], 3, 3),
        "T_cam_lidar": checks.pose(entry["T_cam_lidar"], "T_cam_lidar"),
        "distortion": tuple(map(float, entry["distortion"])),
    }
    camera = Camera(**values)
    is_known = camera.model in ("pinhole", "fisheye", "mei")
    if not is_known or not min(camera.width_px, camera.height_px, camera.K[0, 0]) > 0:
        raise ValueError(f"camera {camera.name}: size, model or K")
    T_cam_key = checks.pose(entry["T_cam_key"], "T_cam_key")
    return CameraView(camera, T_cam_key, float(entry["late_s"]), entry["number"])


def _track(entry: Mapping[str, Any]) -> ObjectTrack:
    """Return the track of an entry in movers.json."""
    columns = {name: [pose[name] for pose in entry["poses"]] for name in entry["poses"][0]}
    T_key_object = [checks.pose(T, "T_key_object") for T in columns["T_key_object"]]
    return ObjectTrack(
        instance=int(entry["instance"]),
        size_m=_array(entry["size_m"], 3),
        frames=tuple(map(int, columns["frame"])),
        stamp_ns=np.array(columns["stamp_ns"], np.int64),
        T_key_object=np.stack(T_key_object),
        velocity_m_s=_array(columns["velocity_m_s"], len(T_key_object), 3),
        num_points=np.array(columns["num_points"], np.int64),
        seen_size_m=_array(entry["seen_size_m"], 3),
        sides_seen=tuple(map(str, entry["sides_seen"])),
    )


def _array(value: Any, *shape: int) -> Float:
    """Return an array of finite numbers of this shape. Raise ValueError for any other."""
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected {' x '.join(map(str, shape))} numbers")
    return array


# Fields: run, to (format), min_confidence, max_age_ms (null for any age), density (camera ->
# measured, filled -> before, after the thresholds: shares of the pixels), num_points, version
_RECORD = "export.yaml"


@dataclass(frozen=True)
class Export:
    """The written files, and the pixels and points within the thresholds."""

    paths: list[Path]  # paths of the files
    # Camera -> ``measured``, ``filled`` -> share of the pixels with a depth, for formats with maps
    density: Mapping[str, Mapping[str, Kept]]
    num_points: Kept | None = None  # number of points, for formats with a cloud


def export_run(
    run: Path,
    to: str,
    out: Path | None = None,
    *,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    cameras: Sequence[str] | None = None,
    overwrite: bool = False,
) -> Export:
    """Write a finished run in another format, from its files alone, and return what was written.

    Args:
        run: Folder of one key sweep, or of several for formats of whole drives.
        to: Name of a format in `densify.config.plugins.EXPORTS`.
        out: Folder to write into, None for ``RUN/export/FORMAT``.
        min_confidence: Least confidence of pixels and points, 0 to 1.
        max_age_ms: Greatest time from the measurement to the exposure (pixels) or the key sweep
            (points), None for any.
        cameras: Names of the cameras, None for all.
        overwrite: True to replace an earlier export.

    Raises:
        InputError: An argument is out of range or unknown, the run is damaged, or files exist.
    """
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")
    if to not in EXPORTS:
        hint = did_you_mean(to, EXPORTS)
        raise InputError(f"--to: got {to!r}, {hint}expected one of {', '.join(EXPORTS)}")
    form, thresholds = EXPORTS[to], Thresholds(min_confidence, max_age_ms, cameras)
    runs = finished_runs(run, thresholds) if form.of_drive else [FinishedRun(run, thresholds)]
    folder = out or run / "export" / to
    if (folder / "run.yaml").exists():
        raise InputError(f"--out {folder}: holds a run and is kept; choose another folder")
    module = import_module(f"densify.outputs.{form.module}")
    write = getattr(module, f"write_{to.replace('-', '_')}")
    with writing(folder, (*form.owned, _RECORD), folder, overwrite) as staging:
        write(runs if form.of_drive else runs[0], staging)
        counts = [run.num_points for run in runs if run.num_points is not None]
        num_points = Kept(*map(sum, zip(*counts, strict=True))) if counts else None
        export = Export([], runs[0].density if len(runs) == 1 else {}, num_points)
        record = {
            "run": str(run),
            "to": to,
            "min_confidence": float(min_confidence),
            "max_age_ms": max_age_ms,
            **facts(export),
            "version": __version__,
        }
        (staging / _RECORD).write_text(yaml.safe_dump(plain(record), sort_keys=False), "utf-8")
        files = sorted(path.relative_to(staging) for path in staging.rglob("*") if path.is_file())
    return replace(export, paths=[folder / path for path in files])


def facts(export: Export) -> dict[str, Any]:
    """Return the fields ``density`` and ``num_points`` of export.yaml, without unknown ones."""
    density = {
        camera: {product: kept._asdict() for product, kept in products.items()}
        for camera, products in export.density.items()
    }
    num_points = export.num_points and export.num_points._asdict()
    values = {"density": density, "num_points": num_points}
    return {name: value for name, value in values.items() if value}


def write_npy(run: FinishedRun, folder: Path) -> None:
    """Write each map as (H,W) float32 .npy: depth, depth_filled (metres, 0 none) and confidence."""
    for path, _, values in _maps(run, folder, ".npy"):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, values)


def write_exr(run: FinishedRun, folder: Path) -> None:
    """Write the maps of `write_npy` as 32-bit OpenEXR, channel Z for depth, Y for confidence."""
    for path, kind, values in _maps(run, folder, ".exr"):
        save_exr(path, "Y" if kind == "confidence" else "Z", values)


def save_exr(path: Path, channel: str, values: Float32) -> None:
    """Write (H,W) float32 as an OpenEXR file with one channel."""
    library = import_extra("OpenEXR", "exr", "EXR files")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    path.parent.mkdir(parents=True, exist_ok=True)
    library.File(header, {channel: values}).write(str(path))


def _maps(run: FinishedRun, folder: Path, suffix: str) -> Iterator[tuple[Path, str, Float32]]:
    """Yield the path to write, the kind and the values (H,W) of the three maps of each image."""
    for name in run.chosen_maps:
        maps = run.maps(name)
        for kind in ("depth", "depth_filled", "confidence"):
            values = (confidence_of if kind == "confidence" else metres)(maps[kind])
            yield map_path(folder, kind, name, suffix), kind, values


def write_ply(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.ply`` with every column of cloud.laz (`StoredCloud.columns`)."""
    save_ply(folder / "cloud.ply", run.cloud().columns())


def write_pcd(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.pcd``, binary PCD 0.7 with the same columns, colour as one float ``rgb``."""
    from pypcd4 import Encoding, PointCloud

    columns = run.cloud().columns()
    rgb = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    columns["rgb"] = PointCloud.encode_rgb(rgb)
    types = [column.dtype.type for column in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), types)
    cloud.save(folder / "cloud.pcd", Encoding.BINARY)
