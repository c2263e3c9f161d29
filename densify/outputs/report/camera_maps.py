# SPDX-License-Identifier: MIT
"""The maps of one camera as a page has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.outputs.png import encode_jpeg
from densify.outputs.report.pack import Blobs, smallest
from densify.readers.decoded_files import decode_image

Maps = Mapping[str, NDArray[Any]]

_LEFT_OUT = {"depth", "depth_filled", "confidence", "age", "sweep", "reason", "truth"}
_SMALL_QUALITY = 85


def packed_camera(
    blobs: Blobs, maps: Maps, jpeg: bytes | None, view: Mapping[str, Any], every: int
) -> dict[str, Any]:
    """A camera's entry of the page.

    maps: by kind, (H,W) as stored, see `outputs.report.key_files.KeyFiles.camera`. jpeg: its image.
    view: of scene.json. every: 1 keeps all pixels, 2 every second of every second row.

    Measured, source sweep and age are one map: ``source`` numbers the rows of ``sources``, which
    are [place of the sweep + 1 or 0 if unknown, age in ms + 1 or 0, measured 1 or 0].
    """
    height, width = next(iter(maps.values())).shape
    small = {kind: image[::every, ::every] for kind, image in maps.items()}
    nothing = np.zeros(next(iter(small.values())).shape, np.uint16)
    measured, filled = (small.get(k, nothing) for k in ("depth", "depth_filled"))
    filled = np.where(measured > 0, measured, filled)
    codes = (
        (small.get("sweep", nothing).astype(np.int64) << 17)
        | (small.get("age", nothing).astype(np.int64) << 1)
        | (measured > 0)
    )
    known, source = np.unique(codes, return_inverse=True)
    entry: dict[str, Any] = {
        "size_px": [width, height],
        "every": every,
        "focal_px": _focal_px(view),
        "filled": blobs.add(filled),
        "source": blobs.add(smallest(source.reshape(codes.shape))),
        "sources": np.stack([known >> 17, (known >> 1) & 0xFFFF, known & 1], axis=1).tolist(),
        "density": {
            "measured": _density(maps.get("depth", nothing)),
            "filled": _density(maps.get("depth_filled", nothing)),
        },
        "others": {k: blobs.add(m) for k, m in small.items() if k not in _LEFT_OUT},
    }
    for kind in ("confidence", "reason", "truth"):
        if kind in small:
            entry[kind] = blobs.add(small[kind])
    if jpeg is not None:
        entry["image"] = blobs.add_file(_resized(jpeg, every), "image/jpeg")
    return entry


def thumbnail(picture: NDArray[np.uint8], width_px: int) -> bytes:
    """A small JPEG of (H,W,3) RGB."""
    height_px = max(1, round(picture.shape[0] * width_px / picture.shape[1]))
    small = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return encode_jpeg(small.astype(np.uint8), _SMALL_QUALITY)


def _resized(jpeg: bytes, every: int) -> bytes:
    if every == 1:
        return jpeg
    rgb = decode_image(jpeg, "image")[:, :, ::-1]
    return thumbnail(np.ascontiguousarray(rgb), -(-rgb.shape[1] // every))


def _density(image: NDArray[Any]) -> float:
    return float(np.mean(image > 0))


def _focal_px(view: Mapping[str, Any]) -> float | None:
    """As `densify.geometry.types.Camera.focal_px`, None where the files do not tell."""
    try:
        xi = view["distortion"][0] if view["model"] == "mei" else 0.0
        return float(view["K"][0][0] / (1 + xi))
    except (KeyError, IndexError, TypeError, ZeroDivisionError):
        return None
