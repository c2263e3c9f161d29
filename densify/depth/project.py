# SPDX-License-Identifier: MIT
"""Make one depth map from the accumulated cloud, stage by stage.

The order of the points has no effect. Planes are fitted in inverse depth, or in inverse range if
depth is the range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.boundary_pixels import accept_boundary_pixels
from densify.depth.confidence import confidence_of, features, nearest_measured
from densify.depth.exposure import Exposure, InView
from densify.depth.fill import fill, fill_stars
from densify.depth.image_points import PointsInImage, points_in_image
from densify.depth.layers import Layers
from densify.depth.measured_pixels import MeasuredPixels, nearest_pixels, visible_pixels
from densify.depth.moving_bodies import MovingBody, close_bodies
from densify.depth.seen_through import Rays, without_seen_through
from densify.depth.spots import measure_spots
from densify.geometry.types import (
    Bool,
    Camera,
    Cloud,
    DepthMap,
    Float32,
    Patches,
    Reason,
    Rejected,
)

_BLOCK_PX = 16  # blocks within which the density of rays is about constant
_JUMP = 1.6  # least factor between spacings beyond the last of a scanner's denser rings
_LEAST_CONFIDENCE = np.float32(1) / np.iinfo(np.uint8).max  # stored as 1; 0 is no depth


def project(
    cloud: Cloud,
    view: InView,
    settings: ProjectSettings,
    patches: Patches,
    filled: bool = True,
    lab: Float32 | None = None,
    rays: Rays | None = None,
    bodies: Mapping[int, MovingBody] | None = None,
) -> DepthMap:
    """Return the depth map of a cloud in the view of a camera.

    Moving objects are shown at their position at the view's time. Without ``settings.visibility``
    each pixel takes its nearest point.

    Args:
        filled: False leaves out the fill.
        lab: (H,W,3) image in L*a*b*. If None, no boundary pixel is accepted by it.
        rays: Rays of the window. If None, no pixel is rejected as seen through.
        bodies: Bodies of moving objects by instance number.
    """
    exposure, camera, visible = view.exposure, view.exposure.camera, settings.visibility
    points = points_in_image(cloud, view, patches)
    reason = np.full(len(cloud), Reason.OUTSIDE, np.uint8)
    if visible:
        pixels = visible_pixels(points, camera, reason)
    else:
        pixels = nearest_pixels(points, camera, reason)
    layers = accept_boundary_pixels(_layers_of(pixels, points, camera, lab), settings.rims)
    if filled:
        layers = fill(layers, settings.fill_reach)
        layers = fill_stars(layers)
        if visible and bodies:
            layers = close_bodies(layers, cloud, exposure, bodies)
    if visible and rays is not None:
        layers = without_seen_through(layers, cloud, view, rays, reason)
    layers = replace(layers, rejected_m=np.where(layers.filled_m > 0, 0, layers.rejected_m))
    has_depth, evidence = (layers.filled_m > 0) | (layers.rejected_m > 0), None
    confidence = np.zeros(has_depth.shape, np.float32)
    if visible:
        evidence = features(layers, cloud.since_key_ns, camera)
        confidence[has_depth] = confidence_of(evidence)
    elif has_depth.any():
        confidence[has_depth] = cloud.confidence[layers.point[nearest_measured(layers)]][has_depth]
    confidence[has_depth] = np.maximum(confidence[has_depth], _LEAST_CONFIDENCE)
    _set_reasons(layers, reason)
    if visible and filled:
        layers = measure_spots(layers, points)
    return _finished(layers, cloud, exposure, reason, confidence, evidence)


def _layers_of(
    pixels: MeasuredPixels, points: PointsInImage, camera: Camera, lab: Float32 | None
) -> Layers:
    """Return measured pixels as layers; pixels near a depth discontinuity are boundary pixels."""
    shape = (camera.height_px, camera.width_px)
    known, inside = pixels.winner >= 0, pixels.inside
    winner = pixels.winner[known]

    def image(values: np.ndarray, none: float = 0) -> np.ndarray:
        """Return (H,W,…) values of the points that give pixels their depth."""
        by_pixel = np.full((known.size, *values.shape[1:]), none, values.dtype)
        by_pixel[known] = values[winner]
        return by_pixel.reshape(*shape, *values.shape[1:])

    depth_m = np.where(inside, pixels.depth_m, np.float32(0)).reshape(shape)
    in_window = points if points.far.all() else points.select(~points.far)
    return Layers(
        depth_m=depth_m,
        rim_m=np.where(inside, np.float32(0), pixels.depth_m).reshape(shape),
        filled_m=depth_m,
        point=image(points.index.astype(np.int32), -1),
        tilt=image(points.slope.astype(np.float32)),
        spacing_px=_spacing_px(in_window, shape),
        votes=np.ones(shape, np.float32),
        edge=pixels.edge.reshape(shape),
        rejected_m=np.zeros(shape, np.float32),
        lab=lab,
    )


def _spacing_px(points: PointsInImage, shape: tuple[int, int]) -> Float32:
    """Return the (H,W,2) spacing of rays across and down, the mean over blocks of pixels."""
    height, width = (-(-size // _BLOCK_PX) for size in shape)
    column, row = np.rint(points.uv).astype(np.int64).T // _BLOCK_PX
    block = row * width + column
    num = np.bincount(block, minlength=height * width)
    if not num.any():
        return np.ones((*shape, 2), np.float32)
    sums = [np.bincount(block, s, height * width) for s in points.spacing_px.T]
    mean = (np.stack(sums, axis=1) / np.maximum(num, 1)[:, None]).astype(np.float32)
    empty = (num == 0).reshape(height, width)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    blocks = mean.reshape(height, width, 2)[tuple(nearest)]
    # A block takes the downward spacing of the block above or below if that is far larger: the hole
    # below the last of a scanner's denser rings is as wide.
    down_px = blocks[..., 1]
    widest_px = ndimage.maximum_filter1d(down_px, 3, axis=0)
    blocks[..., 1] = np.where(widest_px > _JUMP * down_px, widest_px, down_px)
    every = blocks.repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
    return np.ascontiguousarray(every[: shape[0], : shape[1]])


def _set_reasons(layers: Layers, reason: NDArray[np.uint8]) -> None:
    """Set the ``reason`` (M,) in place for points in the map and points removed from it."""
    reason[layers.point[layers.rim_m > 0]] = Reason.EDGE
    reason[layers.point[layers.depth_m > 0]] = Reason.KEPT


def _finished(
    layers: Layers,
    cloud: Cloud,
    exposure: Exposure,
    reason: NDArray[np.uint8],
    confidence: Float32,
    evidence: Float32 | None,
) -> DepthMap:
    """Return the layers as a depth map, with the sweep that measured each pixel."""
    measured, shown = layers.depth_m > 0, layers.filled_m > 0

    def frames(mask: Bool) -> NDArray[np.int32]:
        frame = np.full(mask.shape, -1, np.int32)
        frame[mask] = cloud.frame[layers.point[mask]]
        return frame

    none = np.float32(0)
    rejected = Rejected(
        layers.rejected_m,
        np.where(shown, none, confidence),
        frames((layers.rejected_m > 0) & (layers.rim_m > 0)),
    )
    return DepthMap(
        camera=exposure.camera.name,
        depth_m=layers.depth_m,
        filled_m=layers.filled_m,
        confidence=np.where(shown, confidence, none),
        frame=frames(measured),
        reason=reason,
        measure=exposure.measure,
        evidence=evidence,
        rejected=rejected if evidence is not None else None,
    )
