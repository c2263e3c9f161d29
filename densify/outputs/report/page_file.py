# SPDX-License-Identifier: MIT
"""One HTML file that asks no other host for anything.

Written by hand on WebGL2 and the browser's own inflate: the page itself is 80 kB; a copy of
three.js would be 700 kB more for points and lines. What comes from files of others is JSON that the
script sets as text; the page's own policy (CSP) lets nothing run but its one script, known by its
hash, and nothing be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from densify.outputs.plain import plain
from densify.outputs.report.pack import Blobs

_COLOUR_MAPS = {
    "viridis": cv2.COLORMAP_VIRIDIS,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "turbo": cv2.COLORMAP_TURBO,
}
_NOT_IN_SCRIPT = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028"}


def page_file(
    template: str, scripts: Sequence[str], title: str, data: Mapping[str, Any], blobs: Blobs
) -> bytes:
    """A whole page.

    template, scripts: files of the folder ``page``; the scripts become one, in this order. title:
    any text. data: what the script finds as ``page``, plain numbers, texts, lists and mappings.
    """
    script = "\n".join(_source(name) for name in scripts)
    style = _source("page.css")
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
    """As a policy names an inline script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _json(value: Mapping[str, Any]) -> str:
    """JSON that cannot end the script element it is in."""
    text = json.dumps(plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return re.sub("[<>&\u2028]", lambda match: _NOT_IN_SCRIPT[match[0]], text)


def _palettes() -> dict[str, str]:
    """256 x RGB of each colour map, base64."""
    levels = np.arange(256, dtype=np.uint8)
    maps = {name: cv2.applyColorMap(levels, number) for name, number in _COLOUR_MAPS.items()}
    return {
        name: base64.b64encode(bgr.reshape(256, 3)[:, ::-1].tobytes()).decode()
        for name, bgr in maps.items()
    }
