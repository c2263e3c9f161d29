# SPDX-License-Identifier: MIT
"""Interpolation between the first known pixels all round, compiled: see `densify.depth.star`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.kernels import Kernel, inlined
from densify.kernels.marching import NONE

_RIDGE_PX2 = 0.02  # keeps pixels that lie on one line, or nearly so, from tilting the plane
_LEAST_PX = 3
_LESS, _MORE = 0.7, 1.4  # of the inverse depth, once extended


class Rules(NamedTuple):
    """What `between` asks of the pixels around. reach: how far they may be, in spacings of the
    rays. met: in how many directions there must be one, at least. gap: most neighbouring directions
    without. fraction: of the depth, between the nearest and the farthest they give."""

    reach: float
    met: int
    gap: int
    fraction: float


@inlined
def _slope(inverse, row, column, half_u, half_v, fraction):  # type: ignore[no-untyped-def]
    """Slopes of the least-squares plane over the pixels around that are as deep."""
    height, width = inverse.shape
    here = inverse[row, column]
    n = mu = mv = mw = uu = vv = uv = uw = vw = 0.0
    for r in range(max(row - half_v, 0), min(row + half_v + 1, height)):
        for c in range(max(column - half_u, 0), min(column + half_u + 1, width)):
            dw = inverse[r, c] - here
            if inverse[r, c] > 0 and abs(dw) <= fraction * here:
                du, dv = c - column, r - row
                n += 1
                mu += du
                mv += dv
                mw += dw
                uu += du * du
                uv += du * dv
                vv += dv * dv
                uw += du * dw
                vw += dv * dw
    mu, mv, mw = mu / n, mv / n, mw / n
    uu, vv, uv = uu / n - mu * mu + _RIDGE_PX2, vv / n - mv * mv + _RIDGE_PX2, uv / n - mu * mv
    uw, vw = uw / n - mu * mw, vw / n - mv * mw
    determinant = uu * vv - uv * uv
    return (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant


@Kernel
def slopes(first, last, pixel, inverse, spacing_px, fraction, slope):  # type: ignore[no-untyped-def]
    """How the surface in known pixels goes on, as far as rays lie apart and three pixels at least.

    pixel: (P,) row by row. inverse: (H,W) float32 depth, 1/m, 0 none. spacing_px: (H,W,2) float32
    of rays, across and down. fraction: of the inverse depth, by which pixels of one surface differ.
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
    width = inverse.shape[1]
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
        if num < rules.met or _widest_gap(met) > rules.gap:
            continue
        w = sum_w / weight
        if near - far <= rules.fraction * w:
            found[0, p], found[1, p] = 1 / w, least
