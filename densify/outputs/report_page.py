# SPDX-License-Identifier: MIT
"""Make the HTML page of one key sweep, one file, from the files of a run or a comparison."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import shlex
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json, read_yaml
from densify.geometry.types import Bool, Float, Int, ObjectTrack
from densify.outputs.cloud_files import StoredCloud, read_cloud
from densify.outputs.depth_png import PixelType, read_stored
from densify.outputs.finished_run import map_names, read_scene, read_tracks
from densify.outputs.folders import mapping_or_empty, plain, write_file
from densify.outputs.plots import order_front_first
from densify.readers.decoded_files import decode_image
from densify.scores.metrics import LEAST_PIXELS
from densify.version import __version__

T = TypeVar("T")
PAGES = {"run.yaml": "report.html", "compare.json": "compare.html"}
"""File that records a run or a comparison of a key -> file of its page."""
_MAPS: Mapping[str, PixelType] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "depth_full": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
    "scene/truth": np.uint16,
    "scene/sweep": np.uint16,
    "scene/reason": np.uint8,
}
_SCRIPTS = (
    *("unpack.js", "dom.js", "colours.js", "maps.js", "matrices.js", "gl.js", "cloud.js"),
    *("scores.js", "key.js"),
)
_COLOUR_MAPS = ("viridis", "cividis", "inferno", "turbo")
_TRIAL_EFFORT, _EFFORT = 1, 7  # effort of compression, for the comparison and for the page
_SOURCE_BITS = 17  # bits of a pixel's code below its sweep: age (16), and measured or filled (1)
_MAX_UINT16 = 65535
_ZERO_DISPLACED = 32768  # stored value of a displacement of 0, the middle of 16 bits
_MOST_POINTS = 500_000
_CONFIDENCE_STEPS = 31
_GRAY = 50, 190  # gray of reflectance 0 and 1, for points without colour
_COLOUR_BITS = 2  # bits of a colour that are dropped, of 8
_NEAR_M, _MOVING_WEIGHT = 4.0, 100.0  # for the thinning of the cloud


@dataclass
class KeyFiles:
    """The files of one key sweep."""

    maps: Path  # folder of depth maps, cloud and scene
    about: Mapping[str, Any]  # content of run.yaml, or the same fields of compare.json
    methods: Mapping[str, Mapping[str, Any]]  # method -> its scores. The last method made the maps.
    missing: list[str] = field(default_factory=list)  # a sentence for each file that cannot be read

    @staticmethod
    def of_run(folder: Path) -> KeyFiles:
        """Return the files of one key's run in ``folder``, its own method as the last method.

        Other files that cannot be read are noted in ``missing``.

        Raises:
            InputError: There is no readable run.yaml.
        """
        files = KeyFiles(folder, mapping_or_empty(read_yaml(folder / "run.yaml")[0]), {})
        metrics = mapping_or_empty(files.read(read_json, "metrics.json"))
        method = str(files.about.get("method", "run"))
        files.methods = {**mapping_or_empty(metrics.get("baselines")), method: metrics}
        return files

    @staticmethod
    def of_comparison(folder: Path) -> KeyFiles:
        """Return the files of a comparison. Raise InputError unless compare.json is whole."""
        about = mapping_or_empty(read_json(folder / "compare.json"))
        methods = {
            str(method): mapping_or_empty(scores)
            for method, scores in mapping_or_empty(about.get("methods")).items()
        }
        if not methods:
            raise InputError(f"{folder}/compare.json: names no methods; compare the key again")
        return KeyFiles(folder / "compare", about, methods)

    def read(self, read: Callable[[Path], T], name: str, optional: bool = False) -> T | None:
        """Return what ``read`` makes of a file in the folder, or None for an unreadable file.

        A file that cannot be read is noted in ``missing``, unless ``optional`` and it does not
        exist.
        """
        path = self.maps / name
        if optional and not path.is_file():
            return None
        try:
            return read(path)
        except InputError as error:
            self.missing.append(str(error).replace(f"{self.maps}/", ""))
            return None

    def camera(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the stored values (H,W) of a camera's maps, by `_MAPS` kind or baseline name."""
        maps: dict[str, NDArray[Any]] = {}
        maps_of_methods = {f"scene/{method}": np.uint16 for method in self.methods}
        for folder, pixel_type in {**_MAPS, **maps_of_methods}.items():
            stored = partial(read_stored, kind=pixel_type, map_name="a map")
            image = self.read(stored, f"{folder}/{name}.png", optional=True)
            kind = folder.removeprefix("scene/")
            if image is not None and maps and image.shape != next(iter(maps.values())).shape:
                self.missing.append(f"{kind}/{name}.png: not as large as the others; left out")
            elif image is not None:
                maps[kind] = image
        return maps


def _jpeg(path: Path) -> bytes:
    """Return the bytes of an image file that can be decoded."""
    decode_image(data := read_bytes(path), path)
    return data


def key_page(files: KeyFiles, shown_folder: str) -> bytes:
    """Return the bytes of the HTML page of a key sweep.

    ``shown_folder`` is the run's folder as the user names it, "" for a comparison. Files that
    cannot be read are named in the page.
    """
    scene = files.read(read_scene, "scene/scene.json", optional=True)
    views, sweeps = (scene.table["views"], scene.table["sweeps"]) if scene else ({}, [])
    tracks = files.read(read_tracks, "movers.json", optional=True) or []
    tracks.sort(key=lambda track: -int(track.num_points.sum()))

    # Maps, then the cloud
    blobs = Blobs()
    cameras = {}
    names = map_names(files.maps / "depth", files.maps / "depth_filled")
    for name in order_front_first(names, scene.views, scene.T_key_lidar) if scene else names:
        if maps := files.camera(name):
            view = scene.views.get(name) if scene else None
            focal_px = view.camera.focal_px if view else None
            cameras[name] = {"focal_px": focal_px, **_packed_camera(blobs, maps)}
            if (jpeg := files.read(_jpeg, f"scene/image/{name}.jpg", optional=True)) is not None:
                cameras[name]["image"] = {"blob": blobs.keep(jpeg), "mime": "image/jpeg"}
    cloud, packed_points = files.read(read_cloud, "cloud.laz"), None
    if not cameras and cloud is None:
        raise InputError(f"{files.maps}: no depth map and no cloud in it that can be read")
    if cloud is not None and len(cloud.points):
        frames = [sweep["frame"] for sweep in sweeps]
        packed_points = pack_cloud(blobs, cloud, frames, [track.instance for track in tracks])

    about, methods = files.about, list(files.methods)
    key, data = about.get("key"), str(about.get("data"))
    name = data.rstrip("/").rpartition("/")[2] or data
    page = {
        "subtitle": f"{name}, key {key}",
        "footer": f"densify {__version__}; this file needs nothing but itself.",
        "folder": shlex.quote(shown_folder) if shown_folder else "",
        "key": key,
        "least_pixels": LEAST_PIXELS,
        "method": methods[-1],
        "methods": files.methods,
        "cameras": cameras,
        "views": views,
        "sweeps": sweeps,
        "movers": [_mover(track, key) for track in tracks],
        "cloud": packed_points,
        "about": {"stages": about.get("stages"), "elapsed_s": about.get("elapsed_s")},
        "warnings": [str(warning) for warning in about.get("warnings") or ()],
        "missing": files.missing,
    }
    title = f"{name}, key {key}" + ("" if shown_folder else f": {', '.join(methods)}")
    return page_file(title, page, blobs)


def _mover(track: ObjectTrack, key: Any) -> dict[str, Any]:
    """Return the entry of a moving object in the page."""
    row, positions_m = track.frames.index(key), track.T_key_object[:, :3, 3]
    path = zip(track.frames, positions_m, strict=True)
    return {
        "instance": track.instance,
        "num_points": track.num_points.sum(),
        "centre_m": positions_m[row],
        "size_m": track.size_m,
        "velocity_m_s": track.velocity_m_s[row],
        "path": [{"frame": frame, "position_m": position_m} for frame, position_m in path],
    }


# The page uses WebGL2 and the browser's own inflate: a copy of three.js would add 700 kB.
class Blobs:
    """Collect the packed arrays of a page, which ``page/unpack.js`` unpacks."""

    def __init__(self) -> None:
        # Name -> bytes sorted by significance, deflated, in base64. A browser would decode a 16-bit
        # PNG to 8 bits.
        self.texts: dict[str, str] = {}

    def add(self, array: NDArray[Any]) -> dict[str, Any]:
        """Pack integers from 0 to 2^32 - 1, and return the description with which the page unpacks.

        It has ``blob``, ``bytes`` of an element, ``shape``, and ``delta``, True if differences
        along the last axis are stored because they are smaller.
        """
        array = array.astype(np.min_scalar_type(int(array.max(initial=0))))
        steps = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        plain_size, step_size = (len(_deflated(values, _TRIAL_EFFORT)) for values in (array, steps))
        is_delta = step_size < plain_size
        return {
            "blob": self.keep(_deflated(steps if is_delta else array, _EFFORT)),
            "bytes": array.dtype.itemsize,
            "shape": list(array.shape),
            "delta": is_delta,
        }

    def keep(self, data: bytes) -> str:
        """Store bytes unchanged and return the name of their blob."""
        name = f"blob-{len(self.texts)}"
        self.texts[name] = base64.b64encode(data).decode()
        return name


def _deflated(array: NDArray[Any], effort: int) -> bytes:
    """Return an array as bytes sorted by significance, compressed."""
    values = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    planes = values.view(np.uint8).reshape(-1, array.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), effort)


def _packed_camera(blobs: Blobs, maps: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Pack the maps of `KeyFiles.camera` into ``blobs`` and return the camera's entry."""
    nothing = np.zeros_like(next(iter(maps.values())), np.uint16)
    depth, filled, sweep, age = (
        maps.pop(kind, nothing) for kind in ("depth", "depth_filled", "sweep", "age")
    )
    shown = {kind: maps.pop(kind) for kind in ("confidence", "reason", "truth") if kind in maps}
    measured = depth > 0
    codes = (sweep.astype(np.int64) << _SOURCE_BITS) | (age.astype(np.int64) << 1) | measured
    known, source = np.unique(codes, return_inverse=True)
    return {
        "filled": blobs.add(np.where(measured, depth, filled)),
        "source": blobs.add(source.reshape(codes.shape)),
        "sources": np.stack([known >> _SOURCE_BITS, (known >> 1) & _MAX_UINT16, known & 1], axis=1),
        "density": {"measured": np.mean(measured), "filled": np.mean(filled > 0)},
        "others": {kind: blobs.add(values) for kind, values in maps.items()},
        **{kind: blobs.add(values) for kind, values in shown.items()},
    }


def pack_cloud(
    blobs: Blobs, cloud: StoredCloud, frames: Sequence[int], instances: Sequence[int]
) -> dict[str, Any]:
    """Pack a thinned cloud into ``blobs`` and return its entry in the page, moving points first.

    ``frames`` are the sweeps of the page, ``instances`` the numbers of its tracked objects.
    Positions are ``low_m`` + ``step_m`` times 16-bit integers. ``sweep`` has indices in ``frames``.
    ``mover`` is 0 for static points, 1 for moving points without a track, 2 and up for tracked
    objects by ``instances``. ``displaced``, for moving points only, is 32768 plus the displacement
    beyond rigid alignment in steps of ``displaced_step_m``.
    """
    rows = thin_cloud(cloud.points, cloud.moving, _MOST_POINTS)
    chosen = cloud.select(rows[np.argsort(~cloud.moving[rows], kind="stable")])
    low = chosen.points.min(axis=0, initial=0.0)
    size_m = max((chosen.points - low).max(initial=0.0), 1e-3)  # above 0 for a single point
    step_m = float(size_m / _MAX_UINT16)
    positions = np.rint((chosen.points - low) / step_m)
    num_moving = int(chosen.moving.sum())
    movers = _numbers(chosen.instance, [-1, *instances]) + 1
    displaced_step_m = float(np.abs(chosen.displacement).max(initial=1.0)) / (_ZERO_DISPLACED - 1)
    displaced = np.rint(chosen.displacement[:num_moving] / displaced_step_m) + _ZERO_DISPLACED
    return {
        "num_points": len(rows),
        "num_all": len(cloud.points),
        "num_moving": num_moving,
        "low_m": low,
        "step_m": step_m,
        "places": [blobs.add(column) for column in positions.T],
        "rgb": [blobs.add(column) for column in _colours(chosen).T],
        "sweep": blobs.add(_numbers(chosen.frame, frames)),
        "mover": blobs.add(np.where(chosen.moving, movers, 0)),
        "confidence": blobs.add(np.rint(_CONFIDENCE_STEPS * chosen.confidence)),
        "confidence_steps": _CONFIDENCE_STEPS,
        "displaced": [blobs.add(column) for column in displaced.T],
        "displaced_step_m": displaced_step_m,
    }


def thin_cloud(points: Float, moving: Bool, max_points: int) -> Int:
    """Return at most ``max_points`` ascending indices (K,), mostly of far or moving points."""
    if len(points) <= max_points:
        return np.arange(len(points))
    # Near points are dense: their weight falls with the squared range. Exponential variables over
    # the weights, sorted, draw points without replacement.
    weight = np.maximum((points**2).sum(axis=1), _NEAR_M**2)
    weight[moving] *= _MOVING_WEIGHT
    order = np.argsort(np.random.default_rng(0).exponential(size=len(points)) / weight)
    return np.sort(order[:max_points])


def _colours(cloud: StoredCloud) -> NDArray[np.uint8]:
    """Return colours (N,3) of 64 levels, gray by reflectance for points that no camera observed."""
    dark, bright = _GRAY
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity, 0, 1))
    rgb = np.where(cloud.observed[:, None], cloud.rgb, gray[:, None]).astype(np.uint8)
    return rgb >> np.uint8(_COLOUR_BITS)


def _numbers(values: NDArray[np.int32], known: Sequence[int]) -> Int:
    """Return the index of each value (N,) in the list ``known``, or 0 for an unknown value."""
    number_of = {value: number for number, value in enumerate(known)}
    return np.array([number_of.get(value, 0) for value in values.tolist()], np.int64)


def page_file(title: str, data: Mapping[str, Any], blobs: Blobs) -> bytes:
    """Return the bytes of a whole HTML page.

    Its script reads ``data`` as ``page``, of types that `plain` accepts, and unpacks ``blobs``, to
    which ``data`` refers by name.
    """
    script, style = "\n".join(map(_source, _SCRIPTS)), _source("page.css")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; "
        f"img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    texts = (
        f'<script type="text/plain" id="{name}">{text}</script>'
        for name, text in blobs.texts.items()
    )
    parts = {
        "csp": policy,
        "title": html.escape(title),
        "style": style,
        "script": script,
        "data": _json({**data, "palettes": _palettes()}),
        "blobs": "\n".join(texts),
    }
    return fill_template("key.html", parts)


def fill_template(name: str, parts: Mapping[str, str]) -> bytes:
    """Return the bytes of a file of the folder ``page`` with ``parts`` for each {{NAME}}."""
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _source(name))
    return filled.encode("utf-8", "backslashreplace")


def _source(name: str) -> str:
    """Return the text of a file of the folder ``page``."""
    return (package_files("densify.outputs") / "page" / name).read_text("utf-8")


def _hash(text: str) -> str:
    """Return the hash that names an inline script in the content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: Mapping[str, Any]) -> str:
    """Return JSON text that cannot close its HTML script element."""
    text = json.dumps(plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028]", lambda match: f"\\u{ord(match[0]):04x}", text)


def _palettes() -> dict[str, str]:
    """Return the name of each colour map -> 256 RGB colours in base64."""
    palettes, levels = {}, np.arange(256, dtype=np.uint8)
    for name in _COLOUR_MAPS:
        bgr = cv2.applyColorMap(levels, getattr(cv2, f"COLORMAP_{name.upper()}"))
        palettes[name] = base64.b64encode(bgr.reshape(256, 3)[:, ::-1].tobytes()).decode()
    return palettes


def write_key_page(folder: Path, source: str) -> Path:
    """Write the page of a key sweep from the file that records its run or comparison."""
    is_run, page = source == "run.yaml", folder / PAGES[source]
    files = KeyFiles.of_run(folder) if is_run else KeyFiles.of_comparison(folder)
    write_file(page, key_page(files, str(folder) if is_run else ""))
    return page
