# SPDX-License-Identifier: MIT
"""PNG, JPEG and WebP encoding, and pictures as files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.outputs.atomic import write_file

Picture = NDArray[np.uint8]
"""(H,W,3) RGB."""


def encode_png(image: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """(H,W) gray or (H,W,3) blue, green, red; 8 or 16 bit."""
    done, data = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be written as PNG")
    return data.tobytes()


def encode_jpeg(picture: Picture, quality: int = 92) -> bytes:
    """An RGB picture as JPEG. quality: 0 to 100; lower is smaller and shows blocks."""
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be written as JPEG")
    return data.tobytes()


def encode_webp(picture: Picture, quality: int) -> bytes:
    """An RGB picture as WebP, smaller than as JPEG. quality: 1 to 100."""
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    done, data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be written as WebP")
    return data.tobytes()


def write_picture(path: Path, picture: Picture) -> None:
    """Write an RGB picture as PNG."""
    write_file(path, encode_png(np.ascontiguousarray(picture[:, :, ::-1])))
