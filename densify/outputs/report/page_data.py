# SPDX-License-Identifier: MIT
"""The maps of a camera and the cloud, packed for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Int
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.png import encode_jpeg
from densify.outputs.report.page_file import Blobs
from densify.readers.decoded_files import decode_image

_NOT_OF_METHODS = {"depth", "depth_filled", "confidence", "age", "sweep", "reason", "truth"}
_JPEG_QUALITY = 85
_LEVELS = 65535
_MOST_DISPLACED_M = 65.0
_CONFIDENCE_STEPS = 31
_GRAY = 50, 190  # reflectance 0 and 1, where no camera observed the point
_NEAR_M, _MOVING_WEIGHT = 4.0, 100.0


def packed_camera(
    blobs: Blobs,
    maps: Mapping[str, NDArray[Any]],
    jpeg: bytes | None,
    view: Mapping[str, Any],
    every: int,
) -> dict[str, Any]:
    """Return a camera's entry of the page.

    maps: kind -> (H,W) as stored, see `outputs.report.key_files.KeyFiles.camera`.
    jpeg: its image. view: of scene.json. every: 2 keeps every second pixel of every second row.

    Measured, source sweep and age are one map: ``source`` numbers the rows of ``sources``, which
    are [row of the sweep + 1, age in ms + 1, measured 0 or 1], 0 where unknown.
    """
    height, width = next(iter(maps.values())).shape
    small = {kind: image[::every, ::every] for kind, image in maps.items()}
    nothing = np.zeros(next(iter(small.values())).shape, np.uint16)
    measured, filled = (small.get(k, nothing) for k in ("depth", "depth_filled"))
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
        "filled": blobs.add(np.where(measured > 0, measured, filled)),
        "source": blobs.add(smallest(source.reshape(codes.shape))),
        "sources": np.stack([known >> 17, (known >> 1) & 0xFFFF, known & 1], axis=1),
        "density": {
            "measured": np.mean(maps.get("depth", nothing) > 0),
            "filled": np.mean(maps.get("depth_filled", nothing) > 0),
        },
        "others": {k: blobs.add(m) for k, m in small.items() if k not in _NOT_OF_METHODS},
    }
    entry |= {k: blobs.add(small[k]) for k in ("confidence", "reason", "truth") if k in small}
    if jpeg is not None:
        if every > 1:
            rgb = decode_image(jpeg, "image")[::every, ::every, ::-1]
            jpeg = encode_jpeg(rgb, _JPEG_QUALITY)
        entry["image"] = blobs.add_file(jpeg, "image/jpeg")
    return entry


def _focal_px(view: Mapping[str, Any]) -> float | None:
    """Return `densify.geometry.types.Camera.focal_px`, None if the file does not tell."""
    try:
        xi = view["distortion"][0] if view["model"] == "mei" else 0.0
        return float(view["K"][0][0] / (1 + xi))
    except (KeyError, IndexError, TypeError, ZeroDivisionError):
        return None


def packed_cloud(
    blobs: Blobs,
    cloud: StoredCloud,
    frames: Sequence[int],
    instances: Sequence[int],
    most_points: int,
) -> dict[str, Any]:
    """Return the cloud's entry of the page: the points of `thinned`, moving ones first, each part
    in space order. Positions are 16-bit numbers in a box.

    frames: the sweeps that ``sweep`` numbers. instances: the tracked objects; ``mover`` is 0 of
    static points, 1 of moving points without a track, 2 and up of these. ``displaced``, metres
    beyond the rigid alignment, is of moving points alone, in ``displaced_step_m`` plus 32768.
    """
    rows = thinned(cloud.points, cloud.moving, most_points)
    points = cloud.points[rows]
    low = points.min(axis=0, initial=0.0)
    step_m = float(max((points - low).max(initial=0.0), 1e-3) / _LEVELS)
    places = np.rint((points - low) / step_m).astype(np.uint16)
    order = in_space_order(places)
    order = order[np.argsort(~cloud.moving[rows][order], kind="stable")]
    chosen, places = cloud.select(rows[order]), places[order]
    num_moving = int(chosen.moving.sum())
    movers = _numbers(chosen.instance, [-1, *instances]) + 1
    displaced = np.nan_to_num(chosen.displacement[:num_moving])
    displaced = np.clip(displaced, -_MOST_DISPLACED_M, _MOST_DISPLACED_M)
    displaced_step_m = max(float(np.abs(displaced).max(initial=0)) / 32767, 1e-4)
    displaced = (np.rint(displaced / displaced_step_m) + 32768).astype(np.uint16)
    confidence = np.rint(_CONFIDENCE_STEPS * np.clip(chosen.confidence, 0, 1)).astype(np.uint8)
    return {
        "num_points": len(rows),
        "num_all": len(cloud.points),
        "num_moving": num_moving,
        "low_m": low,
        "step_m": step_m,
        "places": [blobs.add(np.ascontiguousarray(column)) for column in places.T],
        "rgb": [blobs.add(np.ascontiguousarray(column)) for column in _colours(chosen).T],
        "sweep": blobs.add(smallest(_numbers(chosen.frame, frames))),
        "mover": blobs.add(smallest(np.where(chosen.moving, movers, 0))),
        "confidence": blobs.add(confidence),
        "confidence_steps": _CONFIDENCE_STEPS,
        "displaced": [blobs.add(np.ascontiguousarray(column)) for column in displaced.T],
        "displaced_step_m": displaced_step_m,
    }


def thinned(points: Float, moving: Bool, most: int) -> Int:
    """Return rows (K,) of at most so many points, ascending, chosen at random with a fixed seed.

    points: (N,3) key frame. moving: (N,). A point counts by its squared distance, which makes the
    rest about as dense in angle everywhere, and moving points count more.
    """
    if len(points) <= most:
        return np.arange(len(points))
    weight = np.maximum((points**2).sum(axis=1), _NEAR_M**2)
    weight[moving] *= _MOVING_WEIGHT
    order = np.argsort(np.random.default_rng(0).exponential(size=len(points)) / weight)
    return np.sort(order[:most])


def in_space_order(levels: NDArray[np.uint16]) -> Int:
    """Return the order (N,) in which (N,3) quantised positions follow their neighbours (Morton,
    1966), which packs well."""
    code = np.zeros(len(levels), np.int64)
    for bit in range(16):
        for axis in range(3):
            code |= ((levels[:, axis].astype(np.int64) >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def smallest(array: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers, 0 or more and below 2^32, in 8, 16 or 32 bits as they need."""
    return array.astype(np.min_scalar_type(int(array.max(initial=0))))


def _colours(cloud: StoredCloud) -> NDArray[np.uint8]:
    """Return (N,3) in 64 levels, gray by reflectance where no camera observed the point."""
    dark, bright = _GRAY
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity, 0, 1))
    observed = cloud.rgb.any(axis=1, keepdims=True)
    return (np.where(observed, cloud.rgb, gray[:, None]).astype(np.uint8) >> 2).astype(np.uint8)


def _numbers(values: NDArray[np.int32], known: Sequence[int]) -> Int:
    """Return the place of each value (N,) in a list, 0 for others."""
    number_of = {value: number for number, value in enumerate(known)}
    return np.array([number_of.get(value, 0) for value in values.tolist()], np.int64)
