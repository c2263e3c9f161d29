# SPDX-License-Identifier: MIT
"""Pixels behind a frame that lies in one plane, compiled: see `densify.depth.glass`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.kernels import Kernel, inlined
from densify.kernels.marching import NONE

_RIDGE_PX2 = 1e-7  # gives the slope of least norm where the frame lies on one line


class Rules(NamedTuple):
    """What makes a frame. focal_px: of the map. reach_m, reach_px: how far from the pixel it may
    be, the less of both. behind_m, most_m: how far the pixel lies behind its plane, at least and at
    most; each_m: behind each of its parts. empty_m: an empty pixel counts as so far behind the
    farthest of the first known pixels around. open: most directions in which there is no frame, or
    one off the plane. rough_m, off_m: by more than this, of a frame roughly found and found again.
    touch_m: a ray comes to the plane where a surface is at most so far behind it. lean: most metres
    of depth per metre of height."""

    focal_px: float
    reach_m: float
    reach_px: int
    behind_m: float
    most_m: float
    each_m: float
    empty_m: float
    open: int
    rough_m: float
    touch_m: float
    off_m: float
    lean: float


@inlined
def _offset(directions, d, k):  # type: ignore[no-untyped-def]
    """Columns and rows after k steps."""
    du = (k // 2) * directions[d, 1, 0] + (k % 2) * directions[d, 0, 0]
    dv = (k // 2) * directions[d, 1, 1] + (k % 2) * directions[d, 0, 1]
    return du, dv


@inlined
def _plane(parts):  # type: ignore[no-untyped-def]
    """Inverse depth in the origin and its two slopes: least squares over (n,3) offsets and inverse
    depths."""
    n, u, v, w = float(len(parts)), 0.0, 0.0, 0.0
    for part in parts:
        u += part[0] / n
        v += part[1] / n
        w += part[2] / n
    uu, vv, uv, uw, vw = _RIDGE_PX2 * n, _RIDGE_PX2 * n, 0.0, 0.0, 0.0
    for part in parts:
        du, dv, dw = part[0] - u, part[1] - v, part[2] - w
        uu += du * du
        uv += du * dv
        vv += dv * dv
        uw += du * dw
        vw += dv * dw
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    return w - slope_u * u - slope_v * v, slope_u, slope_v


@inlined
def _is_before(depth, plane, parts, off_m, rules):  # type: ignore[no-untyped-def]
    """Whether the plane stands upright before what is ``depth`` metres away, and the frame in it:
    in all but ``rules.open`` of the sixteen directions."""
    centre, slope_u, slope_v = plane
    if centre * (depth - rules.behind_m) <= 1 or centre * (depth - rules.most_m) > 1:
        return False
    if abs(slope_v) * rules.focal_px > rules.lean * centre:
        return False
    num = 0
    for part in parts:
        there = centre + slope_u * part[0] + slope_v * part[1]
        num += there > 0 and abs(1 / there - 1 / part[2]) <= off_m
    return num >= 16 - rules.open


@inlined
def _depth(row, column, near, far, steps, directions, rules):  # type: ignore[no-untyped-def]
    """How far away a pixel is, guessed where it is empty; 0 where nothing is around."""
    if far[row, column] > 0:
        return 1 / far[row, column]
    farthest = 0.0
    for d in range(len(directions)):
        k = np.int64(steps[d, row, column])
        if k != NONE and k <= rules.reach_px:
            du, dv = _offset(directions, d, k)
            farthest = max(farthest, 1 / near[row + dv, column + du] + rules.empty_m)
    return farthest


@inlined
def _nearest_parts(row, column, depth, reach_px, near, directions, rules, parts, which):  # type: ignore[no-untyped-def]
    """The nearest surface on the way in each direction, where it lies before the pixel: how many;
    gives up once too many directions are open."""
    height, width = near.shape
    num = 0
    for i in range(len(directions)):
        d = i * 5 % len(directions)  # sides far apart first
        parts[num, 2] = 0.0
        for k in range(1, reach_px + 1):
            du, dv = _offset(directions, d, k)
            u, v = column + du, row + dv
            if not (0 <= u < width and 0 <= v < height):
                break
            if near[v, u] > parts[num, 2]:
                parts[num, 0], parts[num, 1], parts[num, 2] = du, dv, near[v, u]
        if parts[num, 2] * (depth - rules.each_m) > 1 >= parts[num, 2] * (depth - rules.most_m):
            which[num] = d
            num += 1
        elif i - num >= rules.open:
            return 0
    return num


@inlined
def _touching_parts(row, column, reach_px, near, directions, rules, plane, which, num, parts):  # type: ignore[no-untyped-def]
    """Where each ray first comes to a surface that touches the plane: how many do."""
    height, width = near.shape
    centre, slope_u, slope_v = plane
    hits = 0
    for i in range(num):
        for k in range(1, reach_px + 1):
            du, dv = _offset(directions, which[i], k)
            u, v = column + du, row + dv
            if not (0 <= u < width and 0 <= v < height):
                break
            there = near[v, u]
            fitted = centre + slope_u * du + slope_v * dv
            if there > 0 and fitted > 0 and 1 / there < 1 / fitted + rules.touch_m:
                parts[hits, 0], parts[hits, 1], parts[hits, 2] = du, dv, there
                hits += 1
                break
    return hits


@Kernel
def framed(first, last, near, far, known, steps, directions, rules, found):  # type: ignore[no-untyped-def]
    """The plane of the frame around each pixel that has one.

    near, far: (H,W) inverse depth of the nearest and of the farthest surface seen in a pixel, 1/m,
    0 none. known: (H,W) float32 confidence. steps: (16,H,W) of `marching.first_known` of ``near``.
    rules: `Rules`. found: (4,H,W) float32: the plane's inverse depth in the pixel, its slopes to
    the right and down, and the frame's least confidence; stays 0 where there is no frame.
    """
    width = near.shape[1]
    parts, which = np.zeros((len(directions) + 1, 3)), np.zeros(len(directions), np.int64)
    for p in range(first, last):
        row, column = p // width, p % width
        depth = _depth(row, column, near, far, steps, directions, rules)
        if depth <= rules.behind_m:
            continue
        reach_px = int(min(rules.reach_m * rules.focal_px / depth, float(rules.reach_px)))
        num = _nearest_parts(row, column, depth, reach_px, near, directions, rules, parts, which)
        if num < len(directions) - rules.open:
            continue
        plane = _plane(parts[:num])
        if not _is_before(depth, plane, parts[:num], rules.rough_m, rules):
            continue
        num = _touching_parts(
            row, column, reach_px, near, directions, rules, plane, which, num, parts
        )
        if num < len(directions) - rules.open:
            continue
        plane = _plane(parts[:num])
        if not _is_before(depth, plane, parts[:num], rules.off_m, rules):
            continue
        least = np.float32(np.inf)
        for i in range(num):
            least = min(least, known[row + int(parts[i, 1]), column + int(parts[i, 0])])
        found[0, row, column], found[1, row, column], found[2, row, column] = plane
        found[3, row, column] = least
