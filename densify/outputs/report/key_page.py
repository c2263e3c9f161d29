# SPDX-License-Identifier: MIT
"""Make the HTML page of one key sweep from the readable files of a run or a comparison."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json, read_yaml
from densify.geometry.types import ObjectTrack, Result
from densify.outputs.atomic import write_file
from densify.outputs.cloud_laz import read_cloud
from densify.outputs.depth_png import read_stored
from densify.outputs.export.finished_run import map_names
from densify.outputs.front_view import front_first
from densify.outputs.key_outputs import Context
from densify.outputs.report.page_file import Blobs, packed_camera, packed_cloud, page_file
from densify.outputs.scene_file import read_scene, read_tracks
from densify.readers.decoded_files import decode_image
from densify.version import __version__

T = TypeVar("T")
_MAPS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "depth_full": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
    "scene/truth": np.uint16,
    "scene/sweep": np.uint16,
    "scene/reason": np.uint8,
}


@dataclass
class KeyFiles:
    """The files of one key sweep."""

    maps: Path  # folder of depth maps, cloud and scene
    about: Mapping[str, Any]  # content of run.yaml, or the same fields of compare.json
    methods: Mapping[str, Mapping[str, Any]]  # method -> its scores. The last method made the maps.
    missing: list[str] = field(default_factory=list)  # a sentence for each file that cannot be read

    @staticmethod
    def of_run(folder: Path) -> KeyFiles:
        """Return the files of a run."""
        files = KeyFiles(folder, _mapping(read_yaml(folder / "run.yaml")[0]), {})
        metrics = _mapping(files.read(read_json, "metrics.json"))
        method = str(files.about.get("method", "run"))
        files.methods = {**_mapping(metrics.get("baselines")), method: metrics}
        return files

    @staticmethod
    def of_comparison(folder: Path) -> KeyFiles:
        """Return the files of a comparison. Raise InputError unless compare.json is whole."""
        about = _mapping(read_json(folder / "compare.json"))
        methods = {str(m): _mapping(s) for m, s in _mapping(about.get("methods")).items()}
        if not methods:
            raise InputError(f"{folder}/compare.json: names no methods; compare the key again")
        return KeyFiles(folder / "compare", about, methods)

    def read(self, read: Callable[[Path], T], name: str, optional: bool = False) -> T | None:
        """Return a file's content by a function of its path; note it in ``missing`` if damaged."""
        path = self.maps / name
        if optional and not path.is_file():
            return None
        try:
            return read(path)
        except InputError as error:
            self.missing.append(str(error).replace(f"{self.maps}/", ""))
            return None

    def camera(self, name: str) -> dict[str, NDArray[Any]]:
        """Return kind or name of a baseline -> (H,W) stored values of a map and its scene."""
        maps: dict[str, NDArray[Any]] = {}
        of_methods = {f"scene/{method}": np.uint16 for method in self.methods}
        for place, bits in {**_MAPS, **of_methods}.items():
            stored = partial(read_stored, kind=bits, what="a map")
            image = self.read(stored, f"{place}/{name}.png", optional=True)
            kind = place.removeprefix("scene/")
            if image is not None and maps and image.shape != next(iter(maps.values())).shape:
                self.missing.append(f"{kind}/{name}.png: not as large as the others; left out")
            elif image is not None:
                maps[kind] = image
        return maps

    def image(self, name: str) -> bytes | None:
        """Return the JPEG bytes of the image of a map, None if the run has no image."""

        def jpeg(path: Path) -> bytes:
            decode_image(data := read_bytes(path), path)
            return data

        return self.read(jpeg, f"scene/image/{name}.jpg", optional=True)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def write_report(result: Result, context: Context, folder: Path) -> None:
    """Write ``report.html`` from the files of the other outputs, if ``output.report`` is set."""
    if context.config.get("output", {}).get("report"):
        page = key_page(KeyFiles.of_run(folder), f"{result.key:06d}")
        write_file(folder / "report.html", page)


def key_page(files: KeyFiles, folder: str) -> bytes:
    """Return the HTML page. ``folder`` is the run's, as the user names it, "" for a comparison."""
    scene = files.read(read_scene, "scene/scene.json", optional=True)
    views, sweeps = (scene.table["views"], scene.table["sweeps"]) if scene else ({}, [])
    focal_px = {name: view.camera.focal_px for name, view in (scene.views if scene else {}).items()}
    blobs, cameras = Blobs(), {}
    names = map_names(files.maps / "depth", files.maps / "depth_filled")
    for name in front_first(names, scene.views, scene.T_key_lidar) if scene else names:
        if maps := files.camera(name):
            cameras[name] = packed_camera(blobs, maps, files.image(name), focal_px.get(name))
    stored = files.read(read_cloud, "cloud.laz")
    if not cameras and stored is None:
        raise InputError(f"{files.maps}: no depth map and no cloud in it that can be read")
    tracks = files.read(read_tracks, "movers.json", optional=True) or []
    tracks.sort(key=lambda track: -int(track.num_points.sum()))
    about, methods = files.about, list(files.methods)
    key, data = about.get("key"), str(about.get("data"))
    name = data.rstrip("/").rpartition("/")[2] or data
    page = {
        "subtitle": f"{name}, key {key}",
        "footer": f"densify {__version__}; this file needs nothing but itself.",
        "folder": shlex.quote(folder) if folder else "",
        "key": key,
        "method": methods[-1],
        "methods": files.methods,
        "cameras": cameras,
        "views": views,
        "sweeps": sweeps,
        "movers": [_mover(track, key) for track in tracks],
        "cloud": None,
        "about": {"stages": about.get("stages")},
        "warnings": [str(w) for w in about.get("warnings") or ()],
        "missing": files.missing,
    }
    if stored is not None and len(stored.points):
        instances = [track.instance for track in tracks]
        frames = [sweep["frame"] for sweep in sweeps]
        page["cloud"] = packed_cloud(blobs, stored, frames, instances)
    title = f"{name}, key {key}" + ("" if folder else f": {', '.join(methods)}")
    return page_file(title, page, blobs)


def _mover(track: ObjectTrack, key: Any) -> dict[str, Any]:
    at = track.frames.index(key)
    places_m = track.T_key_object[:, :3, 3]
    path = zip(track.frames, places_m, strict=True)
    return {
        "instance": track.instance,
        "num_points": track.num_points.sum(),
        "centre_m": places_m[at],
        "size_m": track.size_m,
        "velocity_m_s": track.velocity_m_s[at],
        "path": [{"frame": frame, "position_m": place_m} for frame, place_m in path],
    }
