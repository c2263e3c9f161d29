# SPDX-License-Identifier: MIT
"""Reject pixels through whose surface too many rays passed, such as pixels in the gaps of a fence.

The image cannot decide this: a background measured from elsewhere lies behind the car in the image
too. Every ray is followed to its crossing with the map's own surface, and counts there (free-space
evidence as in occupancy grids: Thrun et al., "Probabilistic Robotics", 2005, ch. 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import Exposure, InView
from densify.depth.image_points import FOOTPRINT, HIDDEN_FRACTION, HIDDEN_M
from densify.depth.layers import Layers
from densify.depth.measured_pixels import AGREE_FRACTION, AGREE_M
from densify.geometry import poses
from densify.geometry.types import Bool, Cloud, Float, Float32, Reason, Stretch

_SHARE = 0.25  # share of passing rays above which a pixel is rejected
_NUM_STEPS = 6


@dataclass(frozen=True)
class Rays:
    """The rays of the sweeps of a window, in the lidar frame of the key sweep."""

    stretch: Stretch  # registered sweeps of the window
    key: int  # frame number of the key sweep

    def starts(self, cloud: Cloud) -> Float:
        """Return the (M,3) origins of the rays of a cloud's M points, at their firing times."""
        starts = np.empty((len(cloud), 3))
        for frame in np.unique(cloud.frame).tolist():
            rows, registered = np.flatnonzero(cloud.frame == frame), self.stretch[frame]
            sweep = registered.sweep
            origin = np.stack([sweep.origin_m(n) for n in range(int(sweep.lidar.max()) + 1)])
            start = origin[cloud.lidar[rows]]
            if sweep.offset_ns is not None:
                order = np.argsort(sweep.row, kind="stable")
                sweep_rows = order[np.searchsorted(sweep.row, cloud.row[rows], sorter=order)]
                offset_s = sweep.offset_ns[sweep_rows, None] * 1e-9
                twist: Float = np.where(
                    offset_s < 0, registered.twist_before, registered.twist_after
                )
                start = poses.transform_each(offset_s * twist, start)
            starts[rows] = poses.transform(self.stretch.T_target_source(self.key, frame), start)
        return starts

    def moved_m(self, frame: int) -> float:
        """Return a bound of the distances of a sweep's rays, at their start, from its lidar."""
        registered = self.stretch[frame]
        sweep = registered.sweep
        numbers = range(int(sweep.lidar.max(initial=0)) + 1)
        bound_m = float(np.linalg.norm([sweep.origin_m(n) for n in numbers], axis=1).max())
        if sweep.offset_ns is not None:
            speeds = (registered.twist_before, registered.twist_after)
            speed_m_s = max(float(np.linalg.norm(twist[3:])) for twist in speeds)
            bound_m += speed_m_s * 1e-9 * float(np.abs(sweep.offset_ns).max(initial=0))
        return bound_m


def without_seen_through(
    layers: Layers, cloud: Cloud, view: InView, rays: Rays, reason: NDArray[np.uint8]
) -> Layers:
    """Return the layers without the pixels that rays passed through.

    The ray of an occluded static point (by its ``reason``) passed through where it crosses the
    surface of the map, clearly before its end. The ray of any other point ended in its pixel. Both
    are blurred by a third of the ray spacing. A pixel is rejected if more than a quarter of the
    rays passed through. Moving bodies stay.
    """
    counts = np.isin(cloud.frame, rays.stretch.frames)
    counts &= reason != Reason.OUTSIDE
    stopped = counts & (reason != Reason.HIDDEN)
    passed = counts & ~stopped & ~cloud.moving
    gap_px, shape = float(np.median(layers.gap_px)), layers.filled_m.shape

    def through(hits: Bool) -> Float:
        """Return the (K,2) px where rays of the points ``hits`` (M,) cross the map."""
        if not hits.any():
            return np.zeros((0, 2))
        ends = cloud.select(hits)
        return crossings(layers.filled_m, rays.starts(ends), ends.points, view.exposure)

    num, num_stopped = (
        _counts(uv, shape, FOOTPRINT * gap_px)
        for uv in (through(passed), view.uv[stopped[view.rows]])
    )
    dropped = num > _SHARE * (num + num_stopped)
    if layers.solid is not None:
        dropped &= ~layers.solid
    return layers.without(dropped)


def _counts(uv: Float, shape: tuple[int, ...], blur_px: float) -> Float32:
    """Return (H,W) the number of positions uv (K,2) in each pixel, blurred by ``blur_px``."""
    column, row = np.rint(uv).astype(np.int64).T
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
        column, row = np.rint(np.where(valid[:, None], uv, 0)).astype(np.int64).T
        there_m = surface_m[row, column].astype(np.float64)
        with np.errstate(invalid="ignore"):
            same = abs(there_m - depth_m) <= AGREE_M + AGREE_FRACTION * depth_m
        depth_m = there_m
        share = _share(start, end, depth_m, exposure.measure)
        valid &= (depth_m > 0) & (share > 0) & (share < 1)
        share = np.where(valid, share, 1.0)[:, None]
        sight = exposure.see(from_key + share * (to_key - from_key), still)
        uv, valid = sight.uv, valid & sight.inside
    allowed_m = HIDDEN_M + HIDDEN_FRACTION * depth_m
    crosses: Float = uv[valid & same & (end_m - depth_m > allowed_m)]
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
