# SPDX-License-Identifier: MIT
"""Make one depth map from the accumulated cloud: one record that passes an ordered list of stages.

The order of the points has no effect. The last stage rejects pixels that rays passed through, such
as in the gaps of a fence. The image cannot decide this: a background measured from elsewhere lies
behind the car in the image too. Every ray counts where it crosses the map's own surface (occupancy
grids: Thrun et al., "Probabilistic Robotics", 2005, ch. 9).
"""

from __future__ import annotations

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
_MAX_PASSING = 0.25  # share of passing rays above which a pixel is rejected
_NUM_ITERATIONS = 6  # number of iterations of the search for a crossing


def project(inputs: MapInputs) -> DepthMap:
    """Return the depth map of a cloud in a camera's view, moving objects as at the view's time."""
    cloud, view, settings = inputs.cloud, inputs.view, inputs.settings
    filled, visible = inputs.filled, settings.visibility
    record = measure(inputs)
    accept_boundary_pixels(record, settings.rims)
    if filled:
        fill(record, settings.fill_reach)
        fill_stars(record)
    if filled and visible:
        close_bodies(record, cloud, view.exposure, inputs.bodies)
    if visible and inputs.rays is not None:
        reject_seen_through(record, cloud, view, inputs.rays)
    if visible:
        _rate(record, cloud, view.exposure.camera)
    else:
        _rate_by_age(record, cloud)
    # Points in the map, and points removed from the map
    record.reason[record.point[record.boundary_m > 0]] = Reason.EDGE
    record.reason[record.point[record.depth_m > 0]] = Reason.KEPT
    if filled and visible:
        measure_spots(record)
    return _finished(record, inputs)


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
        source = record.point[nearest_pixel(record.depth_m > 0)]
        source_confidence = cloud.confidence[source][shown]
        record.confidence[shown] = np.maximum(source_confidence, _LEAST_CONFIDENCE)


def _finished(record: MapRecord, inputs: MapInputs) -> DepthMap:
    """Return the record as a depth map, with the sweep that measured each pixel."""
    shown = record.filled_m > 0

    def source_frames(mask: Bool) -> NDArray[np.int32]:
        """Return the (H,W) frame numbers of the sweeps that measured the pixels, else -1."""
        frame = np.full(mask.shape, -1, np.int32)
        frame[mask] = inputs.cloud.frame[record.point[mask]]
        return frame

    rejected = None
    if record.evidence is not None:
        is_measured = (record.rejected_m > 0) & (record.boundary_m > 0)
        confidence = np.where(shown, np.float32(0), record.confidence)
        rejected = Rejected(record.rejected_m, confidence, source_frames(is_measured))
    return DepthMap(
        camera=inputs.view.exposure.camera.name,
        depth_m=record.depth_m,
        filled_m=record.filled_m,
        confidence=np.where(shown, record.confidence, np.float32(0)),
        frame=source_frames(record.depth_m > 0),
        reason=record.reason,
        measure=inputs.view.exposure.measure,
        evidence=record.evidence,
        rejected=rejected,
    )


def reject_seen_through(record: MapRecord, cloud: Cloud, view: InView, rays: Rays) -> None:
    """Reject the pixels of a record, in place, that rays passed through.

    A ray passed through if its point is static and occluded (`Reason.HIDDEN`). The ray counts in
    the pixel where it crosses the surface of the map, clearly before its end. A ray stopped if its
    point has any other reason. The ray counts in the pixel of its point. Both counts are blurred by
    a third of the ray spacing. A pixel is rejected if more than a quarter of its rays passed
    through. Moving bodies stay. Points of sweeps outside the window do not count.
    """
    in_window = np.isin(cloud.frame, rays.stretch.frames)
    counted = in_window & (record.reason != Reason.OUTSIDE)
    stopped = counted & (record.reason != Reason.HIDDEN)
    passed_cloud = cloud.select(counted & ~stopped & ~cloud.moving)

    origins = rays.origins_of(passed_cloud)
    crossings_uv = find_crossings(record.filled_m, origins, passed_cloud.points, view.exposure)
    stopped_uv = view.uv[stopped[view.rows]]
    blur_px = FOOTPRINT * float(np.median(record.gap_px))
    shape = record.filled_m.shape
    num_passed = _counts(crossings_uv, shape, blur_px)
    num_stopped = _counts(stopped_uv, shape, blur_px)
    is_seen_through = num_passed > _MAX_PASSING * (num_passed + num_stopped)
    record.reject(is_seen_through & ~record.on_body)


def _counts(uv: Float, shape: tuple[int, ...], blur_px: float) -> Float32:
    """Return the (H,W) number of positions uv (K,2) in each pixel, blurred by ``blur_px``."""
    row, column = pixel_of(uv)
    counts = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1])
    pixels = counts.reshape(shape).astype(np.float32)
    kernel_px = 2 * round(2.5 * blur_px) + 1  # 2.5 standard deviations to each side
    size = (kernel_px, kernel_px)
    blurred = cv2.GaussianBlur(pixels, size, blur_px, borderType=cv2.BORDER_REFLECT)
    return blurred.astype(np.float32, copy=False)


def find_crossings(surface_m: Float32, from_key: Float, to_key: Float, exposure: Exposure) -> Float:
    """Return the pixel coordinates where rays cross the surface of a map clearly before they end.

    The search starts at the end of the ray. A step goes to the point of the ray at the surface's
    depth in the present pixel. Steps repeat until the depth stays the same. Returned are (P,2) px.

    Args:
        surface_m: (H,W) depth of the surface in metres, 0 for none.
        from_key: (K,3) origins of the rays, key sweep's lidar frame.
        to_key: (K,3) ends of the rays, same frame.
        exposure: Camera and time of the map.
    """
    start_cam = poses.transform(exposure.T_cam_key, from_key)
    end_cam = poses.transform(exposure.T_cam_key, to_key)
    end_m = exposure.depth_m(end_cam)
    no_velocity = np.zeros(to_key.shape, np.float32)
    sight = exposure.see(to_key, no_velocity)
    uv, is_valid = sight.uv, sight.inside
    depth_m = np.full(len(to_key), np.inf)
    for _ in range(_NUM_ITERATIONS):
        last_depth_m = depth_m
        pixel = pixel_of(np.where(is_valid[:, None], uv, 0))
        depth_m = surface_m[pixel].astype(np.float64)
        with np.errstate(invalid="ignore"):
            is_same = abs(depth_m - last_depth_m) <= agree_m(last_depth_m)

        # On to the point of the ray at this depth. A ray that does not reach the depth is dropped.
        share = _share_at_depth(start_cam, end_cam, depth_m, exposure.measure)
        is_valid &= (depth_m > 0) & (share > 0) & (share < 1)
        share = np.where(is_valid, share, 1.0)[:, None]
        sight = exposure.see(from_key + share * (to_key - from_key), no_velocity)
        uv = sight.uv
        is_valid = is_valid & sight.inside
    crosses = is_valid & is_same & (end_m - depth_m > hidden_m(depth_m))
    return uv[crosses]


def _share_at_depth(start: Float, end: Float, depth_m: Float, measure: str) -> Float:
    """Return the (K,) shares of the ways from start to end (K,3), camera frame, at given depths.

    A share is not finite, or not between 0 and 1, if the way does not reach the depth. ``measure``
    is ``z`` or ``range``.
    """
    path = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        if measure == "z":
            return (depth_m - start[:, 2]) / path[:, 2]
        # The farther solution of |start + share · path|² = depth², that is
        # share² path² + 2 share start · path + start² - depth² = 0
        length_squared = (path**2).sum(axis=1)
        start_along_path = (start * path).sum(axis=1)
        difference_of_squares = (start**2).sum(axis=1) - depth_m**2
        discriminant = start_along_path**2 - length_squared * difference_of_squares
        return (np.sqrt(discriminant) - start_along_path) / length_squared
