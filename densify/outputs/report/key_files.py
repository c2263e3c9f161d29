# SPDX-License-Identifier: MIT
"""The files of a run or a comparison in a key's folder, as far as they are there and whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json, read_yaml
from densify.geometry.types import ObjectTrack
from densify.outputs.cloud_laz import StoredCloud, read_cloud
from densify.outputs.depth_png import read_stored
from densify.outputs.scene_file import read_tracks
from densify.readers.decoded_files import decode_image

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
    """One key's files. What cannot be read is noted in ``missing``, a sentence each.

    maps: the folder of depth maps, cloud and scene.
    about: content of run.yaml, or what compare.json says of the same.
    methods: method -> its scores, the last one that of the maps.
    """

    maps: Path
    about: Mapping[str, Any]
    methods: Mapping[str, Mapping[str, Any]]
    missing: list[str] = field(default_factory=list)

    @staticmethod
    def of_run(folder: Path) -> KeyFiles:
        """Raises InputError if there is no run, or its run.yaml is damaged."""
        path = folder / "run.yaml"
        if not path.is_file():
            raise InputError(
                f"{folder}: no run.yaml in it; expected the folder of a finished run and key, such "
                f"as densify-out/000120, of a comparison or of a training set"
            )
        files = KeyFiles(folder, mapping(read_yaml(path)[0]), {})
        if not files.about:
            files.missing.append("run.yaml: damaged, nothing says how this was made")
        metrics = mapping(files._tried(read_json, folder / "metrics.json"))
        method = str(files.about.get("method", "run"))
        files.methods = {**mapping(metrics.get("baselines")), method: metrics}
        return files

    @staticmethod
    def of_comparison(folder: Path) -> KeyFiles:
        """Raises InputError if compare.json is missing or damaged."""
        about = mapping(read_json(folder / "compare.json"))
        methods = {str(m): mapping(s) for m, s in mapping(about.get("methods")).items()}
        if not methods:
            raise InputError(f"{folder}/compare.json: names no methods; compare the key again")
        return KeyFiles(folder / "compare", about, methods)

    def names(self) -> list[str]:
        """Return the depth maps: CAMERA, or CAMERA/NUMBER of one of its images."""
        found = {
            path.relative_to(self.maps / kind).with_suffix("").as_posix()
            for kind in ("depth", "depth_filled")
            for path in (self.maps / kind).rglob("*.png")
        }
        return sorted(found)

    def camera(self, name: str) -> dict[str, NDArray[Any]]:
        """Return kind -> (H,W) as stored: maps of the run and of its scene, and by method the
        measured depth of the baselines."""
        places = {**_MAPS, **{f"scene/{method}": np.uint16 for method in self.methods}}
        maps: dict[str, NDArray[Any]] = {}
        for place, bits in places.items():
            path, kind = self.maps / place / f"{name}.png", place.removeprefix("scene/")
            if not path.is_file():
                continue
            image = self._tried(lambda p: read_stored(p, bits, "a map"), path)  # noqa: B023
            if image is None:
                continue
            if maps and image.shape != next(iter(maps.values())).shape:
                self.missing.append(f"{kind}/{name}.png: not as large as the others; left out")
                continue
            maps[kind] = image
        return maps

    def image(self, name: str) -> bytes | None:
        """Return the JPEG of a map's image, None if there is none."""
        path = self.maps / "scene" / "image" / f"{name}.jpg"
        if (
            not path.is_file()
            or self._tried(lambda p: decode_image(read_bytes(p), p), path) is None
        ):
            return None
        return read_bytes(path)

    def scene(self) -> Mapping[str, Any]:
        """Return the content of scene.json, empty if there is none."""
        path = self.maps / "scene" / "scene.json"
        return mapping(self._tried(read_json, path)) if path.is_file() else {}

    def tracks(self) -> list[ObjectTrack]:
        """Return the tracked objects, those with most points first."""
        path = self.maps / "movers.json"
        tracks = self._tried(read_tracks, path) if path.is_file() else None
        return sorted(tracks or (), key=lambda track: -int(track.num_points.sum()))

    def cloud(self) -> StoredCloud | None:
        """Return the accumulated cloud, None if there is none."""
        path = self.maps / "cloud.laz"
        if not path.is_file():
            self.missing.append("cloud.laz: not there, no view in 3-D")
            return None
        return self._tried(read_cloud, path)

    def _tried(self, read: Callable[[Path], T], path: Path) -> T | None:
        try:
            return read(path)
        except InputError as error:
            self.missing.append(str(error).replace(f"{self.maps}/", ""))
            return None


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a mapping from a file, an empty one for anything else."""
    return value if isinstance(value, dict) else {}
