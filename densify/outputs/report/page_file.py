# SPDX-License-Identifier: MIT
"""Write one HTML file with data, script and style. It opens from disk and loads no other file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Int
from densify.outputs.atomic import plain
from densify.outputs.cloud_laz import StoredCloud

_SCRIPTS = (
    *("unpack.js", "dom.js", "colours.js", "maps.js", "matrices.js", "gl.js", "cloud.js"),
    *("scores.js", "key.js"),
)
_COLOUR_MAPS = {
    "viridis": cv2.COLORMAP_VIRIDIS,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "turbo": cv2.COLORMAP_TURBO,
}
_NOT_OF_METHODS = {"depth", "depth_filled", "confidence", "age", "sweep", "reason", "truth"}
_TRIAL_LEVEL, _LEVEL = 1, 7
_LEVELS = 65535
_MOST_POINTS = 500_000
_CONFIDENCE_STEPS = 31
_GRAY = 50, 190  # gray of reflectance 0 and 1, for points without colour
_NEAR_M, _MOVING_WEIGHT = 4.0, 100.0


# The page uses WebGL2 and the browser's own inflate: a copy of three.js would add 700 kB.
class Blobs:
    """Collect the packed arrays of a page, which ``page/unpack.js`` unpacks."""

    def __init__(self) -> None:
        # Name -> bytes sorted by significance, deflated, base64; 16-bit PNG would come as 8 bits.
        self.texts: dict[str, str] = {}

    def add(self, array: NDArray[Any]) -> dict[str, Any]:
        """Pack integers (N,) or (H,W), 0 to 2^32, and return how the page unpacks them.

        They are stored directly or as differences along the last axis, whichever is smaller.
        """
        array = array.astype(np.min_scalar_type(int(array.max(initial=0))))
        steps = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        plain_size, step_size = (len(_deflated(v, _TRIAL_LEVEL)) for v in (array, steps))
        is_delta = step_size < plain_size
        return {
            "blob": self._keep(_deflated(steps if is_delta else array, _LEVEL)),
            "bytes": array.dtype.itemsize,
            "shape": list(array.shape),
            "delta": is_delta,
        }

    def add_file(self, data: bytes, mime: str) -> dict[str, Any]:
        """Add an image file unchanged and return its description."""
        return {"blob": self._keep(data), "mime": mime}

    def _keep(self, data: bytes) -> str:
        name = f"blob-{len(self.texts)}"
        self.texts[name] = base64.b64encode(data).decode()
        return name


def _deflated(array: NDArray[Any], level: int) -> bytes:
    values = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    planes = values.view(np.uint8).reshape(-1, array.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), level)


def packed_camera(
    blobs: Blobs,
    maps: Mapping[str, NDArray[Any]],
    jpeg: bytes | None,
    focal_px: float | None,
) -> dict[str, Any]:
    """Pack the maps of `KeyFiles.camera` into ``blobs`` and return the camera's entry in the page.

    The map ``source`` has indices into ``sources``, whose rows are [index of the sweep + 1, age in
    ms + 1, measured 0 or 1], 0 where unknown.
    """
    nothing = np.zeros_like(next(iter(maps.values())), np.uint16)
    depth, filled, sweep, age = (
        maps.get(kind, nothing) for kind in ("depth", "depth_filled", "sweep", "age")
    )
    measured = depth > 0
    codes = (sweep.astype(np.int64) << 17) | (age.astype(np.int64) << 1) | measured
    known, source = np.unique(codes, return_inverse=True)
    entry: dict[str, Any] = {
        "focal_px": focal_px,
        "filled": blobs.add(np.where(measured, depth, filled)),
        "source": blobs.add(source.reshape(codes.shape)),
        "sources": np.stack([known >> 17, (known >> 1) & 0xFFFF, known & 1], axis=1),
        "density": {"measured": np.mean(measured), "filled": np.mean(filled > 0)},
        "others": {k: blobs.add(m) for k, m in maps.items() if k not in _NOT_OF_METHODS},
    }
    entry |= {k: blobs.add(maps[k]) for k in ("confidence", "reason", "truth") if k in maps}
    if jpeg is not None:
        entry["image"] = blobs.add_file(jpeg, "image/jpeg")
    return entry


def packed_cloud(
    blobs: Blobs, cloud: StoredCloud, frames: Sequence[int], instances: Sequence[int]
) -> dict[str, Any]:
    """Pack a thinned cloud into ``blobs`` and return its entry in the page, moving points first.

    Positions are ``low_m`` + ``step_m`` times 16-bit integers. ``sweep`` has indices in ``frames``.
    ``mover`` is 0 for static points, 1 for moving points without a track, 2 and up for tracked
    objects, by ``instances``. ``displaced``, for moving points only, is 32768 plus the displacement
    beyond rigid alignment in steps of ``displaced_step_m``.
    """
    rows = thinned(cloud.points, cloud.moving, _MOST_POINTS)
    chosen = cloud.select(rows[np.argsort(~cloud.moving[rows], kind="stable")])
    low = chosen.points.min(axis=0, initial=0.0)
    step_m = float(max((chosen.points - low).max(initial=0.0), 1e-3) / _LEVELS)
    places = np.rint((chosen.points - low) / step_m)
    num_moving = int(chosen.moving.sum())
    movers = _numbers(chosen.instance, [-1, *instances]) + 1
    displaced_step_m = float(np.abs(chosen.displacement).max(initial=1.0)) / 32767
    displaced = np.rint(chosen.displacement[:num_moving] / displaced_step_m) + 32768
    return {
        "num_points": len(rows),
        "num_all": len(cloud.points),
        "num_moving": num_moving,
        "low_m": low,
        "step_m": step_m,
        "places": [blobs.add(column) for column in places.T],
        "rgb": [blobs.add(column) for column in _colours(chosen).T],
        "sweep": blobs.add(_numbers(chosen.frame, frames)),
        "mover": blobs.add(np.where(chosen.moving, movers, 0)),
        "confidence": blobs.add(np.rint(_CONFIDENCE_STEPS * chosen.confidence)),
        "confidence_steps": _CONFIDENCE_STEPS,
        "displaced": [blobs.add(column) for column in displaced.T],
        "displaced_step_m": displaced_step_m,
    }


def thinned(points: Float, moving: Bool, most: int) -> Int:
    """Return (K,) ascending indices of at most ``most`` points, drawn with a fixed random seed.

    The probability grows with squared distance from the origin, for equal density in angle.
    """
    if len(points) <= most:
        return np.arange(len(points))
    weight = np.maximum((points**2).sum(axis=1), _NEAR_M**2)
    weight[moving] *= _MOVING_WEIGHT
    order = np.argsort(np.random.default_rng(0).exponential(size=len(points)) / weight)
    return np.sort(order[:most])


def _colours(cloud: StoredCloud) -> NDArray[np.uint8]:
    """Return (N,3) colours of 64 levels, gray by reflectance where no camera observed the point."""
    dark, bright = _GRAY
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity, 0, 1))
    observed = cloud.rgb.any(axis=1, keepdims=True)
    return (np.where(observed, cloud.rgb, gray[:, None]).astype(np.uint8) >> 2).astype(np.uint8)


def _numbers(values: NDArray[np.int32], known: Sequence[int]) -> Int:
    """Return the index of each value (N,) in the list ``known``, 0 for unknown values."""
    number_of = {value: number for number, value in enumerate(known)}
    return np.array([number_of.get(value, 0) for value in values.tolist()], np.int64)


def page_file(title: str, data: Mapping[str, Any], blobs: Blobs) -> bytes:
    """Return the bytes of a whole HTML page, whose script reads ``data`` as ``page``."""
    script, style = "\n".join(map(_source, _SCRIPTS)), _source("page.css")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; "
        f"img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "csp": policy,
        "title": html.escape(title),
        "style": style,
        "script": script,
        "data": _json({**data, "palettes": _palettes()}),
        "blobs": "\n".join(
            f'<script type="text/plain" id="{name}">{text}</script>'
            for name, text in blobs.texts.items()
        ),
    }
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _source("key.html"))
    return filled.encode("utf-8", "backslashreplace")


def _source(name: str) -> str:
    return (files("densify.outputs.report") / "page" / name).read_text("utf-8")


def _hash(text: str) -> str:
    """Return the hash that names an inline script in the content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: Mapping[str, Any]) -> str:
    """Return JSON text that cannot close its HTML script element."""
    text = json.dumps(plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028]", lambda match: f"\\u{ord(match[0]):04x}", text)


def _palettes() -> dict[str, str]:
    """Return the name of each colour map -> 256 RGB colours in base64."""
    levels = np.arange(256, dtype=np.uint8)
    maps = {name: cv2.applyColorMap(levels, number) for name, number in _COLOUR_MAPS.items()}
    return {
        name: base64.b64encode(bgr.reshape(256, 3)[:, ::-1].tobytes()).decode()
        for name, bgr in maps.items()
    }
