# SPDX-License-Identifier: MIT
"""Read and write depth, confidence, age, optical flow and pictures as PNG and JPEG."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32
from densify.outputs.folders import write_file
from densify.readers.decoded_files import read_image

Picture = NDArray[np.uint8]
"""(H,W,3) uint8 RGB image."""

# KITTI's depth completion benchmark: Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017
_STEPS_PER_M = 256.0
STEPS_OF_CONFIDENCE = 254.0
_STEPS_PER_S = 1000.0
_STEPS_PER_PX = 64.0
_MAX_VALUE = np.iinfo(np.uint16).max


def encode_png(image: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """Return PNG bytes of (H,W) or (H,W,3 or 4) pixels: blue, green, red, alpha, 8 or 16 bits."""
    return cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes()


def encode_jpeg(picture: Picture, quality: int = 92) -> bytes:
    """Return the bytes of a JPEG file of an (H,W,3) RGB picture, with a quality from 0 to 100."""
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def map_path(folder: Path, kind: str, name: str, suffix: str = ".png") -> Path:
    """Return the path ``folder/kind/name.png`` of a map named CAMERA or CAMERA/NUMBER."""
    return folder / kind / f"{name}{suffix}"


def write_depth_png(path: Path, depth_m: Float32) -> None:
    """Write depth (H,W) in metres as 16-bit PNG ``rint(256 * depth_m)``, 0 for none or > 256 m."""
    write_file(path, encode_png(_quantised(depth_m)))


def write_confidence_png(path: Path, confidence: Float32, depth_m: Float32) -> None:
    """Write confidence (H,W) as 8-bit PNG, ``1 + rint(254 * confidence)``, 0 without a depth."""
    _write_where_depth(path, depth_m, confidence, stored_confidence)


def write_age_png(path: Path, age_s: Float32, depth_m: Float32) -> None:
    """Write ages (H,W) in seconds as 16-bit PNG, ``1 + rint(1000 * age_s)``, 0 without a depth."""
    _write_where_depth(path, depth_m, age_s, stored_age)


def _write_where_depth(
    path: Path, depth_m: Float32, values: Float32, stored: Callable[[Float32], NDArray[Any]]
) -> None:
    """Write the stored form of (H,W) values at pixels whose depth is stored, 0 elsewhere."""
    has_depth = _quantised(depth_m) > 0
    pixels = stored(np.where(has_depth, values, np.float32(0)))
    write_file(path, encode_png(pixels * has_depth))


def stored_confidence(confidence: ArrayLike) -> NDArray[np.uint8]:
    """Return confidence as stored: ``1 + rint(254 * confidence)``, 1 to 255. 0 means no depth."""
    levels = np.rint(STEPS_OF_CONFIDENCE * np.asarray(confidence, np.float64))
    return (1 + levels).astype(np.uint8)


def confidence_of(stored: NDArray[np.uint8]) -> Float32:
    """Return confidence (H,W), 0 to 1, from stored values of 1 to 255, or 0 from 0 (no depth)."""
    return np.maximum(stored.astype(np.float32) - 1, 0) / np.float32(STEPS_OF_CONFIDENCE)


def stored_age(age_s: ArrayLike) -> NDArray[np.uint16]:
    """Return ages as stored: ``1 + rint(1000 * age_s)``, up to 65.5 s. 0 means no depth."""
    steps = np.rint(_STEPS_PER_S * np.asarray(age_s, np.float64))
    return (1 + np.minimum(steps, _MAX_VALUE - 1)).astype(np.uint16)


def age_of(stored: NDArray[np.uint16]) -> Float32:
    """Return ages (H,W) in seconds from stored values, ``(stored - 1) / 1000``, 0 without depth."""
    return np.maximum(stored.astype(np.float32) - 1, 0) / np.float32(_STEPS_PER_S)


def write_flow_png(path: Path, flow_px: Float32) -> None:
    """Write (H,W,2) optical flow, NaN where unknown, as KITTI does (Menze and Geiger, CVPR 2015).

    The PNG has 16 bits. Red stores ``rint(64 * u) + 2^15`` for u px to the right, green the same
    down, blue 1. All are 0 for unknown flow and flow beyond 512 px.
    """
    levels = np.rint(_STEPS_PER_PX * flow_px.astype(np.float64)) + 2**15
    known = ((levels >= 0) & (levels <= _MAX_VALUE)).all(axis=2)
    image = np.zeros((*flow_px.shape[:2], 3), np.uint16)
    image[known] = np.column_stack([np.ones(known.sum()), levels[known][:, ::-1]])
    write_file(path, encode_png(image))


def metres(stored: NDArray[np.uint16]) -> Float32:
    """Return depth (H,W) in metres as float32 from stored values, ``stored / 256``."""
    return stored.astype(np.float32) / np.float32(_STEPS_PER_M)


def read_depth_png(path: Path) -> Float32:
    """Return the depth (H,W) of a depth map's PNG in metres as float32, 0 for no depth."""
    return metres(read_stored(path, np.uint16, "a depth map"))


PixelType = type[np.uint8] | type[np.uint16]


def read_stored(path: Path, kind: PixelType, map_name: str) -> NDArray[Any]:
    """Return a PNG's values (H,W). Raise InputError, with ``map_name``, if not of type ``kind``."""
    image = read_image(path, as_stored=True)
    if image.dtype != kind or image.ndim != 2:
        got = f"{image.dtype} of shape {image.shape}"
        bits = 8 * np.dtype(kind).itemsize
        raise InputError(f"{path}: got {got}, expected {map_name} (PNG, {bits} bit, one channel)")
    return image


def read_mask_png(path: Path) -> Bool:
    """Return a mask (H,W), True where a colour channel is above 0, whatever the transparency."""
    image = read_image(path, as_stored=True)
    colours = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    mask: Bool = colours > 0
    return mask


def _quantised(depth_m: Float32) -> NDArray[np.uint16]:
    """Return depths in 256ths of a metre, 0 beyond 256 m."""
    if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
        raise ValueError("depth_m: expected finite depths, 0 or more")
    steps = np.rint(_STEPS_PER_M * depth_m.astype(np.float64))
    return np.where(steps <= _MAX_VALUE, steps, 0).astype(np.uint16)
