# SPDX-License-Identifier: MIT
"""Images as PNG, JPEG and WebP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.outputs.atomic import write_file

Picture = NDArray[np.uint8]
"""(H,W,3) RGB."""


def encode_png(image: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """Return the PNG of (H,W) gray or (H,W,3) blue, green, red; 8 or 16 bit."""
    return _encoded(".png", image)


def encode_jpeg(picture: Picture, quality: int = 92) -> bytes:
    """Return the JPEG of an RGB picture. quality: 0 to 100; lower is smaller, with blocks."""
    return _encoded(".jpg", picture[:, :, ::-1], cv2.IMWRITE_JPEG_QUALITY, quality)


def encode_webp(picture: Picture, quality: int) -> bytes:
    """Return the WebP of an RGB picture. quality: 1 to 100."""
    return _encoded(".webp", picture[:, :, ::-1], cv2.IMWRITE_WEBP_QUALITY, quality)


def write_picture(path: Path, picture: Picture) -> None:
    """Write an RGB picture as PNG."""
    write_file(path, encode_png(picture[:, :, ::-1]))


def _encoded(suffix: str, image: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be written as {suffix}")
    return data.tobytes()
