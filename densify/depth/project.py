# SPDX-License-Identifier: MIT
"""The accumulated cloud seen from a camera: which points it sees, and the depth map they make.

Points that the camera cannot see are found by occlusion: every point hides what lies clearly behind
its patch (`densify.depth.patches`). Of the points left in a pixel the one measured nearest in time
to the key is taken, if enough sweeps agree with it and no depth edge is too close to tell on which
side of it the pixel lies: those are its rims, which `densify.depth.rims` decides upon. Its depth is
that of the plane through the points that agree, in the middle of the pixel. Nothing depends on the
order of the points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.agreement import contradicted, without_contradicted
from densify.depth.confidence import calibrated, ranked
from densify.depth.exposure import Exposure, InView
from densify.depth.fill import fill, without_shreds
from densify.depth.free_space import Rays, without_seen_through
from densify.depth.glass import close_windows
from densify.depth.image_points import PointsInImage, in_image
from densify.depth.layers import Layers
from densify.depth.rims import decide
from densify.depth.settling import MeasuredPixels, nearest_pixels, visible_pixels
from densify.depth.spot import measure_spots
from densify.depth.star import fill_stars
from densify.geometry.types import Bool, Camera, Cloud, DepthMap, Float32, Patches, Ranked, Reason

_BLOCK_PX = 16  # over which rays lie about equally dense
_JUMP = 1.6  # by which rays lie farther apart beyond the last of a scanner's denser rings
_LEAST_CONFIDENCE = np.float32(1 / 255)  # 0 means no depth once written as 8 bits


def project(
    cloud: Cloud,
    view: InView,
    settings: ProjectSettings,
    patches: Patches,
    filled: bool = True,
    lab: Float32 | None = None,
    rays: Rays | None = None,
) -> DepthMap:
    """The depth map of ``cloud``, at the key's moment, as a camera sees it at its exposure.

    view: of the cloud (`densify.depth.exposure.Exposure.sees`).
    settings: knobs, see `densify.config.ProjectSettings`; with ``visibility`` off the nearest point
    of each pixel is taken as it is; else the source sweep nearest in time to the key wins a pixel.
    patches: of the cloud, at the key's moment (`densify.depth.patches.patches`). filled: False
    leaves out the filling, which takes its time. lab: (H,W,3) the image, as `densify.depth.picture`
    makes it; without it nothing that needs one is done. rays: tell where the map is open
    (`densify.depth.free_space`); without them nothing is taken out.

    Points nearer than 0.1 m, outside the image or outside the lens's valid field of view are
    dropped. Planes are fitted in inverse depth, or inverse range where depth is the range: linear
    over the image of a pinhole in the first case, nearly so over a surface's few pixels otherwise.
    ``filled_m`` adds pixels interpolated between measured ones (`densify.depth.fill`), less what
    most around contradict (`densify.depth.agreement`), and rims that are unsure; what the spot of a
    measured return covers counts as measured too (`densify.depth.spot`).
    ``confidence`` starts from the point's own, less where few sweeps or points agree, a depth edge
    is close, the surface rough, or the point nearly hidden; that rank is turned into a probability
    (`densify.depth.confidence`), but with ``visibility`` off. ``reason`` says of every point why it
    is not in the map.
    """
    camera = view.exposure.camera
    points = in_image(cloud, view, patches, settings.visibility)
    own = np.clip(cloud.confidence[points.index], _LEAST_CONFIDENCE, 1.0)
    reason = np.full(len(cloud), Reason.OUTSIDE, np.uint8)
    if settings.visibility:
        reason[patches.free] = Reason.VETOED
        seen = visible_pixels(points, own, camera, settings, reason)
    else:
        seen = nearest_pixels(points, own, camera, reason)

    layers = decide(_measured(seen, points, camera, lab), settings)
    if filled:
        layers = _filled(layers, camera, settings)
    if not settings.visibility:
        _tell(layers, reason)
        return _finished(layers, cloud, view.exposure, reason, rank=None)
    if rays is not None and settings.seen_through < 1:
        layers = without_seen_through(layers, cloud, view, rays, reason, settings)
    off = contradicted(layers, camera.focal_px)
    if filled:
        layers = without_contradicted(layers, off)
    rank = ranked(layers, _far(layers, cloud), off)
    layers = replace(layers, confidence=calibrated(rank, layers.filled_m > 0))
    if layers.unsure is not None:
        layers = replace(layers, depth_m=np.where(layers.unsure, np.float32(0), layers.depth_m))
    _tell(layers, reason)
    if filled and settings.spot > 0:
        layers = measure_spots(layers, points, settings)
    return _finished(layers, cloud, view.exposure, reason, rank)


def _filled(layers: Layers, camera: Camera, settings: ProjectSettings) -> Layers:
    """The same, and what lies between measured pixels."""
    layers = fill(layers, settings)
    if settings.visibility and settings.glass == "plane":
        layers = close_windows(layers, camera.focal_px, settings)
    if settings.star_reach > 0:
        layers = fill_stars(layers, settings)
    return without_shreds(layers)


def _far(layers: Layers, cloud: Cloud) -> Bool:
    """(H,W) the measured pixels whose point sweeps beyond the window saw."""
    measured = layers.depth_m > 0
    far = np.zeros(measured.shape, bool)
    far[measured] = cloud.far[layers.point[measured]]
    return far


def _measured(
    seen: MeasuredPixels, points: PointsInImage, camera: Camera, lab: Float32 | None
) -> Layers:
    """What is measured away from depth edges is accepted, what is at them to be decided."""
    shape = (camera.height_px, camera.width_px)
    depth_m, rim_m, confidence = (np.zeros(shape, np.float32) for _ in range(3))
    tilt = np.zeros((*shape, 2), np.float32)
    point = np.full(shape, -1, np.int32)
    depth_m.flat[seen.pixel] = np.where(seen.inside, seen.depth_m, 0)
    rim_m.flat[seen.pixel] = np.where(seen.inside, 0, seen.depth_m)
    confidence.flat[seen.pixel] = np.maximum(seen.confidence, _LEAST_CONFIDENCE)
    tilt.reshape(-1, 2)[seen.pixel] = seen.tilt
    point.flat[seen.pixel] = points.index[seen.winner]
    veiled, refused, alone, moving = (np.zeros(shape, bool) for _ in range(4))
    veiled.flat[seen.pixel] = seen.veiled
    refused.flat[seen.pixel] = seen.refused
    alone.flat[seen.pixel] = seen.alone
    moving.flat[seen.pixel] = points.moving[seen.winner]
    spacing_px = _spacing_px(points if points.far.all() else points.select(~points.far), shape)
    return Layers(
        depth_m=depth_m,
        rim_m=rim_m,
        veiled=veiled,
        refused=refused,
        filled_m=depth_m,
        confidence=confidence,
        point=point,
        tilt=tilt,
        spacing_px=spacing_px,
        lab=lab,
        alone=alone,
        moving=moving,
    )


def _spacing_px(points: PointsInImage, shape: tuple[int, int]) -> Float32:
    """(H,W,2) between neighbouring rays: their mean over blocks, the nearest block's where there
    are no points. Up and down it is that of the block above or below, where that is far larger: so
    wide is the gap that begins at the last of a scanner's denser rings."""
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
    down_px = blocks[..., 1]
    widest_px = ndimage.maximum_filter1d(down_px, 3, axis=0)
    blocks[..., 1] = np.where(widest_px > _JUMP * down_px, widest_px, down_px)
    every = blocks.repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
    return np.ascontiguousarray(every[: shape[0], : shape[1]])


def _tell(layers: Layers, reason: NDArray[np.uint8]) -> None:
    """Fill in the ``reason`` of the points that are in the map, or were taken out of it."""
    reason[layers.point[(layers.rim_m > 0) & ~layers.veiled]] = Reason.EDGE
    reason[layers.point[layers.depth_m > 0]] = Reason.KEPT
    if layers.glass is not None:
        reason[layers.point[layers.glass]] = Reason.GLASS


def _finished(
    layers: Layers,
    cloud: Cloud,
    exposure: Exposure,
    reason: NDArray[np.uint8],
    rank: Ranked | None,
) -> DepthMap:
    measured = layers.depth_m > 0
    frame = np.full(measured.shape, -1, np.int32)
    frame[measured] = cloud.frame[layers.point[measured]]
    shown = layers.filled_m > 0
    return DepthMap(
        camera=exposure.camera.name,
        depth_m=layers.depth_m,
        filled_m=layers.filled_m,
        confidence=np.where(shown, np.maximum(layers.confidence, _LEAST_CONFIDENCE), 0),
        frame=frame,
        reason=reason,
        measure=exposure.measure,
        warnings=layers.warnings,
        ranked=rank,
    )
