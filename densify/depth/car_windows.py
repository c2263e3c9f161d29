# SPDX-License-Identifier: MIT
"""Close car windows.

Lasers pass through glass and measure seats, headrests and the background. Most uses of a depth map,
and KITTI's stereo benchmark, count these depths as outliers. A car window is a hole in one smooth
surface. Its rim lies in a plane. More rays of the key sweep are lost in it than on the rim, because
glass and dark paint send nothing back. A gap of a fence loses no ray.
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
# the least on ordinary surfaces.
_LOST_IN_GLASS, _LEAST_LOST = 0.4, 0.03
_LEAST_LOG_ODDS = 3.0  # odds of 20 to 1, because one hole in twenty is a window
_IN_PLANE = 0.75  # share of the rim that must be in the plane
_NUM_ROUNDS = 5  # of the robust fit
_EIGHT, _CROSS = np.ones((3, 3), bool), ndimage.generate_binary_structure(2, 1)


def share_lost(key_image: RangeImage) -> Callable[[Float], Float] | None:
    """Return a function that gives the share of lost rays of the key sweep around points.

    It takes points (N,3), key frame, and returns (N,) shares from 0 to 1. The result is None for
    scanners that do not spin, because the directions of their lost rays are unknown.
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
    """Return the layers with the plane of the rim in each car window.

    Measurements behind a window are removed. ``layers.solid`` marks the windows, ``layers.glass``
    the measured pixels that are removed.

    Args:
        share_lost: See `share_lost`.
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
    """Put a plane into a hole, but not behind known pixels.

    Return (h,w) True where a measured pixel is removed. least: confidence of the rim.
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
    """Return the greatest deviation (N,) in metres between points of one surface."""
    return AGREE_M + AGREE_FRACTION * depth_m.astype(np.float64)


def _num_rays(layers: Layers, pixels: Bool) -> float:
    """Return the number of rays of a sweep through the pixels (H,W)."""
    return float((1 / layers.spacing_px[pixels].prod(axis=1)).sum())


def _log_odds(lost: float, on_rim: float) -> float:
    """Return the mean log-likelihood ratio of a ray, for glass against a surface like the rim.

    The arguments are shares of the rays without a return, in the hole and on the rim. A missing
    return adds log(P(none | glass) / P(none | surface)). A return adds the log ratio of 1 -
    P(none). P(none | glass) is the measured share if that is larger than the usual one.
    """
    ordinary = max(on_rim, _LEAST_LOST)
    in_glass = min(max(lost, _LOST_IN_GLASS), 1 - _LEAST_LOST)
    if ordinary >= in_glass:
        return 0.0
    none, some = in_glass / ordinary, (1 - in_glass) / (1 - ordinary)
    return lost * float(np.log(none)) + (1 - lost) * float(np.log(some))


def _holes(layers: Layers) -> Iterator[tuple[tuple[slice, slice], Bool, Bool]]:
    """Yield each hole in a smooth surface of the filled map that enough rays hit.

    A hole is a box of the image, (h,w) the hole in it, and (h,w) its rim, as wide as a gap between
    rays.
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
    """Return (H,W) the known pixels without those behind a depth discontinuity."""
    front_m = ndimage.grey_erosion(np.where(known_m > 0, known_m, np.inf), footprint=_CROSS)
    smooth: Bool = (known_m > 0) & (known_m <= front_m + _agree_m(front_m))
    return smooth


def _plane_of(known_m: Float32, rim: Bool) -> Float | None:
    """Return (3,) the plane in which most of a rim (h,w) lies, None without one.

    It is given by the inverse depth in the first pixel of the box and its slopes to the right and
    down.
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
    """Return (N,3) key-frame positions of static pixels (N,2) at these depths (N,)."""
    ray = cameras.rays(exposure.camera, uv.astype(np.float64))
    along = depth_m / exposure.depth_m(ray)
    return poses.transform(poses.inverse(exposure.T_cam_key), along[:, None] * ray)
