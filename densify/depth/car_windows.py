# SPDX-License-Identifier: MIT
"""Close car windows with the plane of their frame.

Lasers pass through glass and measure seats, headrests and the background. Most uses of a depth map,
and KITTI's stereo benchmark, count these depths as outliers. A car window appears as a hole in one
smooth surface, and the rim of the hole lies in a plane. More rays of the key sweep have no return
in the hole than on the rim, because glass and dark paint reflect little. In the gaps of a fence no
ray is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import Exposure
from densify.depth.fill import FILL_CONFIDENCE
from densify.depth.layers import Layers
from densify.depth.measured_pixels import AGREE_FRACTION, AGREE_M
from densify.free_space.range_image import RangeImage
from densify.geometry import cameras, poses
from densify.geometry.arrays import Bool, Float, Float32, Int

# Shares of rays without a return: in the window bands of 207 cars of KITTI's stereo benchmark, and
# the least assumed on ordinary surfaces.
_LOST_IN_GLASS, _LEAST_LOST = 0.4, 0.03
_LEAST_LOG_ODDS = 3.0  # odds of 20 to 1, because one hole in twenty is a window
_IN_PLANE = 0.75  # share of the rim's pixels that must be in the plane
_NUM_ROUNDS = 5  # of the robust fit
_EIGHT, _CROSS = (cv2.getStructuringElement(k, (3, 3)) for k in (cv2.MORPH_RECT, cv2.MORPH_CROSS))


class _Hole(NamedTuple):
    """A hole in a smooth surface.

    inside: (n,) flat indices of the hole's pixels in the image. rim: (m,) flat indices of the
    surface's pixels around it, as wide as the spacing of neighbouring rays. num_rays: expected
    number of rays of one sweep through the hole.
    """

    inside: Int
    rim: Int
    num_rays: float


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
    window, glass = np.zeros((2, *layers.filled_m.shape), bool)
    holes = list(_holes(layers))
    planes = _planes(layers.filled_m, [hole.rim for hole in holes])
    planar = np.flatnonzero(np.isfinite(planes).all(axis=1))
    holes, planes = [holes[i] for i in planar], planes[planar]

    def lost(places: Sequence[Int]) -> Float:
        """Return (G,) the mean share of missing returns in the pixels of each of G planes."""
        pixel, number = _joined(places)
        depth_m = _depth_m(planes[number], pixel, window.shape[1])
        share = share_lost(_points(exposure, pixel, depth_m))
        return np.bincount(number, share, len(places)) / [len(place) for place in places]

    odds = _log_odds(lost([hole.inside for hole in holes]), lost([hole.rim for hole in holes]))
    changed = ("depth_m", "filled_m", "confidence", "tilt")
    layers = replace(layers, **{name: getattr(layers, name).copy() for name in changed})
    for i in np.flatnonzero(odds * [hole.num_rays for hole in holes] > _LEAST_LOG_ODDS):
        window.flat[holes[i].inside] = True
        glass.flat[_close(layers, holes[i], planes[i])] = True
    return replace(layers, solid=window, glass=glass)


def _close(layers: Layers, hole: _Hole, plane: Float) -> Int:
    """Put a plane (3,) of `_planes` into a hole, in place, except behind nearer measurements.

    Return the flat indices of the measured pixels that are removed.
    """
    depth_m = _depth_m(plane, hole.inside, layers.filled_m.shape[1])
    known_m = layers.filled_m.flat[hole.inside]
    takes = (known_m == 0) | (known_m > depth_m + _agree_m(depth_m))
    pixel, least = hole.inside[takes], layers.confidence.flat[hole.rim].min()
    taken = pixel[layers.depth_m.flat[pixel] > 0]
    layers.depth_m.flat[pixel] = 0
    layers.filled_m.flat[pixel] = depth_m[takes]
    layers.tilt.reshape(-1, 2)[pixel] = plane[1:]
    layers.confidence.flat[pixel] = least * np.float32(FILL_CONFIDENCE)
    return taken


def _agree_m(depth_m: Float | Float32) -> Float:
    """Return the (N,) greatest deviation in metres between points of one surface."""
    return AGREE_M + AGREE_FRACTION * depth_m.astype(np.float64)


def _log_odds(lost: Float, on_rim: Float) -> Float:
    """Return the (G,) mean log-likelihood ratios of a ray, for glass against a surface as the rim.

    lost, on_rim: (G,) shares of missing returns in holes and on their rims. A missing return adds
    log(P(missing | glass) / P(missing | surface)), a return the log ratio of 1 - P(missing).
    P(missing | glass) is the share in the hole if that is above the usual one.
    """
    in_glass = np.clip(lost, _LOST_IN_GLASS, 1 - _LEAST_LOST)
    ordinary = np.clip(on_rim, _LEAST_LOST, in_glass)  # the odds are even where more is lost
    none, some = np.log(in_glass / ordinary), np.log((1 - in_glass) / (1 - ordinary))
    odds: Float = lost * none + (1 - lost) * some
    return odds


def _holes(layers: Layers) -> Iterator[_Hole]:
    """Yield each hole in a smooth surface of the filled map that enough rays hit."""
    rays_per_px = 1 / layers.spacing_px.prod(axis=2)
    least_rays = _LEAST_LOG_ODDS / float(_log_odds(np.ones(()), np.zeros(())))
    index = np.arange(rays_per_px.size).reshape(rays_per_px.shape)
    away_px = max(1, round(float(np.median(layers.gap_px))))
    wide = np.ones((2 * away_px + 1, 2 * away_px + 1), np.uint8)
    label, surfaces = _parts(_smooth(layers.filled_m), 8)
    for number, sides in enumerate(surfaces, start=1):
        box = _box(sides, 0)
        surface = label[box] == number
        if rays_per_px[box][~surface].sum() <= least_rays:
            continue
        holes, inner = _parts(_enclosed(surface) & ~surface, 4)
        num_rays = np.bincount(holes.ravel(), rays_per_px[box].ravel())[1:]
        for k in np.flatnonzero(num_rays > least_rays):
            around = _box(inner[k], away_px)
            hole = holes[around] == k + 1
            rim = surface[around] & (cv2.dilate(hole.astype(np.uint8), wide) > 0)
            there = index[box][around]
            yield _Hole(there[hole], there[rim], num_rays[k])


def _parts(pixels: Bool, connectivity: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Label the connected parts of a mask (h,w), with 4 or 8 neighbours, from 1; 0 elsewhere.

    Return the (h,w) labels, and the (P,4) left, top, width and height in pixels of each part.
    """
    _, label, parts, _ = cv2.connectedComponentsWithStats(
        pixels.astype(np.uint8), connectivity=connectivity
    )
    return label.astype(np.int32, copy=False), parts[1:, :4].astype(np.int32, copy=False)


def _box(part: NDArray[np.int32], margin_px: int) -> tuple[slice, slice]:
    """Return rows and columns of the box of a part (4,) from `_parts`, with a margin around it."""
    left, top, width, height = part.tolist()
    low, high = max(0, top - margin_px), top + height + margin_px
    return slice(low, high), slice(max(0, left - margin_px), left + width + margin_px)


def _enclosed(surface: Bool) -> Bool:
    """Return the pixels of a surface (h,w), of its gaps of a pixel or two, and of its holes."""
    joined = cv2.morphologyEx(
        surface.astype(np.uint8), cv2.MORPH_CLOSE, _EIGHT, None, (-1, -1), 1, cv2.BORDER_CONSTANT, 0
    )
    padded = np.pad(joined, 1)
    cv2.floodFill(padded, None, (0, 0), 2)
    enclosed: Bool = padded[1:-1, 1:-1] != 2
    return enclosed


def _smooth(known_m: Float32) -> Bool:
    """Return (H,W) True at known pixels without a nearer surface beside them; ``known_m`` in m."""
    before = np.where(known_m > 0, known_m, np.float32(np.inf))
    front_m = cv2.erode(before, _CROSS).astype(np.float32, copy=False)
    smooth: Bool = (known_m > 0) & (known_m <= front_m + _agree_m(front_m))
    return smooth


def _joined(places: Sequence[Int]) -> tuple[Int, Int]:
    """Return the (n,) pixels of all places, and the (n,) number of the place of each pixel."""
    number = np.repeat(np.arange(len(places)), [len(place) for place in places])
    return np.concatenate([np.zeros(0, np.int64), *places]), number


def _planes(known_m: Float32, rims: Sequence[Int]) -> Float:
    """Return the (G,3) planes in which most of each rim lies, NaN if the rim is not planar.

    A plane is its inverse depth (1/m) in the first pixel of the image, and its slopes to the right
    and down (1/m per px).
    """
    pixel, rim = _joined(rims)
    num, depth_m = np.bincount(rim, minlength=len(rims)), known_m.flat[pixel].astype(np.float64)

    def sums(values: Float) -> Float:
        """Return the (G,) sums of values (n,) over the pixels of each rim."""
        return np.bincount(rim, values, len(rims)).astype(np.float64, copy=False)

    row, column = np.divmod(pixel.astype(np.float64), known_m.shape[1])
    middle = np.stack([np.zeros(len(rims)), sums(column) / num, sums(row) / num])
    terms, weight = np.stack([np.ones(len(rim)), column, row]) - middle[:, rim], np.ones(len(rim))
    for _ in range(_NUM_ROUNDS):
        squares = (weight * depth_m**2) ** 2  # of deviations in metres
        moments = np.array([[sums(squares * one * other) for one in terms] for other in terms])
        target = np.array([sums(squares * one / depth_m) for one in terms])
        plane = np.einsum("gij,jg->ig", np.linalg.pinv(moments.T, hermitian=True), target)
        off = abs((terms * plane[:, rim]).sum(axis=0) - 1 / depth_m) * depth_m**2
        off /= _agree_m(depth_m)
        weight = 1 / (1 + off**2)
    plane[0] -= (plane[1:] * middle[1:]).sum(axis=0)
    planar = (num > len(terms)) & (sums(off <= 1) >= _IN_PLANE * num)
    return np.where(planar, plane, np.nan).T


def _depth_m(plane: Float, pixel: Int, width_px: int) -> Float32:
    """Return the (n,) depth of a plane (3,), or of one (n,3) each, at flat indices of pixels."""
    row, column = np.divmod(pixel, width_px)
    inverse, right, down = plane.T
    return (1 / np.maximum(inverse + right * column + down * row, 1e-3)).astype(np.float32)


def _points(exposure: Exposure, pixel: Int, depth_m: Float32) -> Float:
    """Return (n,3) positions, key sweep's lidar frame, of flat indices of pixels with depths."""
    row, column = np.divmod(pixel, exposure.camera.width_px)
    ray = cameras.rays(exposure.camera, np.column_stack([column, row]).astype(np.float64))
    along = depth_m / exposure.depth_m(ray)
    return poses.transform(poses.inverse(exposure.T_cam_key), along[:, None] * ray)
