# SPDX-License-Identifier: MIT
"""Make one depth map from the accumulated cloud: one record that passes an ordered table of stages.

The order of the points has no effect. Planes are fitted in inverse depth, or in inverse range if
depth is the range. The last part is the stage that rejects pixels that rays passed through, such as
pixels in the gaps of a fence. The image cannot decide this: a background measured from elsewhere
lies behind the car in the image too. Every ray is followed to its crossing with the map's own
surface, and counts there (free-space evidence as in occupancy grids: Thrun et al., "Probabilistic
Robotics", 2005, ch. 9).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.confidence import confidence_of, features, nearest_pixel
from densify.depth.exposure import Exposure, InView, pixel_of
from densify.depth.fill import accept_boundary_pixels, fill, fill_stars, measure_spots
from densify.depth.measured_pixels import MapInputs, MapRecord, measure
from densify.depth.moving_bodies import close_bodies
from densify.depth.patches import FOOTPRINT, agree_m, hidden_m
from densify.depth.rays import Rays
from densify.geometry import poses
from densify.geometry.types import Bool, Camera, Cloud, DepthMap, Float, Float32, Reason, Rejected

_LEAST_CONFIDENCE = np.float32(1) / np.iinfo(np.uint8).max  # stored as 1; 0 is no depth
_SHARE = 0.25  # share of passing rays above which a pixel is rejected
_NUM_STEPS = 6

_Stage = tuple[bool, Callable[..., None], tuple[Any, ...]]


def project(inputs: MapInputs) -> DepthMap:
    """Return the depth map of a cloud in the view of a camera.

    Moving objects are shown at their position at the view's time.
    """
    record = measure(inputs)
    for applies, stage, arguments in _stages(inputs):
        if applies:
            stage(record, *arguments)
    return _finished(record, inputs)


def _stages(inputs: MapInputs) -> tuple[_Stage, ...]:
    """Return the stages in their order: if each applies, its function, and its arguments."""
    cloud, view, settings = inputs.cloud, inputs.view, inputs.settings
    filled, visible, rays = inputs.filled, settings.visibility, inputs.rays
    return (
        (True, accept_boundary_pixels, (settings.rims,)),
        (filled, fill, (settings.fill_reach,)),
        (filled, fill_stars, ()),
        (filled and visible, close_bodies, (cloud, view.exposure, inputs.bodies)),
        (visible and rays is not None, reject_seen_through, (cloud, view, rays)),
        (visible, _rate, (cloud, inputs.camera)),
        (not visible, _rate_by_age, (cloud,)),
        (True, _set_reasons, ()),
        (filled and visible, measure_spots, ()),
    )


def _rate(record: MapRecord, cloud: Cloud, camera: Camera) -> None:
    """Set the confidence of pixels with a filled or rejected depth, and its evidence."""
    record.rejected_m[record.filled_m > 0] = 0
    has_depth = (record.filled_m > 0) | (record.rejected_m > 0)
    record.evidence = features(record, cloud.since_key_ns, camera)
    confidence = confidence_of(record.evidence)
    record.confidence[has_depth] = np.maximum(confidence, _LEAST_CONFIDENCE)


def _rate_by_age(record: MapRecord, cloud: Cloud) -> None:
    """Set the confidence of each pixel to that of the point that measured the nearest pixel."""
    shown = record.filled_m > 0
    if shown.any():
        of_point = cloud.confidence[record.point[nearest_pixel(record.depth_m > 0)]][shown]
        record.confidence[shown] = np.maximum(of_point, _LEAST_CONFIDENCE)


def _set_reasons(record: MapRecord) -> None:
    """Set the reason of points in the map and of points removed from it."""
    record.reason[record.point[record.boundary_m > 0]] = Reason.EDGE
    record.reason[record.point[record.depth_m > 0]] = Reason.KEPT


def _finished(record: MapRecord, inputs: MapInputs) -> DepthMap:
    """Return the record as a depth map, with the sweep that measured each pixel."""
    shown, rejected, none = record.filled_m > 0, record.rejected_m > 0, np.float32(0)

    def frames(mask: Bool) -> NDArray[np.int32]:
        frame = np.full(mask.shape, -1, np.int32)
        frame[mask] = inputs.cloud.frame[record.point[mask]]
        return frame

    rejected_pixels = Rejected(
        record.rejected_m,
        np.where(shown, none, record.confidence),
        frames(rejected & (record.boundary_m > 0)),
    )
    return DepthMap(
        camera=inputs.camera.name,
        depth_m=record.depth_m,
        filled_m=record.filled_m,
        confidence=np.where(shown, record.confidence, none),
        frame=frames(record.depth_m > 0),
        reason=record.reason,
        measure=inputs.view.exposure.measure,
        evidence=record.evidence,
        rejected=None if record.evidence is None else rejected_pixels,
    )


def reject_seen_through(record: MapRecord, cloud: Cloud, view: InView, rays: Rays) -> None:
    """Reject the pixels that rays passed through.

    The ray of an occluded static point (by its reason) passed through where it crosses the surface
    of the map, clearly before its end. The ray of any other point ended in its pixel. Both are
    blurred by a third of the ray spacing. A pixel is rejected if more than a quarter of the rays
    passed through. Moving bodies stay.
    """
    counts = np.isin(cloud.frame, rays.stretch.frames) & (record.reason != Reason.OUTSIDE)
    stopped = counts & (record.reason != Reason.HIDDEN)
    passed = cloud.select(counts & ~stopped & ~cloud.moving)
    blur_px, shape = FOOTPRINT * float(np.median(record.gap_px)), record.filled_m.shape
    through = crossings(record.filled_m, rays.starts(passed), passed.points, view.exposure)
    num = _counts(through, shape, blur_px)
    num_stopped = _counts(view.uv[stopped[view.rows]], shape, blur_px)
    record.reject((num > _SHARE * (num + num_stopped)) & ~record.on_body)


def _counts(uv: Float, shape: tuple[int, ...], blur_px: float) -> Float32:
    """Return (H,W) the number of positions uv (K,2) in each pixel, blurred by ``blur_px``."""
    row, column = pixel_of(uv)
    counts = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1])
    size = 2 * round(2.5 * blur_px) + 1
    pixels = counts.reshape(shape).astype(np.float32)
    blurred = cv2.GaussianBlur(pixels, (size, size), blur_px, borderType=cv2.BORDER_REFLECT)
    return blurred.astype(np.float32, copy=False)


def crossings(surface_m: Float32, from_key: Float, to_key: Float, exposure: Exposure) -> Float:
    """Return the (P,2) px where rays cross the surface of a map clearly before they end.

    The search starts at the end of the ray. It goes to the point of the ray at the surface's depth
    in the present pixel, and repeats this until the depth stays the same. The rays go ``from_key``
    (K,3) ``to_key`` (K,3), key sweep's lidar frame. ``surface_m`` (H,W) is in metres, 0 none.
    """
    start = poses.transform(exposure.T_cam_key, from_key)
    end = poses.transform(exposure.T_cam_key, to_key)
    end_m, still = exposure.depth_m(end), np.zeros(to_key.shape, np.float32)
    sight = exposure.see(to_key, still)
    uv, valid = sight.uv, sight.inside
    depth_m = np.full(len(to_key), np.inf)
    for _ in range(_NUM_STEPS):
        before_m, pixel = depth_m, pixel_of(np.where(valid[:, None], uv, 0))
        depth_m = surface_m[pixel].astype(np.float64)
        with np.errstate(invalid="ignore"):
            same = abs(depth_m - before_m) <= agree_m(before_m)
        share = _share(start, end, depth_m, exposure.measure)
        valid &= (depth_m > 0) & (share > 0) & (share < 1)
        share = np.where(valid, share, 1.0)[:, None]
        sight = exposure.see(from_key + share * (to_key - from_key), still)
        uv, valid = sight.uv, valid & sight.inside
    crosses: Float = uv[valid & same & (end_m - depth_m > hidden_m(depth_m))]
    return crosses


def _share(start: Float, end: Float, depth_m: Float, measure: str) -> Float:
    """Return the (P,) share of the path at this depth, camera frame, NaN if it is not reached."""
    path = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        if measure == "z":
            share: Float = (depth_m - start[:, 2]) / path[:, 2]
            return share
        length_squared, along = (path**2).sum(axis=1), (start * path).sum(axis=1)
        discriminant = along**2 - length_squared * ((start**2).sum(axis=1) - depth_m**2)
        share = (np.sqrt(discriminant) - along) / length_squared
        return share
