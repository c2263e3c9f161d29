# SPDX-License-Identifier: MIT
"""Interpolation between the first known pixels all round, compiled: see `densify.depth.star`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from densify.depth.marching import NONE
from densify.geometry.compiled import Kernel, inlined

_RIDGE_PX2 = 0.02  # keeps pixels that lie on one line, or nearly so, from tilting the plane
_LEAST_PX = 3
_BITS = 24  # of a float32's mantissa
_ABOVE = 12  # of the directions
_LESS, _MORE = 0.7, 1.4  # of the inverse depth, once extended


class Rules(NamedTuple):
    """What `between` asks of the pixels around. reach: how far they may be, in spacings of the
    rays. met: in how many directions there must be one, at least. gap: most neighbouring directions
    without. fraction: of the depth, between the nearest and the farthest they give. strip_px: in an
    empty strip no higher than that along the image's lower border the two directions along it may
    be without too."""

    reach: float
    met: int
    gap: int
    fraction: float
    strip_px: int


@inlined
def _slope(inverse, row, column, half_u, half_v, fraction):  # type: ignore[no-untyped-def]
    """Slopes of the least-squares plane over the pixels around that are as deep. These differ from
    the one here by whole units, the last bit of half its inverse depth: sums of whole numbers are
    the same in any order, so that several pixels are added up at once."""
    height, width = inverse.shape
    here = inverse[row, column]
    units = np.float32(math.ldexp(1.0, _BITS + 1 - math.frexp(here)[1]))
    most = np.float32(math.floor(fraction * here * units))
    left, right = max(column - half_u, 0), min(column + half_u + 1, width)
    n = mu = mv = mw = uu = vv = uv = uw = vw = 0
    for r in range(max(row - half_v, 0), min(row + half_v + 1, height)):
        row_n = row_u = row_w = row_uu = row_uw = 0
        for c in range(left, right):
            off = (inverse[r, c] - here) * units
            same = abs(off) <= most
            du = np.int32(c - column) if same else np.int32(0)
            dw = np.int32(off) if same else np.int32(0)
            row_n += same
            row_u += du
            row_w += dw
            row_uu += du * du
            row_uw += du * np.int64(dw)
        dv = r - row
        n += row_n
        mu += row_u
        mv += dv * row_n
        mw += row_w
        uu += row_uu
        vv += dv * dv * row_n
        uv += dv * row_u
        uw += row_uw
        vw += dv * row_w
    a, b, w, aw, bw = mu / n, mv / n, mw / units / n, uw / units / n, vw / units / n
    aa, bb, ab = uu / n - a * a + _RIDGE_PX2, vv / n - b * b + _RIDGE_PX2, uv / n - a * b
    aw, bw = aw - a * w, bw - b * w
    determinant = aa * bb - ab * ab
    return (bb * aw - ab * bw) / determinant, (aa * bw - ab * aw) / determinant


@Kernel
def slopes(first, last, pixel, inverse, spacing_px, fraction, slope):  # type: ignore[no-untyped-def]
    """How the surface in known pixels goes on, as far as rays lie apart and three pixels at least.

    pixel: (P,) row by row. inverse: (H,W) float32 depth, 1/m, 0 none. spacing_px: (H,W,2) float32
    of rays, across and down. fraction: of the inverse depth, by which pixels of one surface differ,
    less than a half.
    slope: (H W,2) float32, 1/m per px, filled in for these pixels.
    """
    width = inverse.shape[1]
    for p in range(first, last):
        row, column = pixel[p] // width, pixel[p] % width
        half_u = max(_LEAST_PX, int(spacing_px[row, column, 0]))
        half_v = max(_LEAST_PX, int(spacing_px[row, column, 1]))
        slope_u, slope_v = _slope(inverse, row, column, half_u, half_v, fraction)
        slope[pixel[p], 0], slope[pixel[p], 1] = slope_u, slope_v


@inlined
def _widest_gap(met):  # type: ignore[no-untyped-def]
    """Most neighbouring directions that are not met, going round."""
    widest = run = 0
    for d in range(2 * len(met)):
        run = 0 if met[d % len(met)] else run + 1
        widest = max(widest, run)
    return min(widest, len(met))


@Kernel
def between(  # type: ignore[no-untyped-def]
    first, last, pixel, steps, directions, inverse, slope, known, spacing_px, rules, found
):
    """The depth of empty pixels from the first known ones around them.

    pixel: (P,) row by row. steps: (16,H,W) of `marching.first_known`. inverse: (H,W) float32 depth,
    1/m. slope: (H W,2) of `slopes`. known: (H,W) float32 confidence. spacing_px: (H,W,2). rules:
    `Rules`. found: (2,P) float32: depth in m and least confidence, 0 where they do not agree.
    """
    height, width = inverse.shape
    met = np.zeros(len(directions), np.bool_)
    for p in range(first, last):
        row, column = pixel[p] // width, pixel[p] % width
        reach_px = rules.reach * max(spacing_px[row, column, 0], spacing_px[row, column, 1])
        num, near, far = 0, 0.0, np.inf
        least = np.float32(np.inf)
        sum_w, weight = 0.0, 0.0
        for d in range(len(directions)):
            k = np.int64(steps[d, row, column])
            du = (k // 2) * directions[d, 1, 0] + (k % 2) * directions[d, 0, 0]
            dv = (k // 2) * directions[d, 1, 1] + (k % 2) * directions[d, 0, 1]
            met[d] = k != NONE and du * du + dv * dv <= reach_px * reach_px
            if met[d]:
                u, v = column + du, row + dv
                there = inverse[v, u]
                tilt = slope[v * width + u]
                w = there - du * tilt[0] - dv * tilt[1]
                w = min(max(w, _LESS * there), _MORE * there)
                sum_w += w / k
                weight += 1 / k
                near, far = max(near, w), min(far, w)
                least = min(least, known[v, u])
                num += 1
        strip_px = height - 1 - row + np.int64(steps[_ABOVE, row, column])
        along = 2 if strip_px <= rules.strip_px else 0
        if num < rules.met - along or _widest_gap(met) > rules.gap + along:
            continue
        w = sum_w / weight
        if near - far <= rules.fraction * w:
            found[0, p], found[1, p] = 1 / w, least
