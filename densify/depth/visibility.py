# SPDX-License-Identifier: MIT
"""What points hide in an image, and which depth those give that show, compiled: see
`densify.depth.project`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Int
from densify.geometry.compiled import Kernel, inlined

NOW_NS = 60_000_000
"""Older is not the key sweep."""

_RIDGE_PX2 = 0.02
_LEAST_WINDOW_PX, _LEAST_FIT_PX, _MOST_PX = 3, 2.0, 24
_MOVING_SLACK = 4.0  # motion is known less well than where things stand
_MOVING_WITNESS_NS = 120_000_000  # from the key
_CLEARLY = 0.25  # of the squared distance
_ALONE = 0.5  # squared spacings; a ray of each sweep falls nearer to every point of a surface
_GOES_ON = 1.2  # spacings within which a surface shows again
_ANY_AGE_NS = 1 << 62
_ALL_ROUND = 3.0  # edges' reaches: no edge near
_DIAGONAL = np.sqrt(0.5)


@Kernel
def paint(uv, inverse, slope, half_px, canvas):  # type: ignore[no-untyped-def]
    """canvas: (H,W) float32, raised to the greatest inverse depth of the patches over a pixel.

    uv, slope, half_px: (K,2); inverse: (K,). A patch covers the pixel centres within ``half_px`` of
    its point, with inverse depth ``inverse + slope · offset``, between half of ``inverse`` and all
    of it.
    """
    height, width = canvas.shape
    for i in range(len(inverse)):
        w = inverse[i]
        left = max(int(np.ceil(uv[i, 0] - half_px[i, 0])), 0)
        right = min(int(np.floor(uv[i, 0] + half_px[i, 0])), width - 1)
        top = max(int(np.ceil(uv[i, 1] - half_px[i, 1])), 0)
        bottom = min(int(np.floor(uv[i, 1] + half_px[i, 1])), height - 1)
        for v in range(top, bottom + 1):
            tilt_v = slope[i, 1] * (v - uv[i, 1])
            covered = canvas[v, left : right + 1]
            for k in range(len(covered)):
                tilt = tilt_v + slope[i, 0] * (left + k - uv[i, 0])
                there = w + min(max(tilt, -0.5 * w), 0.0)
                covered[k] = max(covered[k], np.float32(there))


@inlined
def _before(a, b, rank, depth, frame, uv, confidence):  # type: ignore[no-untyped-def]
    """Does point a win a pixel over b? Equal points change nothing whichever comes first."""
    if rank[a] != rank[b]:
        return rank[a] < rank[b]
    if depth[a] != depth[b]:
        return depth[a] < depth[b]
    if frame[a] != frame[b]:
        return frame[a] < frame[b]
    if uv[a, 0] != uv[b, 0]:
        return uv[a, 0] < uv[b, 0]
    if uv[a, 1] != uv[b, 1]:
        return uv[a, 1] < uv[b, 1]
    return confidence[a] > confidence[b]


@Kernel
def by_pixel(pixel, rank, depth, frame, uv, confidence, start, order):  # type: ignore[no-untyped-def]
    """Points sorted by pixel, and in each pixel by rank, then by depth.

    pixel, rank: (K,) int64. Filled: start (num_pixels + 1,)
    int64 and order (K,) int64: of pixel p the points ``order[start[p]:start[p + 1]]``.
    """
    start[:] = 0
    for p in pixel:
        start[p + 1] += 1
    for p in range(len(start) - 1):
        start[p + 1] += start[p]
    filled = np.zeros(len(start) - 1, np.int32)
    for i in range(len(pixel)):
        p = pixel[i]
        at = start[p] + filled[p]
        while at > start[p] and _before(i, order[at - 1], rank, depth, frame, uv, confidence):
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
        filled[p] += 1


@inlined
def _centre(m):  # type: ignore[no-untyped-def]
    """Value in the origin of the weighted least-squares plane with moments n u v uu uv vv w uw vw;
    the ridge keeps points that lie on one line, or nearly so, from tilting it."""
    n = m[0]
    u, v, w = m[1] / n, m[2] / n, m[6] / n
    uu, vv = m[3] / n - u * u + _RIDGE_PX2, m[5] / n - v * v + _RIDGE_PX2
    uv, uw, vw = m[4] / n - u * v, m[7] / n - u * w, m[8] / n - v * w
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    return w - slope_u * u - slope_v * v


@inlined
def _add(m, weight, u, v, w):  # type: ignore[no-untyped-def]
    m[0] += weight
    m[1] += weight * u
    m[2] += weight * v
    m[3] += weight * u * u
    m[4] += weight * u * v
    m[5] += weight * v * v
    m[6] += weight * w
    m[7] += weight * u * w
    m[8] += weight * v * w


@inlined
def _window(reach_px):  # type: ignore[no-untyped-def]
    return int(min(max(np.rint(reach_px), _LEAST_WINDOW_PX), _MOST_PX))


@inlined
def _fit(reach_px):  # type: ignore[no-untyped-def]
    """Where the weight has fallen to zero."""
    return min(max(reach_px, _LEAST_FIT_PX), _MOST_PX) + 1


@inlined
def _extend(reach, u, v):  # type: ignore[no-untyped-def]
    """How far points lie in eight directions."""
    reach[0], reach[1] = max(reach[0], u), max(reach[1], -u)
    reach[2], reach[3] = max(reach[2], v), max(reach[3], -v)
    a, b = _DIAGONAL * (u + v), _DIAGONAL * (u - v)
    reach[4], reach[5] = max(reach[4], a), max(reach[5], -a)
    reach[6], reach[7] = max(reach[6], b), max(reach[7], -b)


@inlined
def _count(seen):  # type: ignore[no-untyped-def]
    """Bits of the sweeps seen."""
    num_sweeps = 0
    while seen:
        num_sweeps += seen & 1
        seen >>= 1
    return num_sweeps


@inlined
def _write(found, centre, w0, agree, m, squares, num, seen, youngest):  # type: ignore[no-untyped-def]
    """found: (7,) of `settle`, as if no depth edge were near. centre: expected inverse depth, w0:
    the first point's. m, squares: moments of what lies off it, within ``agree``, of ``num`` points.
    seen: a bit for each sweep."""
    best = min(max(_centre(m), -agree), agree)
    found[0] = 1 / (centre + best)
    found[1], found[2], found[3] = _count(seen), youngest, num
    mean = m[6] / m[0]
    found[4] = np.sqrt(max(squares / m[0] - mean * mean, 0.0)) / (w0 * w0)
    found[5] = _ALL_ROUND


@inlined
def _shortest(reach):  # type: ignore[no-untyped-def]
    shortest = reach[0]
    for side in range(1, len(reach)):
        shortest = min(shortest, reach[side])
    return shortest


class Visible(NamedTuple):
    """K points in an image, in the order of `by_pixel`, hidden ones last in each pixel.

    start: of `by_pixel`. uv: (K,2) px. inverse: (K,) depth, 1/m. slope:
    (K,2) of the tangent plane's inverse depth, 1/m per px. spacing_px: (K,2) between neighbouring
    rays. edge_px: (K,) added to the reach of a depth edge. sweep: (K,) from 0 to 62. hidden,
    moving: (K,). age_ns: (K,) from the key.
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


class Reaches(NamedTuple):
    """How far `settle` looks around a point, and what it takes for one surface.

    support, plane: reach of the support and of the fitted plane, in ray spacings. agree_m,
    agree_fraction: metres and share of the depth within which points agree; behind_m,
    behind_fraction: the same beyond which one lies behind. edge: reach of a depth edge in ray
    spacings, edge_window_px: px beyond it where is looked for what goes on. few: with fewer sweeps
    that agree with it a return of the key sweep is judged by the key sweep alone.
    """

    support: float
    plane: float
    agree_m: float
    agree_fraction: float
    behind_m: float
    behind_fraction: float
    edge: float
    edge_window_px: float
    few: int


@inlined
def _expected(points, i, u0, v0):  # type: ignore[no-untyped-def]
    """Inverse depth of point i's tangent plane in a pixel."""
    w0, uv = points.inverse[i], points.uv
    centre = w0 + points.slope[i, 0] * (u0 - uv[i, 0]) + points.slope[i, 1] * (v0 - uv[i, 1])
    return min(max(centre, 0.8 * w0), 1.25 * w0)


@inlined
def _look_round(points, reaches, shape, i, u0, v0, centre, agree, inner, witness_ns, m, reach):  # type: ignore[no-untyped-def]
    """The points around a pixel beside point i's tangent plane, ``centre`` in the pixel.

    witness_ns: how long before or after the key what lies behind tells of an edge; `_ANY_AGE_NS`
    for what stands. Fills the moments m and how far the surface goes on, reach. Returns a bit for
    each sweep that agrees, the age of the youngest, points in the fit, their weighted squares,
    whether something lies behind close by, and of a mover the squared distances in ray spacings to
    what the key sweep saw of its surface and behind it, and how many returns of the key agree.
    """
    start, uv = points.start, points.uv
    inverse, hidden, age_ns = points.inverse, points.hidden, points.age_ns
    across, along = points.spacing_px[i, 0], points.spacing_px[i, 1]
    su, sv, w0 = points.slope[i, 0], points.slope[i, 1], inverse[i]
    moving = witness_ns < _ANY_AGE_NS
    far = (reaches.behind_m + reaches.behind_fraction / w0) * w0 * w0
    outer = inner + reaches.edge_window_px
    # What moves is seen by its sweeps in the same rings.
    on_v = max(outer, _GOES_ON * along) if moving else outer
    # Whether enough sweeps agree does not depend on how far edges are looked for.
    support_u, support_v = _window(reaches.support * across), _window(reaches.support * along)
    wide_u, wide_v = max(support_u, _window(outer)), max(support_v, _window(on_v))
    fit_u, fit_v = _fit(reaches.plane * across), _fit(reaches.plane * along)
    seen, num, youngest, behind, squares = np.int64(0), 0, age_ns[i], False, 0.0
    now, now_behind, num_now = np.inf, np.inf, 0
    left, right = max(u0 - wide_u, 0), min(u0 + wide_u, shape[1] - 1)
    for v in range(max(v0 - wide_v, 0), min(v0 + wide_v, shape[0] - 1) + 1):
        for j in range(start[v * shape[1] + left], start[v * shape[1] + right + 1]):
            k = np.uint64(j)  # no place from the end on, which would be looked for at each access
            du, dv = uv[k, 0] - u0, uv[k, 1] - v0
            off = inverse[k] - (centre + su * du + sv * dv)
            away = np.inf
            if moving and age_ns[k] <= NOW_NS:
                away = (du / across) ** 2 + (dv / along) ** 2
            if (hidden[k] and not hidden[i]) or abs(off) > agree:
                if off >= -far:
                    continue
                close = abs(du) <= outer and abs(dv) <= outer
                behind |= close and age_ns[k] <= witness_ns
                if moving:
                    now_behind = min(now_behind, away)
                continue
            if moving:
                now = min(now, away)
                around = abs(du) <= _GOES_ON * across and abs(dv) <= _GOES_ON * along
                num_now += around and away < np.inf
            # Without branches, of which half would be foretold wrongly.
            vouches = abs(du) <= support_u + 0.5 and abs(v - v0) <= support_v
            seen |= np.int64(vouches) << np.int64(points.sweep[k])
            youngest = min(youngest, age_ns[k]) if vouches else youngest
            goes_on = abs(du) <= outer and abs(dv) <= on_v
            _extend(reach, du if goes_on else 0.0, dv if goes_on else 0.0)
            weight = max(1 - abs(du) / fit_u, 0.0) * max(1 - abs(dv) / fit_v, 0.0)
            _add(m, weight, du, dv, off)
            squares += weight * off * off
            num += abs(du) < fit_u and abs(dv) < fit_v
    return seen, youngest, num, squares, behind, now, now_behind, num_now


@Kernel
def settle(first, last, points, reaches, shape, taken, found):  # type: ignore[no-untyped-def]
    """Each pixel's depth from the points around that agree with its first point.

    points: `Visible`. reaches: `Reaches`. shape: (height, width). taken: (P,) bool, pixels to leave
    alone. found: (7,P) float32, filled where there is a point with depth, number of sweeps that
    agree, age of the youngest of them, points in the fit, their root mean square residual (m), how
    far the surface goes on to all sides, as a share of the edges' reach, and see below. Hidden
    points agree with a hidden one only.

    Limbs swing, so a mover's other sweeps tell less of its outline than the key sweep: where that
    saw past the mover nearer by than it saw the mover, an edge is near (0); at half the distance,
    or if it should have met the mover there and did not, the pixel shows what is behind (-1). An
    edge is near too where it should have met the mover and saw past it anywhere around.

    What the key sweep saw and fewer than `Reaches.few` sweeps agree with may have moved unnoticed:
    it is judged as a mover is, by the key sweep alone, and the last row says how many returns of
    the key sweep agree within 1.2 spacings.
    """
    m, reach = np.zeros(9), np.zeros(8)
    for p in range(first, last):
        if taken[p] or points.start[p] == points.start[p + 1]:
            continue
        i = points.start[p]
        v0, u0 = p // shape[1], p % shape[1]
        w0, centre = points.inverse[i], _expected(points, i, u0, v0)
        agree = (reaches.agree_m + reaches.agree_fraction / w0) * w0 * w0
        edge_px = points.edge_px[i] * (_MOVING_SLACK if points.moving[i] else 1.0)
        inner = reaches.edge * points.spacing_px[i, 0] + edge_px
        m[:], reach[:] = 0.0, 0.0
        # Other sweeps saw the background where the mover was not yet, or no more.
        witness_ns = _MOVING_WITNESS_NS if points.moving[i] else _ANY_AGE_NS
        seen, youngest, num, squares, behind, now, now_behind, num_now = _look_round(
            points, reaches, shape, i, u0, v0, centre, agree, inner, witness_ns, m, reach
        )
        if points.age_ns[i] <= NOW_NS and not points.hidden[i] and _count(seen) < reaches.few:
            m[:], reach[:] = 0.0, 0.0
            now_ns = np.int64(NOW_NS)  # of the type of witness_ns, or this is compiled twice
            seen, youngest, num, squares, behind, now, now_behind, num_now = _look_round(
                points, reaches, shape, i, u0, v0, centre, agree, inner, now_ns, m, reach
            )
            found[6, p] = num_now
        _write(found[:, p], centre, w0, agree, m, squares, num, seen, youngest)
        if behind and inner > 0:
            found[5, p] = _shortest(reach) / inner
        alone = now > _ALONE
        if now_behind < now:
            found[5, p] = -1.0 if alone or now_behind < _CLEARLY * now else 0.0
        elif alone and now_behind < np.inf:
            found[5, p] = 0.0
