# SPDX-License-Identifier: MIT
"""The page of one key: a run's or a comparison's."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from typing import Any

from densify import __version__
from densify.config.errors import InputError
from densify.geometry.types import ObjectTrack
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.report.key_files import KeyFiles, mapping
from densify.outputs.report.page_data import packed_camera, packed_cloud
from densify.outputs.report.page_file import Blobs, page_file

MOST_BYTES = 12_000_000
_MOST_FOR_MAPS = 7_500_000
_COARSEST = 8
_MOST_POINTS, _FEWEST_POINTS = 500_000, 10_000
_OF_THE_PAGE = 300_000  # scores, scripts
_SCRIPTS = (
    *("unpack.js", "dom.js", "colours.js", "maps.js", "matrices.js", "gl.js", "cloud.js"),
    *("scores.js", "key.js"),
)


def key_page(files: KeyFiles, folder: str) -> bytes:
    """Return the page, 12 MB at most.

    files: of the key. folder: of a run, as the user names it; "" of a comparison. Maps and points
    that are too many are thinned, and the page says it. Raises InputError if there is neither a
    depth map nor a cloud.
    """
    scene = files.scene()
    cameras, blobs = _cameras(files, mapping(scene.get("views")))
    stored = files.cloud()
    if not cameras and stored is None:
        raise InputError(f"{files.maps}: no depth map and no cloud in it that can be read")
    about, methods = files.about, list(files.methods)
    sweeps = _sweeps(scene)
    movers = [_mover(track, about.get("key")) for track in files.tracks()]
    key, data = about.get("key"), str(about.get("data"))
    name = data.rstrip("/").rpartition("/")[2] or data
    compared = not folder
    title = f"{name}, key {key}" + (f": {', '.join(methods)}" if compared else "")
    page = {
        "title": title,
        "subtitle": f"{name}, key {key}",
        "footer": f"densify {__version__}; this file needs nothing but itself.",
        "folder": shlex.quote(folder) if folder else "",
        "key": key,
        "method": methods[-1] if methods else "",
        "methods": files.methods,
        "cameras": cameras,
        "views": mapping(scene.get("views")),
        "sweeps": sweeps,
        "movers": movers,
        "cloud": _cloud(blobs, stored, sweeps, movers) if stored is not None else None,
        "about": {"stages": about.get("stages")},
        "warnings": [str(w) for w in about.get("warnings") or ()],
        "missing": files.missing,
    }
    return page_file("key.html", _SCRIPTS, title, page, blobs)


def _cameras(files: KeyFiles, views: Mapping[str, Any]) -> tuple[dict[str, Any], Blobs]:
    """Return all cameras, with as many of their pixels as there is room for."""
    loaded = {name: (files.camera(name), files.image(name)) for name in files.names()}
    loaded = {name: some for name, some in loaded.items() if some[0]}
    every = 1
    while True:
        blobs = Blobs()
        cameras = {
            name: packed_camera(blobs, maps, jpeg, mapping(views.get(name)), every)
            for name, (maps, jpeg) in loaded.items()
        }
        if blobs.num_bytes <= _MOST_FOR_MAPS or every == _COARSEST:
            return cameras, blobs
        every = min(_COARSEST, math.ceil(every * math.sqrt(blobs.num_bytes / _MOST_FOR_MAPS)))


def _cloud(
    blobs: Blobs, stored: StoredCloud, sweeps: list[dict[str, Any]], movers: list[dict[str, Any]]
) -> dict[str, Any] | None:
    """Return the cloud, with as many of its points as there is room for. None if it is empty."""
    if not len(stored.points):
        return None
    frames, instances = [s["frame"] for s in sweeps], [m["instance"] for m in movers]
    room, most = MOST_BYTES - _OF_THE_PAGE - blobs.num_bytes, _MOST_POINTS
    while True:
        own = Blobs(first=len(blobs.texts))
        cloud = packed_cloud(own, stored, frames, instances, most)
        if own.num_bytes <= room or most == _FEWEST_POINTS:
            blobs.texts |= own.texts
            return cloud
        most = max(_FEWEST_POINTS, int(0.95 * most * room / own.num_bytes))


def _sweeps(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    sweeps = scene.get("sweeps")
    is_whole = isinstance(sweeps, list) and all("frame" in mapping(sweep) for sweep in sweeps)
    return list(sweeps) if is_whole and sweeps else []


def _mover(track: ObjectTrack, key: Any) -> dict[str, Any]:
    at = track.frames.index(key) if key in track.frames else len(track.frames) // 2
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
