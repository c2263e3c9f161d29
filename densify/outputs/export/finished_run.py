# SPDX-License-Identifier: MIT
"""A finished run's folder as exports read it, with what thresholds leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_json, read_yaml
from densify.geometry.types import Bool, CameraView, ObjectTrack
from densify.outputs.cloud_laz import StoredCloud, read_cloud
from densify.outputs.depth_png import read_stored, stored_age, stored_confidence
from densify.outputs.export.scene_file import SceneFile, read_scene
from densify.outputs.export.tracks_file import read_tracks

KINDS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
}


@dataclass(frozen=True)
class Density:
    """Fractions of the pixels that have a depth."""

    before: float
    after: float


@dataclass(frozen=True)
class Kept:
    """Numbers of points."""

    before: int
    after: int


class FinishedRun:
    """One key's folder. Parts are read when asked for; ``density`` (by camera and product) and
    ``num_points`` say what the thresholds left of those that were."""

    def __init__(
        self,
        folder: Path,
        min_confidence: float = 0.0,
        max_age_ms: float | None = None,
        chosen: Sequence[str] | None = None,
    ) -> None:
        """Thresholds as `densify.outputs.export.export_run`. chosen: cameras, all if None. Raises
        InputError if the folder holds no run."""
        if not (folder / "run.yaml").is_file():
            raise InputError(
                f"{folder}: no run.yaml in it; expected the folder of a finished run and key, such "
                f"as densify-out/000120"
            )
        self.folder = folder
        self.min_confidence = min_confidence
        self.max_age_ms = max_age_ms
        self._chosen = chosen
        self.density: dict[str, dict[str, Density]] = {}
        self.num_points: Kept | None = None

    @cached_property
    def key(self) -> int:
        """Its frame. Raises InputError where run.yaml does not say it."""
        path = self.folder / "run.yaml"
        record, _ = read_yaml(path)
        key = record.get("key") if isinstance(record, dict) else None
        if not isinstance(key, int):
            raise InputError(f"{path}: key: got {key!r}, expected a frame's number")
        return key

    @cached_property
    def cameras(self) -> list[str]:
        """The chosen cameras, or CAMERA/NUMBER of their images. Raises InputError if there are no
        maps of one, or not all four."""
        cameras = sorted(
            {
                path.relative_to(self.folder / product).with_suffix("").as_posix()
                for product in KINDS
                for path in (self.folder / product).rglob("*.png")
            }
        )
        if not cameras:
            raise InputError(f"{self.folder}: no depth maps in it; run densify with a camera first")
        there = {camera.partition("/")[0] for camera in cameras}
        for name in self._chosen or ():
            if name not in there:
                raise InputError(f"--camera {name}: expected one of {', '.join(sorted(there))}")
        if self._chosen is not None:
            cameras = [c for c in cameras if c.partition("/")[0] in self._chosen]
        paths = [self._map(product, camera) for camera in cameras for product in KINDS]
        missing = [str(p.relative_to(self.folder)) for p in paths if not p.is_file()]
        if missing:
            raise InputError(
                f"{self.folder}: {', '.join(missing)} missing; densify the key again (run "
                f"--overwrite)"
            )
        return cameras

    @cached_property
    def scene(self) -> SceneFile:
        """Raises InputError where scene.json is missing or damaged."""
        return read_scene(self.folder / "scene" / "scene.json")

    def measure(self, camera: str) -> str:
        """What a map's depth is, camera ``z`` or ``range``, as metrics.json says."""
        path = self.folder / "metrics.json"
        scores = read_json(path)
        measures = scores.get("measure") if isinstance(scores, dict) else None
        if not isinstance(measures, dict) or measures.get(camera) not in ("z", "range"):
            raise InputError(f"{path}: measure: does not say z or range of {camera}")
        return str(measures[camera])

    def maps(self, camera: str) -> dict[str, NDArray[Any]]:
        """(H,W) by product, as stored (`densify.outputs.depth_png`), 0 where a pixel is left out.
        Raises InputError for maps that are damaged or do not belong together."""
        maps = self._read_maps(camera)
        keep = maps["confidence"] >= stored_confidence(self.min_confidence)
        if self.max_age_ms is not None:
            keep &= maps["age"] <= stored_age(self.max_age_ms / 1000)
        self.density[camera] = {
            "measured": _density(maps["depth"], keep),
            "filled": _density(maps["depth_filled"], keep),
        }
        return {product: stored * keep for product, stored in maps.items()}

    @cached_property
    def chosen_views(self) -> dict[str, CameraView]:
        """Where the chosen cameras' maps look from."""
        return {name: view for name, view in self.scene.views.items() if name in self.cameras}

    @cached_property
    def tracks(self) -> list[ObjectTrack]:
        """Raises InputError where movers.json is missing or damaged, or lacks the key."""
        path = self.folder / "movers.json"
        tracks = read_tracks(path)
        for track in tracks:
            if self.key not in track.frames:
                raise InputError(f"{path}: object {track.instance} has no pose at key {self.key}")
        return tracks

    def check_no_thresholds(self, form: str) -> None:
        """Raise InputError if there are some, for forms that they say nothing of."""
        if self.min_confidence or self.max_age_ms is not None:
            raise InputError(
                f"--to {form}: holds neither pixels nor points; leave --min-confidence and "
                f"--max-age-ms out"
            )

    def mover_clouds(self) -> list[StoredCloud]:
        """What is left of the objects that the run has apart (``output.movers=separate``)."""
        return [self._points(path) for path in sorted(self.folder.glob("movers/*/cloud.laz"))]

    def cloud(self) -> StoredCloud:
        """The points that are left. Raises InputError for a cloud that is missing or damaged, or
        whose points' ages cannot be told."""
        return self._points(self.folder / "cloud.laz")

    def _points(self, path: Path) -> StoredCloud:
        cloud = read_cloud(path)
        keep = stored_confidence(cloud.confidence) >= stored_confidence(self.min_confidence)
        if self.max_age_ms is not None:
            age_s = np.abs(cloud.gps_time - self._key_gps_time)
            keep &= stored_age(age_s) <= stored_age(self.max_age_ms / 1000)
        before = self.num_points or Kept(0, 0)
        self.num_points = Kept(before.before + len(keep), before.after + int(keep.sum()))
        return cloud.select(keep)

    @cached_property
    def _key_gps_time(self) -> float:
        path = self.folder / "cloud.laz"
        cloud = read_cloud(path)
        own = cloud.gps_time[cloud.frame == self.key]
        if not len(own):
            raise InputError(
                f"{path}: has no point of the key sweep {self.key} to tell ages from; leave "
                f"--max-age-ms out"
            )
        return float(own[0])

    def _map(self, product: str, camera: str) -> Path:
        return self.folder / product / f"{camera}.png"

    def _read_maps(self, camera: str) -> dict[str, NDArray[Any]]:
        maps = {
            p: read_stored(self._map(p, camera), kind, f"a map of {p}") for p, kind in KINDS.items()
        }
        filled = maps["depth_filled"]
        for product, stored in maps.items():
            path = self._map(product, camera)
            if stored.shape != filled.shape:
                raise InputError(
                    f"{path}: got {stored.shape[1]} x {stored.shape[0]} px, expected "
                    f"{filled.shape[1]} x {filled.shape[0]} as in depth_filled; densify the key "
                    f"again"
                )
            strangers = (stored > 0) & (filled == 0)
            if product != "depth":
                strangers |= (stored == 0) & (filled > 0)
            if strangers.any():
                raise InputError(
                    f"{path}: does not belong to depth_filled, {np.count_nonzero(strangers)} "
                    f"pixels have a value in one of them only; densify the key again"
                )
        return maps


def finished_runs(
    folder: Path,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    chosen: Sequence[str] | None = None,
) -> list[FinishedRun]:
    """The run in a folder, or those of several keys in its subfolders, ascending. Arguments and
    errors as `FinishedRun`."""
    places = sorted(path.parent for path in folder.glob("*/run.yaml"))
    if (folder / "run.yaml").is_file() or not places:
        places = [folder]
    runs = [FinishedRun(place, min_confidence, max_age_ms, chosen) for place in places]
    return runs if len(runs) == 1 else sorted(runs, key=lambda run: run.key)


def _density(stored: NDArray[Any], keep: Bool) -> Density:
    has_depth = stored > 0
    return Density(float(has_depth.mean()), float((has_depth & keep).mean()))
