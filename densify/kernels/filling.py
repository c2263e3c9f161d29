# SPDX-License-Identifier: MIT
"""Interpolation between measured pixels, compiled: see `densify.depth.fill`."""

from __future__ import annotations

import numpy as np

from densify.kernels import Kernel, inlined

_RIDGE = 1e-7  # gives the slope of least norm where the pixels lie on one line
_MIN_PLANE_PX = 6  # fewer do not tell a plane from a step


@inlined
def _plane(inverse, top, bottom, left, right, row, column, reach_u, reach_v):  # type: ignore[no-untyped-def]
    """Inverse depth in the centre and its two slopes: weighted least squares, the weight falling
    linearly to zero just outside the window."""
    n = u = v = uu = uv = vv = w = uw = vw = 0.0
    for r in range(top, bottom):
        weight_v = 1 - abs(r - row) / (reach_v + 1)
        for c in range(left, right):
            there = inverse[r, c]
            if there > 0:
                du, dv = float(c - column), float(r - row)
                weight = weight_v * (1 - abs(du) / (reach_u + 1))
                n += weight
                u += weight * du
                v += weight * dv
                uu += weight * du * du
                uv += weight * du * dv
                vv += weight * dv * dv
                w += weight * there
                uw += weight * du * there
                vw += weight * dv * there
    u, v, w = u / n, v / n, w / n
    uu, vv, uv = uu / n - u * u + _RIDGE, vv / n - v * v + _RIDGE, uv / n - u * v
    uw, vw = uw / n - u * w, vw / n - v * w
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    return w - slope_u * u - slope_v * v, slope_u, slope_v


@Kernel
def between(first, last, inverse, known, reaches, edge, filled_m, confidence, share):  # type: ignore[no-untyped-def]
    """Fill the empty pixels from ``first`` to ``last`` (row by row) as
    `densify.depth.fill.fill_between` says.

    inverse: (H,W) float64, 1/m, 0 none. known: (H,W) float32 confidence. reaches: (n,2) half sizes
    of the windows (horizontal, vertical), growing. edge: metres and share of the depth. Filled:
    filled_m and confidence (H,W) float32; share (H,W) float32, size of the window used as a share
    of the largest, 0 where nothing was filled.
    """
    height, width = inverse.shape
    for p in range(first, last):
        row, column = p // width, p % width
        if inverse[row, column] > 0:
            continue
        for k in range(len(reaches)):
            reach_u, reach_v = reaches[k]
            top, bottom = max(row - reach_v, 0), min(row + reach_v + 1, height)
            left, right = max(column - reach_u, 0), min(column + reach_u + 1, width)
            sides, num, near, far, least = 0, 0, 0.0, np.inf, np.float32(np.inf)
            for r in range(top, bottom):
                for c in range(left, right):
                    there = inverse[r, c]
                    if there > 0:
                        num += 1
                        near, far = max(near, there), min(far, there)
                        least = min(least, known[r, c])
                        sides |= (c < column) + 2 * (c > column) + 4 * (r < row) + 8 * (r > row)
            if sides != 15:
                continue
            centre, slope_u, slope_v = _plane(
                inverse, top, bottom, left, right, row, column, reach_u, reach_v
            )
            allowed = max(edge[0], edge[1] / near)
            if num < _MIN_PLANE_PX:
                spread_m = 1 / far - 1 / near
            else:
                low, high = np.inf, -np.inf
                for r in range(top, bottom):
                    for c in range(left, right):
                        if inverse[r, c] > 0:
                            plane = centre + (c - column) * slope_u + (r - row) * slope_v
                            low = min(low, inverse[r, c] - plane)
                            high = max(high, inverse[r, c] - plane)
                spread_m = (high - low) / (centre * centre)
            if spread_m <= allowed and centre > 0:
                filled_m[row, column] = 1 / min(max(centre, far), near)
                confidence[row, column] = least
                share[row, column] = (k + 1) / len(reaches)
                break
