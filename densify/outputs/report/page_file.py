# SPDX-License-Identifier: MIT
"""One HTML file with data, script and style that opens from disk and loads nothing else.

The page is written on WebGL2 and the browser's own inflate: a copy of three.js would be 700 kB for
points and lines. Content of files of others is JSON, which the script sets as text. The page's
policy (CSP) allows its one script, by its hash, and no request.
"""

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

from densify.outputs.plain import plain

_COLOUR_MAPS = {
    "viridis": cv2.COLORMAP_VIRIDIS,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "turbo": cv2.COLORMAP_TURBO,
}
_NOT_IN_SCRIPT = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028"}
_TRIAL_LEVEL, _LEVEL = 1, 7


class Blobs:
    """Packed arrays of a page: bytes by significance, deflate, base64, unpacked by
    ``page/unpack.js``. Browsers decode 16-bit PNG to 8 bits, which loses depth.

    texts: name -> base64.
    """

    def __init__(self, first: int = 0) -> None:
        """first: number of the first name."""
        self._first = first
        self.texts: dict[str, str] = {}

    @property
    def num_bytes(self) -> int:
        """Size of all texts."""
        return sum(map(len, self.texts.values()))

    def add(self, array: NDArray[Any]) -> Mapping[str, Any]:
        """Pack an unsigned array (N,) or (H,W) of 8, 16 or 32 bits, and return what the page needs
        to unpack it.

        Values are stored as they are or as differences along the last axis, whichever is smaller.
        """
        steps = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        plain_size, step_size = (len(_deflated(v, _TRIAL_LEVEL)) for v in (array, steps))
        is_delta = step_size < plain_size
        return {
            "blob": self._keep(_deflated(steps if is_delta else array, _LEVEL)),
            "bytes": array.dtype.itemsize,
            "shape": list(array.shape),
            "delta": is_delta,
        }

    def add_file(self, data: bytes, mime: str) -> Mapping[str, Any]:
        """Keep an image file as it is."""
        return {"blob": self._keep(data), "mime": mime}

    def _keep(self, data: bytes) -> str:
        name = f"blob-{self._first + len(self.texts)}"
        self.texts[name] = base64.b64encode(data).decode()
        return name


def _deflated(array: NDArray[Any], level: int) -> bytes:
    values = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    planes = values.view(np.uint8).reshape(-1, array.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), level)


def page_file(
    template: str, scripts: Sequence[str], title: str, data: Mapping[str, Any], blobs: Blobs
) -> bytes:
    """Return a whole page.

    template, scripts: files of the folder ``page``; the scripts become one, in this order.
    title: any text.
    data: plain numbers, texts, lists and mappings, ``page`` in the script.
    """
    script, style = "\n".join(_source(name) for name in scripts), _source("page.css")
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
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _source(template))
    return filled.encode("utf-8", "backslashreplace")


def _source(name: str) -> str:
    return (files("densify.outputs.report") / "page" / name).read_text("utf-8")


def _hash(text: str) -> str:
    """Return the name of an inline script in a policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: Mapping[str, Any]) -> str:
    """Return JSON that cannot end the script element it is in."""
    text = json.dumps(plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028]", lambda match: _NOT_IN_SCRIPT[match[0]], text)


def _palettes() -> dict[str, str]:
    """Return 256 x RGB of each colour map, base64."""
    levels = np.arange(256, dtype=np.uint8)
    maps = {name: cv2.applyColorMap(levels, number) for name, number in _COLOUR_MAPS.items()}
    return {
        name: base64.b64encode(bgr.reshape(256, 3)[:, ::-1].tobytes()).decode()
        for name, bgr in maps.items()
    }
