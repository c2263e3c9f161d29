# SPDX-License-Identifier: MIT
"""Images as PNG and JPEG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""(H,W,3) RGB."""


def encode_png(image: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """Return the PNG of (H,W) gray or (H,W,3) blue, green, red; 8 or 16 bit."""
    return _encoded(".png", image)


def encode_jpeg(picture: Picture, quality: int = 92) -> bytes:
    """Return the JPEG of an RGB picture. quality: 0 to 100; lower is smaller, with blocks."""
    return _encoded(".jpg", picture[:, :, ::-1], cv2.IMWRITE_JPEG_QUALITY, quality)


def _encoded(suffix: str, image: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be written as {suffix}")
    return data.tobytes()
