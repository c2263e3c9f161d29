# SPDX-License-Identifier: MIT
"""Pixels behind a frame that lies in one plane, compiled: see `densify.depth.glass`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.depth.marching import NONE
from densify.geometry.compiled import Kernel, inlined

_RIDGE_PX2 = 1e-7  # gives the slope of least norm where the frame lies on one line


class Rules(NamedTuple):
    """What makes a frame. focal_px: of the map. reach_m, reach_px: how far from the pixel it may
    be, the less of both. behind_m, most_m: how far the pixel lies behind its plane, at least and at
    most; each_m: behind each of its parts. empty_m: an empty pixel counts as so far behind the
    farthest of the first known pixels around. least: of sixteen directions in which there is a
    frame; below: of the five downwards, one more than those where a plate must stand, a surface
    that lies in the plane to plate_off_m for plate_m. rough_m, off_m: what lies farther from the
    plane is no part of a frame roughly found and found again. touch_m: a ray comes to the plane
    where a surface is at most so far behind it. lean: most metres of depth per metre of height."""

    focal_px: float
    reach_m: float
    reach_px: int
    behind_m: float
    most_m: float
    each_m: float
    empty_m: float
    least: int
    below: int
    plate_m: float
    plate_off_m: float
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
def _at(plane, du, dv):  # type: ignore[no-untyped-def]
    """Inverse depth of the plane, (3,) of `_plane`, beside the origin."""
    return plane[0] + plane[1] * du + plane[2] * dv


@inlined
def _off_m(plane, du, dv, inverse):  # type: ignore[no-untyped-def]
    """How far a surface lies from the plane along its ray."""
    there = _at(plane, du, dv)
    return abs(1 / there - 1 / inverse) if there > 0 else np.inf


@inlined
def _is_before(depth, plane, rules):  # type: ignore[no-untyped-def]
    """Whether the plane stands upright before what is ``depth`` metres away."""
    centre, _, slope_v = plane
    if centre * (depth - rules.behind_m) <= 1 or centre * (depth - rules.most_m) > 1:
        return False
    return abs(slope_v) * rules.focal_px <= rules.lean * centre


@inlined
def _is_around(which, num, rules):  # type: ignore[no-untyped-def]
    """Whether directions, from the right by way of below, are as many as a frame has: straight
    down, around that, to the left and to the right."""
    down, below, left, right = 0, 0, 0, 0
    for i in range(num):
        down += which[i] == 4
        below += 2 <= which[i] <= 6
        left += 7 <= which[i] <= 9
        right += which[i] <= 1 or which[i] == 15
    some = min(down, left, right) > 0
    return some and num >= rules.least and below >= rules.below


@inlined
def _in_plane(parts, which, num, off_m, rules):  # type: ignore[no-untyped-def]
    """How many parts are left, moved to the front, once none lies farther than ``off_m`` from the
    plane through all; what does most goes first. 0 where too few are left."""
    while _is_around(which, num, rules):
        plane = _plane(parts[:num])
        most, worst = 0.0, 0
        for i in range(num):
            off = _off_m(plane, parts[i, 0], parts[i, 1], parts[i, 2])
            if off > most:
                most, worst = off, i
        if most <= off_m:
            return num
        num -= 1
        parts[worst], which[worst] = parts[num], which[num]
    return 0


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
def _steps_inside(row, column, d, shape, directions, most):  # type: ignore[no-untyped-def]
    """One more than the steps in a direction, up to ``most``, that stay in the image."""
    right, down = directions[d, 1]
    across = column if right < 0 else shape[1] - 1 - column if right > 0 else most
    along = row if down < 0 else shape[0] - 1 - row if down > 0 else most
    steps = most
    if right:
        steps = min(steps, 2 * across + 1 if abs(right) == 1 else across)  # the second of two goes
    if down:
        steps = min(steps, 2 * along + 1 if abs(down) == 1 else along)
    return steps + 1


@inlined
def _upright_below(row, column, depth, near, rules):  # type: ignore[no-untyped-def]
    """Whether straight below something before the pixel, as long as a plate, may lie in an upright
    plane: told by the depth of its cells, without a plane yet. Ground seen from afar does not."""
    begin, first = 0, 0.0
    for k in range(1, min(rules.reach_px, near.shape[0] - 1 - row) + 1):
        there = near[row + k, column]
        if there == 0:
            continue
        if there * (depth - rules.each_m) <= 1:
            first = 0.0
            continue
        gone = (k - begin) / (rules.focal_px * first) if first > 0 else 0.0  # metres downwards
        if first == 0 or abs(1 / there - 1 / first) > rules.lean * gone + 2 * rules.plate_off_m:
            begin, first = k, there
        elif gone >= rules.plate_m:
            return True
    return False


@inlined
def _nearest_parts(row, column, depth, near, directions, rules, parts, which):  # type: ignore[no-untyped-def]
    """The nearest surface on the way in each direction, where it lies before the pixel: how many;
    gives up once too many directions are open, or the one straight down."""
    reach = rules.reach_m * rules.focal_px
    num = 0
    for i in range(len(directions)):
        d = (4 + i * 8 + i // 2 * 5) % len(directions)  # straight down and up, then other sides
        most, at = np.float32(0), 0
        for k in range(1, _steps_inside(row, column, d, near.shape, directions, rules.reach_px)):
            du, dv = _offset(directions, d, k)
            there = near[np.uint64(row + dv), np.uint64(column + du)]
            if there > most and k <= reach * there:
                most, at = there, k
        du, dv = _offset(directions, d, at)
        parts[num, 0], parts[num, 1], parts[num, 2] = du, dv, most
        if parts[num, 2] * (depth - rules.each_m) > 1 >= parts[num, 2] * (depth - rules.most_m):
            which[num] = d
            num += 1
        elif i - num >= len(directions) - rules.least:
            return 0
        if i == 0 and (num == 0 or not _upright_below(row, column, depth, near, rules)):
            return 0
    return num


@inlined
def _touching_parts(row, column, depth, reach_px, near, directions, rules, plane, parts, which):  # type: ignore[no-untyped-def]
    """Where the ray in each direction first comes to a surface before the pixel that touches the
    plane, unless one far before it is in the way: how many do."""
    num = 0
    for d in range(len(directions)):
        for k in range(1, _steps_inside(row, column, d, near.shape, directions, reach_px)):
            du, dv = _offset(directions, d, k)
            there, fitted = near[row + dv, column + du], _at(plane, du, dv)
            if there > 0 and fitted > 0 and 1 / there < 1 / fitted + rules.touch_m:
                if 1 / fitted - rules.rough_m < 1 / there < depth - rules.each_m:
                    parts[num, 0], parts[num, 1], parts[num, 2], which[num] = du, dv, there, d
                    num += 1
                break
    return num


@inlined
def _stands_on_plates(row, column, reach_px, near, directions, rules, plane):  # type: ignore[no-untyped-def]
    """Whether a surface goes on in the plane straight below and in all but one of the other
    directions downwards that are asked for, as a door does and ground does not."""
    length = rules.plate_m * rules.focal_px * plane[0]
    plates = 0
    for d in range(2, 7):
        run, seen = 0, 0
        for k in range(1, _steps_inside(row, column, d, near.shape, directions, reach_px)):
            if run > length:
                break
            du, dv = _offset(directions, d, k)
            there = near[row + dv, column + du]
            if there > 0:
                flat = _off_m(plane, du, dv, there) <= rules.plate_off_m
                run, seen = (run + 1, seen + 1) if flat else (0, 0)
            elif run > 0:
                run += 1
        if run > length and 2 * seen > run:
            plates += 1
        elif d == 4:
            return False
    return plates >= rules.below - 1


@Kernel
def framed(first, last, near, far, known, steps, directions, rules, found):  # type: ignore[no-untyped-def]
    """The plane of the frame around each pixel that has one.

    near, far: (H,W) inverse depth of the nearest and of the farthest surface seen in a pixel, 1/m,
    0 none. known: (H,W) float32 confidence. steps: (16,H,W) of `marching.first_known` of ``near``.
    rules: `Rules`. found: (6,H,W) float32: the plane's inverse depth in the pixel, its slopes to
    the right and down, the frame's least confidence, and 1 where it has a part upwards, and parts
    on both sides that do not lie lower; stays 0 where there is no frame.
    """
    width = near.shape[1]
    parts = np.zeros((len(directions) + 1, 3))
    which = np.zeros(len(directions) + 1, np.int64)
    for p in range(first, last):
        row, column = p // width, p % width
        depth = _depth(row, column, near, far, steps, directions, rules)
        if depth <= rules.behind_m:
            continue
        num = _nearest_parts(row, column, depth, near, directions, rules, parts, which)
        num = _in_plane(parts, which, num, rules.rough_m, rules)
        if num == 0:
            continue
        plane = _plane(parts[:num])
        if not _is_before(depth, plane, rules):
            continue
        reach_px = int(min(rules.reach_m * rules.focal_px * plane[0], float(rules.reach_px)))
        num = _touching_parts(
            row, column, depth, reach_px, near, directions, rules, plane, parts, which
        )
        num = _in_plane(parts, which, num, rules.off_m, rules)
        if num == 0:
            continue
        plane = _plane(parts[:num])
        if not _is_before(depth, plane, rules) or not _stands_on_plates(
            row, column, reach_px, near, directions, rules, plane
        ):
            continue
        least, above, left, right = np.float32(np.inf), False, False, False
        for i in range(num):
            least = min(least, known[row + int(parts[i, 1]), column + int(parts[i, 0])])
            above |= 11 <= which[i] <= 13
            left |= 8 <= which[i] <= 9
            right |= which[i] == 0 or which[i] == 15
        found[0, row, column], found[1, row, column], found[2, row, column] = plane
        found[3, row, column] = least
        found[4, row, column], found[5, row, column] = above, left and right
