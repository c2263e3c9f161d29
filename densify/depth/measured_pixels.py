# SPDX-License-Identifier: MIT
"""Compute the depth that the points in an image give its pixels.

Among the points in a pixel that are not occluded, the point measured nearest in time to the key
sweep wins. A plane is fitted to the surrounding points that agree with it, and the pixel gets the
depth of the plane at its centre. The pixel is measured if enough sweeps agree. Close to a depth
discontinuity it becomes a boundary pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.boundary_pixels import MOST_CONFIDENCE
from densify.depth.image_points import (
    HIDDEN_FRACTION,
    HIDDEN_M,
    PointsInImage,
    distance_behind,
    sorted_by_pixel,
)
from densify.depth.neighbours import plane
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Camera, Reason

AGREE_M, AGREE_FRACTION = 0.1, 0.01
"""Greatest deviation between points on one surface: metres plus share of the depth."""
_SUPPORT_REACH, _PLANE_REACH = 0.8, 0.5  # radius of support, of the plane; spacings of rays
_EDGE_REACH, _EDGE_SLACK_M = 0.35, 0.015  # radius of a discontinuity: spacings in azimuth; slack
_EDGE_WINDOW_PX = 1.5  # width beyond the edge in which points must continue the surface
# Points beyond the window continue a surface behind a nearer one. Therefore both are stricter.
_FAR_SUPPORT, _FAR_EDGE = 6, 1.5
# Greatest loss of confidence by few sweeps, few points, a near edge, a rough fit, occlusion.
_DOUBTS = np.array([0.45, 0.25, 0.20, 0.10, 0.10])
_MANY_POINTS, _ROUGH_M = 20, 0.10
_RIDGE_PX2 = 0.02
_LEAST_WINDOW_PX, _LEAST_FIT_PX, _MOST_PX = 3, 2.0, 24
_MOVING_SLACK = 4.0  # motion is known less well than static surfaces
_MOVING_WITNESS_NS = 120_000_000  # greatest time from the key
_GOES_ON = 1.2  # spacings within which a surface must continue
_ALL_ROUND = 3.0  # in radii of a discontinuity; farther than this none is near
_LEAST_ALONE = 5  # agreeing returns of the key sweep among nine: a return and its neighbours
_NEVER_NS = int(np.iinfo(np.int64).max)


class MeasuredPixels(NamedTuple):
    """The H·W pixels of an image, row by row.

    Attributes:
        winner: (H·W,) index, in `PointsInImage`, of the point that gives the depth; -1 none.
        depth_m: (H·W,) float32 depth in metres.
        confidence: (H·W,) float32 rank from 0 to 1.
        inside: (H·W,) True if no depth discontinuity is near.
        behind_patch: (H·W,) mask as in `densify.depth.layers.Layers`.
        key_only: (H·W,) mask as in `densify.depth.layers.Layers`.
    """

    winner: Int
    depth_m: Float32
    confidence: Float32
    inside: Bool
    behind_patch: Bool
    key_only: Bool

    @staticmethod
    def at(camera: Camera, pixel: Int, *columns: np.ndarray) -> MeasuredPixels:
        """Return an image with columns (P,) at flat indices ``pixel`` (P,), empty elsewhere."""
        num = camera.height_px * camera.width_px
        images = [np.full(num, -1, np.int64), *(np.zeros(num, c.dtype) for c in columns[1:])]
        for image, column in zip(images, columns, strict=True):
            image[pixel] = column
        return MeasuredPixels(*images)


def nearest_pixels(
    points: PointsInImage, own: Float32, camera: Camera, reason: NDArray[np.uint8]
) -> MeasuredPixels:
    """Return the nearest point of each pixel, without occlusion or support tests.

    Args:
        own: (K,) confidence of the points.
        reason: (M,) `Reason` of each point of the cloud, changed in place to NOT_CHOSEN.
    """
    start, order = sorted_by_pixel(points, np.zeros(len(own), np.int64), own, camera)
    pixel = np.flatnonzero(np.diff(start))
    nearest = order[start[pixel]]
    reason[points.index] = Reason.NOT_CHOSEN
    no = np.zeros(len(pixel), bool)
    depth_m, confidence = points.depth[nearest], own[nearest]
    return MeasuredPixels.at(camera, pixel, nearest, depth_m, confidence, ~no, no, no)


def visible_pixels(
    points: PointsInImage,
    own: Float32,
    camera: Camera,
    support: int,
    reason: NDArray[np.uint8],
) -> MeasuredPixels:
    """Return the pixels that visible points measure.

    Points beyond the window come second. They measure pixels that the window leaves empty, away
    from depth discontinuities, and support pixels that few sweeps of the window measured.

    Args:
        own: (K,) confidence of the points.
        support: Least number of sweeps that agree with a point.
        reason: (M,) `Reason` of each point of the cloud, changed in place for points in the image.
    """
    near = np.flatnonzero(~points.far)
    pixels, why = _settled(points.select(~points.far), own[near], camera, support)
    reason[points.index[near]] = why
    if len(near) == len(own):
        return pixels
    if len(near):
        winner = np.where(pixels.winner < 0, -1, near[pixels.winner])
        pixels = pixels._replace(winner=winner)
    beyond, why = _settled(points, own, camera, support, taken=pixels.inside)
    reason[points.index[points.far]] = why[points.far]
    better = beyond.inside
    both = zip(pixels, beyond, strict=True)
    return MeasuredPixels(*(np.where(better, b, n) for n, b in both))  # type: ignore[call-overload]


def _settled(
    points: PointsInImage,
    own: Float32,
    camera: Camera,
    support: int,
    taken: Bool | None = None,
) -> tuple[MeasuredPixels, NDArray[np.uint8]]:
    """Return the pixels that points measure, and the (K,) `Reason` of every point.

    Several returns of the key sweep are enough support, because an undetected moving object was
    elsewhere at other times. taken: (H·W,) pixels to leave alone. If given, the others get the
    stricter rules for points beyond the window.
    """
    many = int(points.sweep.max(initial=0)) + 1
    least = min(support, max(1, many // 2))
    behind = distance_behind(points, camera)
    hidden = behind > 1
    reason = np.where(hidden, Reason.HIDDEN, Reason.NOT_CHOSEN).astype(np.uint8)
    pixel, winner, found = _found(points, hidden, own, camera, least, taken)
    depth_m, num_sweeps, youngest_ns, num_points, residual_m, edge, num_now = found
    behind_patch = hidden[winner]
    key_only = num_now >= _LEAST_ALONE
    if taken is None:
        supported = num_sweeps >= least
        supported &= youngest_ns <= np.float32(points.age_ns.min(initial=_NEVER_NS))
        supported |= key_only
        inside = edge >= 1
    else:
        many, supported, inside = 2 * _FAR_SUPPORT, num_sweeps >= _FAR_SUPPORT, edge >= _FAR_EDGE
        reason[winner[~inside & ~behind_patch]] = Reason.EDGE
    reason[winner[~supported & ~behind_patch]] = Reason.UNSUPPORTED
    doubts = np.stack(
        [
            1 - np.minimum(num_sweeps / many, 1),
            1 - np.minimum(num_points / _MANY_POINTS, 1),
            np.clip(3 - edge, 0, 2) / 2,
            np.minimum(residual_m / _ROUGH_M, 1),
            np.clip(behind[winner], 0, 1),
        ]
    )
    confidence = np.maximum(own[winner] * (1 - _DOUBTS @ doubts), MOST_CONFIDENCE)
    inside &= ~behind_patch
    columns = winner, depth_m, confidence.astype(np.float32), inside, behind_patch, key_only
    kept = [column[supported] for column in columns]
    return MeasuredPixels.at(camera, pixel[supported], *kept), reason


class _Visible(NamedTuple):
    """K points in an image, sorted by pixel, occluded points last in each pixel.

    Attributes:
        start: (H·W+1,) index of each pixel's first point, of `sorted_by_pixel`.
        uv: (K,2) column and row in px.
        inverse: (K,) inverse depth in 1/m.
        slope: (K,2) slope of the inverse depth, 1/m per px.
        spacing_px: (K,2) spacing of neighbouring rays.
        edge_px: (K,) pixels added to the radius of a depth discontinuity.
        sweep: (K,) number of the source, 0 to 62.
        age_ns: (K,) time from the key sweep.
    """

    start: Int
    uv: Float
    inverse: Float
    slope: Float
    spacing_px: Float
    edge_px: Float
    sweep: NDArray[np.integer]
    hidden: Bool
    moving: Bool
    age_ns: Int


def _found(
    points: PointsInImage,
    hidden: Bool,
    own: Float32,
    camera: Camera,
    least: int,
    taken: Bool | None,
) -> tuple[Int, Int, Float32]:
    """Return the pixels (P,) with points, the best point of each (P,), and (7,P) of `_settle`.

    If ``taken`` is given, its pixels are left out, and so are pixels with only occluded points.
    """
    last = int(points.age_ns.max(initial=0)) + 1
    late = points.age_ns > 0
    rank = np.where(hidden, last + late, points.age_ns)
    start, order = sorted_by_pixel(points, rank, own, camera)
    found = np.zeros((7, len(start) - 1), np.float32)
    done = np.zeros(len(start) - 1, bool)
    if taken is not None:
        some = np.flatnonzero(np.diff(start))
        done[some[hidden[order[start[some]]]]] = True
        done[taken] = True
    inverse = points.inverse
    edge_px = _EDGE_SLACK_M * points.focal_px[:, 0] * inverse
    visible = _Visible(
        start,
        points.uv.take(order, axis=0),
        inverse[order],
        points.slope.take(order, axis=0),
        points.spacing_px.take(order, axis=0),
        edge_px[order],
        points.sweep[order],
        hidden[order],
        points.moving[order],
        points.age_ns[order],
    )
    few, shape = 0 if taken is not None else least, (camera.height_px, camera.width_px)
    _settle.over_rows(len(done), visible, few, shape, done, found)
    pixel = np.flatnonzero(found[0])
    return pixel, order[start[pixel]], found[:, pixel]


@inlined
def _window(reach_px):  # type: ignore[no-untyped-def]
    return int(min(max(np.rint(reach_px), _LEAST_WINDOW_PX), _MOST_PX))


@inlined
def _fit(reach_px):  # type: ignore[no-untyped-def]
    """Return the distance at which the weight in the plane fit has fallen to zero."""
    return min(max(reach_px, _LEAST_FIT_PX), _MOST_PX) + 1


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
def _look_round(points, shape, i, u0, v0, centre, agree, inner, witness_ns, m, reach):  # type: ignore[no-untyped-def]
    """Compare the points around pixel (v0, u0) with the tangent plane of point i.

    The plane has inverse depth ``centre`` (1/m) in the pixel, and points within ``agree`` (1/m) of
    it agree. inner: radius of discontinuities, px. witness_ns: greatest age of a point behind the
    plane that shows a discontinuity, `_NEVER_NS` for static points. The moments m (9,) of the fit
    and the extent of the surface, reach (8,), are filled in. Return a bit for each sweep that
    agrees, the age of the youngest of these sweeps, and the number of points in the fit. Return
    also their weighted sum of squares, True if a point is close behind, and for a moving point the
    number of agreeing returns of the key sweep.
    """
    start, uv = points.start, points.uv
    inverse, hidden, age_ns = points.inverse, points.hidden, points.age_ns
    across, along = points.spacing_px[i, 0], points.spacing_px[i, 1]
    su, sv, w0 = points.slope[i, 0], points.slope[i, 1], inverse[i]
    moving = witness_ns < _NEVER_NS
    far = (HIDDEN_M + HIDDEN_FRACTION / w0) * w0 * w0
    outer = inner + _EDGE_WINDOW_PX
    # Sweeps measure a moving object with the same rings.
    on_v = max(outer, _GOES_ON * along) if moving else outer
    support_u, support_v = _window(_SUPPORT_REACH * across), _window(_SUPPORT_REACH * along)
    wide_u, wide_v = max(support_u, _window(outer)), max(support_v, _window(on_v))
    fit_u, fit_v = _fit(_PLANE_REACH * across), _fit(_PLANE_REACH * along)
    seen, num, youngest, behind, squares = np.int64(0), 0, age_ns[i], False, 0.0
    num_now = 0
    left, right = max(u0 - wide_u, 0), min(u0 + wide_u, shape[1] - 1)
    for v in range(max(v0 - wide_v, 0), min(v0 + wide_v, shape[0] - 1) + 1):
        for j in range(start[v * shape[1] + left], start[v * shape[1] + right + 1]):
            k = np.uint64(j)  # unsigned, so that no access checks for a negative index
            du, dv = uv[k, 0] - u0, uv[k, 1] - v0
            off = inverse[k] - (centre + su * du + sv * dv)
            if (hidden[k] and not hidden[i]) or abs(off) > agree:
                if off >= -far:
                    continue
                close = abs(du) <= outer and abs(dv) <= outer
                behind |= close and age_ns[k] <= witness_ns
                continue
            if moving and age_ns[k] == 0:
                num_now += abs(du) <= _GOES_ON * across and abs(dv) <= _GOES_ON * along
            # No branches: half of them would be predicted wrongly.
            vouches = abs(du) <= support_u + 0.5 and abs(v - v0) <= support_v
            seen |= np.int64(vouches) << np.int64(points.sweep[k])
            youngest = min(youngest, age_ns[k]) if vouches else youngest
            goes_on = abs(du) <= outer and abs(dv) <= on_v
            _extend(reach, du if goes_on else 0.0, dv if goes_on else 0.0)
            weight = max(1 - abs(du) / fit_u, 0.0) * max(1 - abs(dv) / fit_v, 0.0)
            m[0] += weight
            m[1] += weight * du
            m[2] += weight * dv
            m[3] += weight * du * du
            m[4] += weight * du * dv
            m[5] += weight * dv * dv
            m[6] += weight * off
            m[7] += weight * du * off
            m[8] += weight * dv * off
            squares += weight * off * off
            num += abs(du) < fit_u and abs(dv) < fit_v
    return seen, youngest, num, squares, behind, num_now


@Kernel
def _settle(first, last, points, few, shape, taken, found):  # type: ignore[no-untyped-def]
    """Find the depth of each pixel from the surrounding points that agree with its first point.

    If fewer than ``few`` sweeps agree, a return of the key sweep is compared with that sweep only,
    as a moving point is. Occluded points agree with occluded points only. points: `_Visible`.
    taken: (P,) pixels to leave alone. found: (7,P) float32 output: depth (m), number of sweeps that
    agree, age of the youngest (ns), number of points in the fit, their root mean square residual
    (m), extent of the surface as a multiple of the radius of discontinuities, and number of
    agreeing returns of the key sweep.
    """
    m, reach = np.empty(9), np.empty(8)
    for p in range(first, last):
        if taken[p] or points.start[p] == points.start[p + 1]:
            continue
        i = points.start[p]
        v0, u0 = p // shape[1], p % shape[1]
        w0, uv, slope = points.inverse[i], points.uv[i], points.slope[i]
        centre = w0 + slope[0] * (u0 - uv[0]) + slope[1] * (v0 - uv[1])
        centre = min(max(centre, 0.8 * w0), 1.25 * w0)
        agree = (AGREE_M + AGREE_FRACTION / w0) * w0 * w0
        edge_px = points.edge_px[i] * (_MOVING_SLACK if points.moving[i] else 1.0)
        inner = _EDGE_REACH * points.spacing_px[i, 0] + edge_px
        m[:], reach[:] = 0.0, 0.0
        # Other sweeps measured the background before and after the moving object was here.
        witness_ns = _MOVING_WITNESS_NS if points.moving[i] else _NEVER_NS
        seen, youngest, num, squares, behind, num_now = _look_round(
            points, shape, i, u0, v0, centre, agree, inner, witness_ns, m, reach
        )
        if points.age_ns[i] == 0 and not points.hidden[i] and _count(seen) < few:
            m[:], reach[:] = 0.0, 0.0
            now_ns = np.int64(0)  # of the type of witness_ns, or this is compiled twice
            seen, youngest, num, squares, behind, num_now = _look_round(
                points, shape, i, u0, v0, centre, agree, inner, now_ns, m, reach
            )
            found[6, p] = num_now
        off, _, _ = plane(m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], _RIDGE_PX2)
        found[0, p] = 1 / (centre + min(max(off, -agree), agree))
        found[1, p], found[2, p], found[3, p] = _count(seen), youngest, num
        mean = m[6] / m[0]
        found[4, p] = np.sqrt(max(squares / m[0] - mean * mean, 0.0)) / (w0 * w0)
        found[5, p] = _ALL_ROUND
        if behind and inner > 0:
            least = reach[0]
            for far in reach[1:]:
                least = min(least, far)
            found[5, p] = least / inner
