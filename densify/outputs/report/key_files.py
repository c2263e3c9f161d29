# SPDX-License-Identifier: MIT
"""What a run or a comparison left in a key's folder, as far as it is there and whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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
from densify.outputs.export.tracks_file import read_tracks
from densify.readers.decoded_files import decode_image

T = TypeVar("T")

_MAPS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "depth_full": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
}
_SCENE_MAPS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "truth": np.uint16,
    "sweep": np.uint16,
    "reason": np.uint8,
}
_NO_METHODS = {*_SCENE_MAPS, "image"}


@dataclass
class KeyFiles:
    """One key's files, read one after another; what cannot be read is noted in ``missing``, a
    sentence each.

    maps: the folder of depth maps, cloud and scene. about: run.yaml, or what compare.json says of
    the same. methods: method -> its scores, the last one that of the maps.
    """

    maps: Path
    about: Mapping[str, Any]
    methods: Mapping[str, Mapping[str, Any]]
    missing: list[str] = field(default_factory=list)

    @staticmethod
    def of_run(folder: Path) -> KeyFiles:
        """Raises InputError where there is no run, or its run.yaml is damaged."""
        path = folder / "run.yaml"
        if not path.is_file():
            raise InputError(
                f"{folder}: no run.yaml in it; expected the folder of a finished run and key, such "
                f"as densify-out/000120, of a comparison or of a training set"
            )
        about, _ = read_yaml(path)
        files = KeyFiles(folder, _mapping(about), {})
        if not files.about:
            files.missing.append("run.yaml: damaged, so nothing says how this was made")
        metrics = _mapping(files._tried(read_json, folder / "metrics.json") or {})
        method = str(files.about.get("method", "run"))
        files.methods = {**_mapping(metrics.get("baselines")), method: metrics}
        return files

    @staticmethod
    def of_comparison(folder: Path) -> KeyFiles:
        """Raises InputError where compare.json is missing or damaged."""
        about = _mapping(read_json(folder / "compare.json"))
        methods = {str(m): _mapping(s) for m, s in _mapping(about.get("methods")).items()}
        if not methods:
            raise InputError(f"{folder}/compare.json: names no methods; compare the key again")
        return KeyFiles(folder / "compare", about, methods)

    @property
    def method(self) -> str:
        """That of the maps."""
        return list(self.methods)[-1]

    def names(self) -> list[str]:
        """Cameras, or CAMERA/NUMBER, of which there is a depth map."""
        found = {
            path.relative_to(self.maps / kind).with_suffix("").as_posix()
            for kind in ("depth", "depth_filled")
            for path in (self.maps / kind).rglob("*.png")
        }
        return sorted(found)

    def camera(self, name: str) -> dict[str, NDArray[Any]]:
        """Maps of a camera by kind, (H,W) as stored: those of the run, of ``scene``, and by method
        the measured depth of the others."""
        others = {p.name for p in self._entries("scene") if p.is_dir()} - _NO_METHODS
        # In the methods' own order, which is that of the page's choices.
        ordered = [m for m in self.methods if m in others]
        places = {
            **{kind: (self.maps / kind, bits) for kind, bits in _MAPS.items()},
            **{kind: (self.maps / "scene" / kind, bits) for kind, bits in _SCENE_MAPS.items()},
            **{m: (self.maps / "scene" / m, np.uint16) for m in ordered},
        }
        maps: dict[str, NDArray[Any]] = {}
        for kind, (place, bits) in places.items():
            path = place / f"{name}.png"
            if not path.is_file():
                continue
            image = self._tried(lambda p: read_stored(p, bits, "a map"), path)  # noqa: B023
            if image is None:
                continue
            some = next(iter(maps.values()), image)
            if image.shape != some.shape:
                self.missing.append(f"{kind}/{name}.png: not as large as the others; left out")
                continue
            maps[kind] = image
        return maps

    def image(self, name: str) -> bytes | None:
        """The JPEG of the image, whole; None where there is none."""
        path = self.maps / "scene" / "image" / f"{name}.jpg"
        return self._tried(_checked_image, path) if path.is_file() else None

    def scene(self) -> Mapping[str, Any]:
        """scene.json, empty where there is none."""
        path = self.maps / "scene" / "scene.json"
        return _mapping(self._tried(read_json, path) or {}) if path.is_file() else {}

    def tracks(self) -> list[ObjectTrack]:
        """Where moving objects were, those with most points first."""
        path = self.maps / "movers.json"
        tracks = self._tried(read_tracks, path) if path.is_file() else None
        return sorted(tracks or (), key=lambda track: -int(track.num_points.sum()))

    def cloud(self) -> StoredCloud | None:
        """The accumulated cloud."""
        path = self.maps / "cloud.laz"
        if not path.is_file():
            self.missing.append("cloud.laz: not there, so there is no view in 3-D")
            return None
        return self._tried(read_cloud, path)

    def _tried(self, read: Callable[[Path], T], path: Path) -> T | None:
        try:
            return read(path)
        except InputError as error:
            self.missing.append(str(error).replace(f"{self.maps}/", ""))
            return None

    def _entries(self, name: str) -> Iterable[Path]:
        place = self.maps / name
        return sorted(place.iterdir()) if place.is_dir() else ()


def _checked_image(path: Path) -> bytes:
    data = read_bytes(path)
    decode_image(data, path)
    return data


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
