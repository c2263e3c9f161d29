# SPDX-License-Identifier: MIT
"""Depth, confidence and optical flow as PNG. Depth is exactly that of KITTI's depth-completion
benchmark (Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017): 16 bit, one channel, ``value / 256``
metres, 0 = none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.output.atomic import write_file
from densify.output.png import encode_png
from densify.types import Bool, Float32

_STEPS_PER_M = 256.0
_MAX_VALUE = np.iinfo(np.uint16).max


def write_depth_png(path: Path, depth_m: Float32) -> None:
    """Write ``rint(256 * depth_m)``.

    depth_m: (H,W) metres, 0 none. What the format cannot say becomes 0, none, never another depth:
    beyond 65535/256 = 256 m (a cast would wrap 256.5 m to 0.5 m) and nearer than half a step, 2 mm.
    Raises ValueError for depths that are negative or not finite.
    """
    write_file(path, encode_png(_quantised(depth_m)))


def write_confidence_png(path: Path, confidence: Float32, depth_m: Float32) -> None:
    """Write confidence as 8 bit: 0 where `write_depth_png` writes no depth, else
    ``1 + rint(254 * confidence)``, so 255 is most certain.

    confidence: (H,W), 0 to 1. depth_m: (H,W) metres, the depth it belongs to.
    """
    if confidence.shape != depth_m.shape:
        raise ValueError(f"confidence: expected {depth_m.shape}, got {confidence.shape}")
    has_depth = _quantised(depth_m) > 0
    if not ((confidence[has_depth] >= 0) & (confidence[has_depth] <= 1)).all():
        raise ValueError("confidence: expected 0 to 1 wherever there is depth")
    levels = np.zeros(depth_m.shape, np.uint8)
    levels[has_depth] = 1 + np.rint(254 * confidence[has_depth].astype(np.float64))
    write_file(path, encode_png(levels))


def write_flow_png(path: Path, flow_px: Float32) -> None:
    """Write optical flow as KITTI's flow benchmark does (Menze and Geiger, CVPR 2015): 16 bit, red
    and green ``rint(64 * flow) + 2^15`` to the right and down, blue 1 where it is known, else 0.

    flow_px: (H,W,2) pixels, NaN where unknown. What the format cannot say, beyond 512 pixels, is
    unknown too.
    """
    levels = np.rint(64.0 * flow_px.astype(np.float64)) + 2**15
    with np.errstate(invalid="ignore"):
        known = ((levels >= 0) & (levels <= _MAX_VALUE)).all(axis=2)
    image = np.zeros((*flow_px.shape[:2], 3), np.uint16)
    image[known, 0] = 1
    image[known, 1], image[known, 2] = levels[known, 1], levels[known, 0]
    write_file(path, encode_png(image))


def read_depth_png(path: Path) -> Float32:
    """(H,W) float32 metres, 0 none. Raises InputError for anything but a 16-bit gray PNG."""
    image = _decoded(path)
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        got = "no image" if image is None else f"{image.dtype} of shape {image.shape}"
        raise InputError(f"{path}: got {got}, expected a depth map (PNG, 16 bit, one channel)")
    return image.astype(np.float32) / np.float32(_STEPS_PER_M)


def read_mask_png(path: Path) -> Bool:
    """(H,W) bool, True where any colour is not 0; transparency says nothing. Raises InputError if
    it is no image."""
    image = _decoded(path)
    if image is None:
        raise InputError(f"{path}: got no image, expected a mask (PNG, 0 where it does not hold)")
    colours = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    mask: Bool = colours > 0
    return mask


def _decoded(path: Path) -> NDArray[Any] | None:
    """As it is stored; None if it is no image."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None


def _quantised(depth_m: Float32) -> NDArray[np.uint16]:
    if depth_m.ndim != 2:
        raise ValueError(f"depth_m: expected (H,W), got {depth_m.shape}")
    if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
        raise ValueError("depth_m: expected finite depths, 0 or more")
    steps = np.rint(_STEPS_PER_M * depth_m.astype(np.float64))
    return np.where(steps <= _MAX_VALUE, steps, 0).astype(np.uint16)
