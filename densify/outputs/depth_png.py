# SPDX-License-Identifier: MIT
"""Read and write depth, confidence, age, optical flow and pictures as PNG and JPEG.

Depth is in the format of KITTI's depth completion benchmark (Uhrig et al., "Sparsity Invariant
CNNs", 3DV 2017): 16 bit, one channel, ``value / 256`` metres, 0 = none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32
from densify.outputs.atomic import write_file
from densify.readers.decoded_files import read_image

Picture = NDArray[np.uint8]
"""(H,W,3) RGB."""

_STEPS_PER_M = 256.0
_STEPS_OF_CONFIDENCE = 254.0
_STEPS_PER_S = 1000.0
_STEPS_PER_PX = 64.0
_MAX_VALUE = np.iinfo(np.uint16).max


def encode_png(image: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """Return the PNG of (H,W) gray or (H,W,3) blue, green, red; 8 or 16 bit."""
    return cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes()


def encode_jpeg(picture: Picture, quality: int = 92) -> bytes:
    """Return the JPEG of an RGB picture.

    Args:
        quality: 0 to 100. A lower one is smaller, with blocks.
    """
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def map_path(folder: Path, kind: str, name: str, suffix: str = ".png") -> Path:
    """Return ``folder/kind/name.png``.

    With ``project.per=image`` the name of a map is ``CAMERA/NUMBER``.
    """
    return folder / kind / f"{name}{suffix}"


def write_depth_png(path: Path, depth_m: Float32) -> None:
    """Write ``rint(256 * depth_m)``.

    Depths beyond 65535/256 = 256 m and below half a step, 2 mm, become 0, none.

    Args:
        depth_m: (H,W) metres, 0 none.

    Raises:
        ValueError: A depth is negative or not finite.
    """
    write_file(path, encode_png(_quantised(depth_m)))


def write_confidence_png(path: Path, confidence: Float32, depth_m: Float32) -> None:
    """Write `stored_confidence` as 8 bit, 0 where `write_depth_png` has no depth.

    Args:
        confidence: (H,W), 0 to 1.
        depth_m: (H,W) metres, the depth it belongs to.
    """
    levels = np.zeros(depth_m.shape, np.uint8)
    has_depth = _quantised(depth_m) > 0
    levels[has_depth] = stored_confidence(confidence[has_depth])
    write_file(path, encode_png(levels))


def write_age_png(path: Path, age_s: Float32, depth_m: Float32) -> None:
    """Write `stored_age` as 16 bit, 0 where `write_depth_png` has no depth.

    Args:
        age_s: (H,W) seconds, 0 or more wherever there is depth.
        depth_m: (H,W) metres.
    """
    steps = np.zeros(depth_m.shape, np.uint16)
    has_depth = _quantised(depth_m) > 0
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
    """Write optical flow in the format of KITTI's flow benchmark (Menze and Geiger, CVPR 2015).

    It has 16 bit: red and green are ``rint(64 * flow) + 2^15`` to the right and down, blue is 1
    where known.

    Args:
        flow_px: (H,W,2) pixels, NaN where unknown. Flow beyond 512 pixels is written as
            unknown.
    """
    levels = np.rint(_STEPS_PER_PX * flow_px.astype(np.float64)) + 2**15
    known = ((levels >= 0) & (levels <= _MAX_VALUE)).all(axis=2)
    image = np.zeros((*flow_px.shape[:2], 3), np.uint16)
    image[known] = np.column_stack([np.ones(known.sum()), levels[known][:, ::-1]])
    write_file(path, encode_png(image))


def metres(stored: NDArray[np.uint16]) -> Float32:
    """Return (H,W) float32 metres of a stored depth map, exact to the last bit."""
    return stored.astype(np.float32) / np.float32(_STEPS_PER_M)


def read_depth_png(path: Path) -> Float32:
    """Return (H,W) metres, 0 none.

    Raises:
        InputError: It is no 16-bit gray PNG.
    """
    return metres(read_stored(path, np.uint16, "a depth map"))


def read_stored(path: Path, kind: type[np.uint8] | type[np.uint16], what: str) -> NDArray[Any]:
    """Return (H,W) of a map as it is stored.

    Args:
        what: Name of the map, for the message.

    Raises:
        InputError: It is no whole gray PNG of this depth.
    """
    image = read_image(path, as_stored=True)
    if image.dtype != kind or image.ndim != 2:
        got = f"{image.dtype} of shape {image.shape}"
        bits = 8 * np.dtype(kind).itemsize
        raise InputError(f"{path}: got {got}, expected {what} (PNG, {bits} bit, one channel)")
    return image


def read_mask_png(path: Path) -> Bool:
    """Return (H,W), True where any colour is not 0. Transparency is ignored.

    Raises:
        InputError: It is no image.
    """
    image = read_image(path, as_stored=True)
    colours = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    mask: Bool = colours > 0
    return mask


def _quantised(depth_m: Float32) -> NDArray[np.uint16]:
    if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
        raise ValueError("depth_m: expected finite depths, 0 or more")
    steps = np.rint(_STEPS_PER_M * depth_m.astype(np.float64))
    return np.where(steps <= _MAX_VALUE, steps, 0).astype(np.uint16)
