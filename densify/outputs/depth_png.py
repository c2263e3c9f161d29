# SPDX-License-Identifier: MIT
"""Depth, confidence, age and optical flow as PNG.

Depth is in the format of KITTI's depth completion benchmark (Uhrig et al., "Sparsity Invariant
CNNs", 3DV 2017): 16 bit, one channel, ``value / 256`` metres, 0 = none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32
from densify.outputs.atomic import write_file
from densify.outputs.png import encode_png
from densify.readers.decoded_files import read_image

_STEPS_PER_M = 256.0
_STEPS_OF_CONFIDENCE = 254.0
_STEPS_PER_S = 1000.0
_STEPS_PER_PX = 64.0
_MAX_VALUE = np.iinfo(np.uint16).max


def write_depth_png(path: Path, depth_m: Float32) -> None:
    """Write `encode_depth`."""
    write_file(path, encode_depth(depth_m))


def encode_depth(depth_m: Float32) -> bytes:
    """Return the PNG of ``rint(256 * depth_m)``.

    depth_m: (H,W) metres, 0 none. Depths beyond 65535/256 = 256 m and below half a step, 2 mm,
        become 0, none. Raises ValueError for depths that are negative or not finite.
    """
    return encode_png(_quantised(depth_m))


def write_confidence_png(path: Path, confidence: Float32, depth_m: Float32) -> None:
    """Write `encode_confidence`."""
    write_file(path, encode_confidence(confidence, depth_m))


def encode_confidence(confidence: Float32, depth_m: Float32) -> bytes:
    """Return the 8-bit PNG of `stored_confidence`, 0 where `encode_depth` has no depth.

    confidence: (H,W), 0 to 1. depth_m: (H,W) metres, the depth it belongs to.
    """
    has_depth = _has_depth("confidence", confidence, depth_m)
    if not ((confidence[has_depth] >= 0) & (confidence[has_depth] <= 1)).all():
        raise ValueError("confidence: expected 0 to 1 wherever there is depth")
    levels = np.zeros(depth_m.shape, np.uint8)
    levels[has_depth] = stored_confidence(confidence[has_depth])
    return encode_png(levels)


def write_age_png(path: Path, age_s: Float32, depth_m: Float32) -> None:
    """Write `stored_age` as 16 bit, 0 where `encode_depth` has no depth.

    age_s: (H,W) seconds, 0 or more wherever there is depth. depth_m: (H,W) metres.
    """
    has_depth = _has_depth("age_s", age_s, depth_m)
    if not (np.isfinite(age_s[has_depth]) & (age_s[has_depth] >= 0)).all():
        raise ValueError("age_s: expected 0 or more wherever there is depth")
    steps = np.zeros(depth_m.shape, np.uint16)
    steps[has_depth] = stored_age(age_s[has_depth])
    write_file(path, encode_png(steps))


def stored_confidence(confidence: ArrayLike) -> NDArray[np.uint8]:
    """Return ``1 + rint(254 * confidence)``. 255 is most certain; 0 is left for no depth."""
    levels = np.rint(_STEPS_OF_CONFIDENCE * np.asarray(confidence, np.float64))
    return (1 + levels).astype(np.uint8)


def stored_age(age_s: ArrayLike) -> NDArray[np.uint16]:
    """Return ``1 + rint(1000 * age_s)``. 0 is left for no depth; 65535 is 65.5 s or more."""
    steps = np.rint(_STEPS_PER_S * np.asarray(age_s, np.float64))
    return (1 + np.minimum(steps, _MAX_VALUE - 1)).astype(np.uint16)


def write_flow_png(path: Path, flow_px: Float32) -> None:
    """Write optical flow in the format of KITTI's flow benchmark (Menze and Geiger, CVPR 2015):
    16 bit, red and green ``rint(64 * flow) + 2^15`` to the right and down, blue 1 where known.

    flow_px: (H,W,2) pixels, NaN where unknown. Flow beyond 512 pixels is written as unknown.
    """
    levels = np.rint(_STEPS_PER_PX * flow_px.astype(np.float64)) + 2**15
    with np.errstate(invalid="ignore"):
        known = ((levels >= 0) & (levels <= _MAX_VALUE)).all(axis=2)
    image = np.zeros((*flow_px.shape[:2], 3), np.uint16)
    image[known, 0] = 1
    image[known, 1], image[known, 2] = levels[known, 1], levels[known, 0]
    write_file(path, encode_png(image))


def read_depth_png(path: Path) -> Float32:
    """Return (H,W) metres, 0 none. Raises InputError for anything but a 16-bit gray PNG."""
    stored = read_stored(path, np.uint16, "a depth map")
    return stored.astype(np.float32) / np.float32(_STEPS_PER_M)


def read_stored(path: Path, kind: type[np.uint8] | type[np.uint16], what: str) -> NDArray[Any]:
    """Return (H,W) of a map as it is stored. Raises InputError for anything but a whole gray PNG
    of that many bits. what: the map, for the message."""
    image = read_image(path, as_stored=True)
    if image.dtype != kind or image.ndim != 2:
        got = f"{image.dtype} of shape {image.shape}"
        bits = 8 * np.dtype(kind).itemsize
        raise InputError(f"{path}: got {got}, expected {what} (PNG, {bits} bit, one channel)")
    return image


def read_mask_png(path: Path) -> Bool:
    """Return (H,W), True where any colour is not 0; transparency is ignored. Raises InputError if
    it is no image."""
    image = read_image(path, as_stored=True)
    colours = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    mask: Bool = colours > 0
    return mask


def _has_depth(name: str, values: Float32, depth_m: Float32) -> NDArray[np.bool_]:
    if values.shape != depth_m.shape:
        raise ValueError(f"{name}: expected {depth_m.shape}, got {values.shape}")
    has_depth: NDArray[np.bool_] = _quantised(depth_m) > 0
    return has_depth


def _quantised(depth_m: Float32) -> NDArray[np.uint16]:
    if depth_m.ndim != 2:
        raise ValueError(f"depth_m: expected (H,W), got {depth_m.shape}")
    if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
        raise ValueError("depth_m: expected finite depths, 0 or more")
    steps = np.rint(_STEPS_PER_M * depth_m.astype(np.float64))
    return np.where(steps <= _MAX_VALUE, steps, 0).astype(np.uint16)
