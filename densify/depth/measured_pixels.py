# SPDX-License-Identifier: MIT
"""Compute the depth that the points in an image give its pixels.

Among the visible points in a pixel, the one measured nearest in time to the key sweep wins. A plane
is fitted to the surrounding points that agree with it, and the pixel gets the depth of the plane at
its centre. The pixel is measured if, of all sweeps with points around it, the one nearest to the
key is among those that agree. Close to a depth discontinuity it becomes a boundary pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.image_points import (
    FOOTPRINT,
    HIDDEN_FRACTION,
    HIDDEN_M,
    PointsInImage,
    distance_behind,
    sorted_by_pixel,
)
from densify.depth.neighbours import limited, plane
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Camera, Reason

AGREE_M, AGREE_FRACTION = 0.1, 0.02
"""Greatest deviation between points on one surface: metres plus share of the depth."""
_REACH = 0.65  # radius of the plane and of the sweeps that agree, in spacings of rays
_SLACK_M = 0.015  # added to the radius of a discontinuity, for errors of registration
_EDGE_WINDOW_PX = 1.5  # width beyond the edge in which points must continue the surface
# Sweeps beyond the window share errors, and continue a surface behind a nearer one.
_FAR_SWEEPS, _FAR_EDGE = 6, 1.5
_RIDGE_PX2 = 0.02
_LEAST_PX, _MOST_PX = 3, 24  # limits of the radius
ALL_ROUND = 3.0
"""Extent of a surface without a depth discontinuity nearby, in radii of a discontinuity."""
_NUM_BITS = np.iinfo(np.int64).bits - 1  # sweeps are counted by their frame number modulo 63


class MeasuredPixels(NamedTuple):
    """The H·W pixels of an image, row by row."""

    winner: Int  # (H·W,) index, in `PointsInImage`, of the point that gives the depth; -1 none
    depth_m: Float32  # (H·W,) float32 depth in metres
    edge: Float32  # (H·W,) float32 extent of the surface, in radii of a discontinuity
    inside: Bool  # (H·W,) True if no depth discontinuity is near

    @staticmethod
    def at(camera: Camera, pixel: Int, *columns: np.ndarray) -> MeasuredPixels:
        """Return an image with columns (P,) at flat indices ``pixel`` (P,), empty elsewhere."""
        num = camera.height_px * camera.width_px
        images = [np.full(num, -1, np.int64), *(np.zeros(num, c.dtype) for c in columns[1:])]
        for image, column in zip(images, columns, strict=True):
            image[pixel] = column
        return MeasuredPixels(*images)


def nearest_pixels(
    points: PointsInImage, camera: Camera, reason: NDArray[np.uint8]
) -> MeasuredPixels:
    """Return the nearest point of each pixel, without occlusion or support tests.

    The ``reason`` (M,) of the points in the cloud becomes NOT_CHOSEN in place.
    """
    start, order = sorted_by_pixel(points, np.zeros(len(points.index), np.int64), camera)
    pixel = np.flatnonzero(np.diff(start))
    nearest = order[start[pixel]]
    reason[points.index] = Reason.NOT_CHOSEN
    inside, edge = np.ones(len(pixel), bool), np.full(len(pixel), np.float32(ALL_ROUND))
    return MeasuredPixels.at(camera, pixel, nearest, points.depth[nearest], edge, inside)


def visible_pixels(
    points: PointsInImage, camera: Camera, reason: NDArray[np.uint8]
) -> MeasuredPixels:
    """Return the pixels that visible points measure; set ``reason`` (M,) of points in the image.

    Points beyond the window come second. They measure pixels that the window leaves empty, away
    from depth discontinuities.
    """
    in_window = np.flatnonzero(~points.far)
    pixels, reasons = _settled(points.select(~points.far), camera)
    reason[points.index[in_window]] = reasons
    if len(in_window) == len(points.index):
        return pixels
    if len(in_window):
        winner = np.where(pixels.winner < 0, -1, in_window[pixels.winner])
        pixels = pixels._replace(winner=winner)
    beyond, reasons = _settled(points, camera, measured=pixels.inside)
    reason[points.index[points.far]] = reasons[points.far]
    better = beyond.inside
    pairs = zip(pixels, beyond, strict=True)
    return MeasuredPixels(*(np.where(better, far_value, value) for value, far_value in pairs))  # type: ignore[call-overload]


def _settled(
    points: PointsInImage, camera: Camera, measured: Bool | None = None
) -> tuple[MeasuredPixels, NDArray[np.uint8]]:
    """Return the pixels that points measure, and the (K,) `Reason` of every point."""
    hidden = distance_behind(points, camera) > 1
    reason = np.where(hidden, Reason.HIDDEN, Reason.NOT_CHOSEN).astype(np.uint8)
    pixel, winner, settled = _fit_surfaces(points, hidden, camera, measured)
    depth_m, num_sweeps, supported, edge = settled
    if measured is None:
        supported = supported > 0
        inside = edge >= 1
    else:
        # Beyond the window the sweep nearest to the key need not agree, but six sweeps must.
        supported, inside = num_sweeps >= _FAR_SWEEPS, edge >= _FAR_EDGE
        reason[winner[~inside]] = Reason.EDGE
    reason[winner[~supported]] = Reason.UNSUPPORTED
    kept = [column[supported] for column in (winner, depth_m, edge, inside)]
    return MeasuredPixels.at(camera, pixel[supported], *kept), reason


class _Visible(NamedTuple):
    """K points in an image, sorted by pixel, occluded points last in each pixel."""

    start: Int  # (H·W+1,) index of each pixel's first point, of `sorted_by_pixel`
    uv: Float  # (K,2) column and row in px
    inverse: Float  # (K,) inverse depth in 1/m
    slope: Float  # (K,2) slope of the inverse depth, 1/m per px
    edge_px: Float  # (K,) radius of a depth discontinuity
    spacing_px: Float  # (K,2) spacing of neighbouring rays
    sweep: NDArray[np.integer]  # (K,) frame number of the source sweep modulo 63
    hidden: Bool
    age_ns: Int  # (K,) time from the key sweep


def _fit_surfaces(
    points: PointsInImage, hidden: Bool, camera: Camera, measured: Bool | None
) -> tuple[Int, Int, Float32]:
    """Return pixels (P,) with visible points, the best point of each, and (4,P) of `_settle`."""
    last = int(points.age_ns.max(initial=0)) + 1
    start, order = sorted_by_pixel(points, np.where(hidden, last, points.age_ns), camera)
    settled = np.zeros((4, len(start) - 1), np.float32)
    done = np.zeros(len(start) - 1, bool) if measured is None else measured  # left out
    inverse = points.inverse
    edge_px = FOOTPRINT * points.spacing_px[:, 0] + _SLACK_M * points.focal_px[:, 0] * inverse
    visible = _Visible(
        start,
        points.uv.take(order, axis=0),
        inverse[order],
        points.slope.take(order, axis=0),
        edge_px[order],
        points.spacing_px.take(order, axis=0),
        points.frame[order] % _NUM_BITS,
        hidden[order],
        points.age_ns[order],
    )
    shape = (camera.height_px, camera.width_px)
    _settle.over_rows(len(done), visible, shape, done, settled)
    pixel = np.flatnonzero(settled[0])
    return pixel, order[start[pixel]], settled[:, pixel]


@inlined
def _window(reach_px):  # type: ignore[no-untyped-def]
    return int(min(max(np.rint(reach_px), _LEAST_PX), _MOST_PX))


@inlined
def _extend(reach, u, v):  # type: ignore[no-untyped-def]
    """Raise ``reach`` (8,), the extent of the surface in eight directions, by a point at (u, v)."""
    reach[0], reach[1] = max(reach[0], u), max(reach[1], -u)
    reach[2], reach[3] = max(reach[2], v), max(reach[3], -v)
    a, b = np.sqrt(0.5) * (u + v), np.sqrt(0.5) * (u - v)
    reach[4], reach[5] = max(reach[4], a), max(reach[5], -a)
    reach[6], reach[7] = max(reach[6], b), max(reach[7], -b)


@inlined
def _count(seen):  # type: ignore[no-untyped-def]
    """Return the number of sweeps, the bits set in ``seen``."""
    num_sweeps = 0
    while seen:
        num_sweeps += seen & 1
        seen >>= 1
    return num_sweeps


@inlined
def _look_round(points, shape, i, u0, v0, centre, agree, outer, m, reach):  # type: ignore[no-untyped-def]
    """Compare the points around pixel (v0, u0) with the tangent plane of point i."""
    # The plane has inverse depth centre (1/m) in the pixel, and visible points within agree (1/m)
    # of it agree. Points farther behind it within outer (px) show a discontinuity. Filled in are
    # the sums m (9,) of the fit, the first nine arguments of `plane` with the deviation from the
    # tangent plane as inverse depth, and the extent of the surface, reach (8,).
    start, uv = points.start, points.uv
    inverse, hidden, age_ns = points.inverse, points.hidden, points.age_ns
    su, sv, w0 = points.slope[i, 0], points.slope[i, 1], inverse[i]
    far = (HIDDEN_M + HIDDEN_FRACTION / w0) * w0 * w0
    reach_u = _window(_REACH * points.spacing_px[i, 0])
    reach_v = _window(_REACH * points.spacing_px[i, 1])
    wide_u, wide_v = max(reach_u, _window(outer)), max(reach_v, _window(outer))
    seen, behind = np.int64(0), False
    agree_ns = other_ns = age_ns[i]
    left, right = max(u0 - wide_u, 0), min(u0 + wide_u, shape[1] - 1)
    for v in range(max(v0 - wide_v, 0), min(v0 + wide_v, shape[0] - 1) + 1):
        for j in range(start[v * shape[1] + left], start[v * shape[1] + right + 1]):
            k = np.uint64(j)  # unsigned, so that no access checks for a negative index
            du, dv = uv[k, 0] - u0, uv[k, 1] - v0
            off = inverse[k] - (centre + su * du + sv * dv)
            close = abs(du) <= outer and abs(dv) <= outer
            vouches = abs(du) <= reach_u + 0.5 and abs(v - v0) <= reach_v
            if hidden[k] or abs(off) > agree:
                behind |= close and off < -far
                other_ns = min(other_ns, age_ns[k]) if vouches else other_ns
                continue
            # No branches: half of them would be predicted wrongly.
            seen |= np.int64(vouches) << np.int64(points.sweep[k])
            agree_ns = min(agree_ns, age_ns[k]) if vouches else agree_ns
            _extend(reach, du if close else 0.0, dv if close else 0.0)
            weight = max(1 - abs(du) / (reach_u + 1), 0.0) * max(1 - abs(dv) / (reach_v + 1), 0.0)
            m[0] += weight
            m[1] += weight * du
            m[2] += weight * dv
            m[3] += weight * du * du
            m[4] += weight * du * dv
            m[5] += weight * dv * dv
            m[6] += weight * off
            m[7] += weight * du * off
            m[8] += weight * dv * off
    # A bit for each sweep that agrees; True if no other sweep there is nearer to the key; True if a
    # point is close behind.
    return seen, agree_ns <= other_ns, behind


@Kernel
def _settle(first, last, points, shape, done, settled):  # type: ignore[no-untyped-def]
    """Find the depth of each pixel from the surrounding points that agree with its first point."""
    # settled (4,P): depth (m), sweeps that agree, 1 if no sweep nearer to the key disagrees, extent
    # of the surface in radii of discontinuities
    m, reach = np.empty(9), np.empty(8)
    for p in range(first, last):
        i = points.start[p]
        if done[p] or i == points.start[p + 1] or points.hidden[i]:
            continue
        v0, u0 = p // shape[1], p % shape[1]
        w0, uv, slope = points.inverse[i], points.uv[i], points.slope[i]
        centre = w0 + slope[0] * (u0 - uv[0]) + slope[1] * (v0 - uv[1])
        agree = (AGREE_M + AGREE_FRACTION / w0) * w0 * w0
        inner = points.edge_px[i]
        m[:], reach[:] = 0.0, 0.0
        seen, supported, behind = _look_round(
            points, shape, i, u0, v0, centre, agree, inner + _EDGE_WINDOW_PX, m, reach
        )
        off, _, _ = plane(m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], _RIDGE_PX2)
        settled[0, p] = 1 / limited(centre + min(max(off, -agree), agree), w0)
        settled[1, p], settled[2, p] = _count(seen), supported
        settled[3, p] = ALL_ROUND
        if behind and inner > 0:
            least_extent = reach[0]
            for extent in reach[1:]:
                least_extent = min(least_extent, extent)
            settled[3, p] = least_extent / inner
