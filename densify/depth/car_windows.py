# SPDX-License-Identifier: MIT
"""Close car windows with the plane of their frame.

Lasers pass through glass and measure seats, headrests and the background. Most uses of a depth map,
and KITTI's stereo benchmark, count these depths as outliers. A car window appears as a hole in one
smooth surface, and the rim of the hole lies in a plane. More rays of the key sweep have no return
in the hole than on the rim, because glass and dark paint reflect little. In the gaps of a fence no
ray is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import ndimage

from densify.depth.exposure import Exposure
from densify.depth.fill import FILL_CONFIDENCE
from densify.depth.layers import Layers
from densify.depth.measured_pixels import AGREE_FRACTION, AGREE_M
from densify.free_space.range_image import RangeImage
from densify.geometry import cameras, poses
from densify.geometry.arrays import Bool, Float, Float32

# Shares of rays without a return: in the window bands of 207 cars of KITTI's stereo benchmark, and
# the least assumed on ordinary surfaces.
_LOST_IN_GLASS, _LEAST_LOST = 0.4, 0.03
_LEAST_LOG_ODDS = 3.0  # odds of 20 to 1, because one hole in twenty is a window
_IN_PLANE = 0.75  # share of the rim's pixels that must be in the plane
_NUM_ROUNDS = 5  # of the robust fit
_EIGHT, _CROSS = np.ones((3, 3), bool), ndimage.generate_binary_structure(2, 1)


def share_lost(key_image: RangeImage) -> Callable[[Float], Float] | None:
    """Return a function that gives the share of missing returns of the key sweep around points.

    It takes (N,3) points, key sweep's lidar frame, and returns (N,) shares from 0 to 1. The result
    is None for scanners that do not spin, because the directions of missing returns are unknown.
    """
    turning = RangeImage(tuple(s for s in key_image.scanners if len(s.offset_s) == 1))
    if not turning.scanners:
        return None
    anywhere_m = (-np.inf, -np.inf)

    def share(points: Float) -> Float:
        # Returns in a point's cell and its eight neighbours, at any range.
        around = turning.num_beyond(points, anywhere_m, least=0).max(axis=0)
        return 1 - around / _EIGHT.size

    return share


def close_windows(
    layers: Layers, exposure: Exposure, share_lost: Callable[[Float], Float]
) -> Layers:
    """Return the layers with each car window filled by the plane of its rim.

    Measurements behind a window are removed. ``solid`` marks the pixels of windows, ``glass`` the
    removed measurements.

    Args:
        share_lost: Function from points to shares of missing returns, see `share_lost`.
    """
    changed = ("depth_m", "filled_m", "confidence", "tilt")
    window, glass = np.zeros((2, *layers.filled_m.shape), bool)
    layers = replace(layers, solid=window, glass=glass)
    layers = replace(layers, **{name: getattr(layers, name).copy() for name in changed})
    for box, hole, rim in list(_holes(layers)):
        part = layers.part(box)
        plane = _plane_of(part.filled_m, rim)
        if plane is None:
            continue
        row, column = np.indices(hole.shape)
        inverse = np.maximum(plane[0] + plane[1] * column + plane[2] * row, 1e-3)
        depth_m = (1 / inverse).astype(np.float32)
        uv = np.stack([column + box[1].start, row + box[0].start], axis=-1)
        lost = [
            float(share_lost(_points(exposure, uv[of], depth_m[of])).mean()) for of in (hole, rim)
        ]
        if _num_rays(part, hole) * _log_odds(*lost) > _LEAST_LOG_ODDS:
            window[box] |= hole
            glass[box] |= _close(part, hole, depth_m, plane[1:], part.confidence[rim].min())
    return layers


def _close(layers: Layers, hole: Bool, depth_m: Float32, slopes: Float, least: np.float32) -> Bool:
    """Put a plane into a hole of ``layers``, in place, except behind nearer measurements.

    Return (h,w) True where a measured pixel is removed. hole: (h,w) pixels of the hole. depth_m:
    (h,w) depth of the plane. slopes: (2,) slopes of its inverse depth, 1/m per px. least: least
    confidence of the rim.
    """
    known_m = layers.filled_m
    takes = hole & ((known_m == 0) | (known_m > depth_m + _agree_m(depth_m)))
    taken: Bool = takes & (layers.depth_m > 0)
    layers.depth_m[takes] = 0
    layers.filled_m[takes] = depth_m[takes]
    layers.tilt[takes] = slopes
    layers.confidence[takes] = least * np.float32(FILL_CONFIDENCE)
    return taken


def _agree_m(depth_m: Float | Float32) -> Float:
    """Return the (N,) greatest deviation in metres between points of one surface."""
    return AGREE_M + AGREE_FRACTION * depth_m.astype(np.float64)


def _num_rays(layers: Layers, pixels: Bool) -> float:
    """Return the expected number of rays of one sweep through the pixels that are True."""
    return float((1 / layers.spacing_px[pixels].prod(axis=1)).sum())


def _log_odds(lost: float, on_rim: float) -> float:
    """Return the mean log-likelihood ratio of a ray, for glass against a surface like the rim.

    lost, on_rim: shares of missing returns in the hole and on its rim. A missing return adds
    log(P(missing | glass) / P(missing | surface)), a return the log ratio of 1 - P(missing).
    P(missing | glass) is the share in the hole if that is above the usual one.
    """
    ordinary = max(on_rim, _LEAST_LOST)
    in_glass = min(max(lost, _LOST_IN_GLASS), 1 - _LEAST_LOST)
    if ordinary >= in_glass:
        return 0.0
    none, some = in_glass / ordinary, (1 - in_glass) / (1 - ordinary)
    return lost * float(np.log(none)) + (1 - lost) * float(np.log(some))


def _holes(layers: Layers) -> Iterator[tuple[tuple[slice, slice], Bool, Bool]]:
    """Yield each hole in a smooth surface of the filled map that enough rays hit.

    A hole is its box (rows and columns of the image), (h,w) the hole within the box, and (h,w) its
    rim, as wide as the spacing of neighbouring rays.
    """
    label, _ = ndimage.label(_smooth(layers.filled_m), _EIGHT)
    away_px = max(1, round(float(np.median(layers.gap_px))))
    for number, box in enumerate(ndimage.find_objects(label), start=1):
        surface = label[box] == number
        joined = ndimage.binary_closing(surface, _EIGHT)  # a rim may have gaps of a pixel or two
        holes, _ = ndimage.label(ndimage.binary_fill_holes(joined) & ~surface)
        for k, inner in enumerate(ndimage.find_objects(holes), start=1):
            around = tuple(slice(max(0, s.start - away_px), s.stop + away_px) for s in inner)
            hole = holes[around] == k
            top, left = (b.start + s.start for b, s in zip(box, around, strict=True))
            place = (slice(top, top + hole.shape[0]), slice(left, left + hole.shape[1]))
            if _num_rays(layers.part(place), hole) * _log_odds(1, 0) > _LEAST_LOG_ODDS:
                rim = ndimage.binary_dilation(hole, _EIGHT, away_px) & surface[around]
                yield place, hole, rim


def _smooth(known_m: Float32) -> Bool:
    """Return (H,W) True at known pixels without a nearer surface beside them; ``known_m`` in m."""
    front_m = ndimage.grey_erosion(np.where(known_m > 0, known_m, np.inf), footprint=_CROSS)
    smooth: Bool = (known_m > 0) & (known_m <= front_m + _agree_m(front_m))
    return smooth


def _plane_of(known_m: Float32, rim: Bool) -> Float | None:
    """Return the (3,) plane in which most of a rim (h,w) lies, None if the rim is not planar.

    It is the inverse depth (1/m) in the first pixel of the box, and its slopes to the right and
    down (1/m per px).
    """
    row, column = np.nonzero(rim)
    depth_m = known_m[rim].astype(np.float64)
    terms = np.column_stack([np.ones(len(row)), column, row])
    weight = np.ones(len(row))
    for _ in range(_NUM_ROUNDS):
        scale = weight * depth_m**2  # deviations in metres
        plane = np.real(np.linalg.lstsq(terms * scale[:, None], scale / depth_m, rcond=None)[0])
        off = abs(terms @ plane - 1 / depth_m) * depth_m**2 / _agree_m(depth_m)
        weight = 1 / (1 + off**2)
    return plane if len(row) > len(plane) and (off <= 1).mean() >= _IN_PLANE else None


def _points(exposure: Exposure, uv: Float, depth_m: Float32) -> Float:
    """Return (N,3) positions, key sweep's lidar frame, of pixels uv (N,2) with depths (N,)."""
    ray = cameras.rays(exposure.camera, uv.astype(np.float64))
    along = depth_m / exposure.depth_m(ray)
    return poses.transform(poses.inverse(exposure.T_cam_key), along[:, None] * ray)
