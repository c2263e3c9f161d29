# SPDX-License-Identifier: MIT
"""The cloud as a page has it: places as 16-bit numbers in a box, moving points first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float, Float32
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.report.pack import Blobs, smallest
from densify.outputs.report.thinning import in_space_order, thinned

MOST_POINTS = 500_000
_LEVELS = 65535
_MOST_DISPLACED_M = 65.0
_CONFIDENCE_STEPS = 31
_GRAY = 50, 190  # reflectance 0 and 1, where no camera saw the point


def packed_cloud(
    blobs: Blobs,
    cloud: StoredCloud,
    frames: Sequence[int],
    instances: Sequence[int],
    most_points: int = MOST_POINTS,
) -> dict[str, Any]:
    """The cloud's entry of the page: the points that `thinned` chooses, moving ones first, each
    part in space order.

    frames: the sweeps, which ``sweep`` numbers. instances: the moving objects that have a number:
    ``mover`` is 0 of what stands, 1 of what moves without one, 2 and up of these. ``displaced``, by
    which ours is moved against registration, is that of the moving points alone, in whole
    ``displaced_step_m`` plus 32768.
    """
    rows = thinned(cloud.points, cloud.moving, most_points)
    points, moving = cloud.points[rows], cloud.moving[rows]
    low = points.min(axis=0) if len(points) else np.zeros(3)
    step_m = float(max(np.ptp(points, axis=0).max(), 1e-3) / _LEVELS) if len(points) else 1e-3
    places = np.rint((points - low) / step_m).astype(np.uint16)
    order = in_space_order(places)
    order = np.concatenate([order[moving[order]], order[~moving[order]]])
    rows, places = rows[order], places[order]
    entry: dict[str, Any] = {
        "num_points": len(rows),
        "num_all": len(cloud.points),
        "num_moving": int(moving.sum()),
        "low_m": low.tolist(),
        "step_m": step_m,
        "places": [blobs.add(np.ascontiguousarray(column)) for column in places.T],
        "rgb": [blobs.add(np.ascontiguousarray(column)) for column in _colours(cloud, rows).T],
        "sweep": blobs.add(_numbers(cloud.frame[rows], frames)),
        "mover": blobs.add(_movers(cloud, rows, instances)),
        "confidence": blobs.add(_confidence(cloud.confidence[rows])),
        "confidence_steps": _CONFIDENCE_STEPS,
    }
    if cloud.displacement is not None:
        displaced = cloud.displacement[rows[: entry["num_moving"]]]
        entry |= _displaced(blobs, displaced)
    return entry


def _colours(cloud: StoredCloud, rows: NDArray[Any]) -> NDArray[np.uint8]:
    """(K,3) in 64 levels, gray by reflectance where no camera saw the point."""
    rgb = cloud.rgb[rows].astype(np.int64)
    unseen = ~rgb.any(axis=1)
    dark, bright = _GRAY
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity[rows], 0, 1))
    rgb[unseen] = gray[unseen, None].astype(np.int64)
    return (rgb >> 2).astype(np.uint8)


def _numbers(values: NDArray[np.int32], known: Sequence[int]) -> NDArray[Any]:
    """Place of each value in a list, 0 for others."""
    number_of: Mapping[int, int] = {value: number for number, value in enumerate(known)}
    distinct, inverse = np.unique(values, return_inverse=True)
    numbers = np.array([number_of.get(value, 0) for value in distinct.tolist()], np.int64)
    return smallest(numbers[inverse] if len(numbers) else np.zeros(0, np.int64))


def _movers(cloud: StoredCloud, rows: NDArray[Any], instances: Sequence[int]) -> NDArray[Any]:
    known = 1 + _numbers(cloud.instance[rows], [-1, *instances]).astype(np.int64)
    return smallest(np.where(cloud.moving[rows], known, 0))


def _confidence(confidence: Float32) -> NDArray[np.uint8]:
    return np.rint(_CONFIDENCE_STEPS * np.clip(confidence, 0, 1)).astype(np.uint8)


def _displaced(blobs: Blobs, displaced: Float | Float32) -> dict[str, Any]:
    limited = np.clip(np.nan_to_num(displaced), -_MOST_DISPLACED_M, _MOST_DISPLACED_M)
    step_m = max(float(np.abs(limited).max(initial=0)) / 32767, 1e-4)
    levels = (np.rint(limited / step_m) + 32768).astype(np.uint16)
    return {
        "displaced": [blobs.add(np.ascontiguousarray(column)) for column in levels.T],
        "displaced_step_m": step_m,
    }
