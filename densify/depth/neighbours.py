# SPDX-License-Identifier: MIT
"""Find the first known pixel in sixteen directions, and fit planes through known pixels.

A plane in space is linear in inverse depth over the image, so planes are fitted in inverse depth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool
from densify.geometry.compiled import Kernel, inlined

NONE = int(np.iinfo(np.uint8).max)
"""Value of the number of steps if no known pixel is within 254 steps."""
_MOST = 1.4  # greatest ratio of the extended inverse depth and that at the start


def _directions() -> NDArray[np.int64]:
    """Return (16,2,2) offsets as in `DIRECTIONS`."""
    axis, diagonal = (1, 0), (1, 1)
    quarter = [(axis, (2, 0)), (axis, (2, 1)), (diagonal, (2, 2)), ((0, 1), (1, 2))]
    turn = np.array([[0, -1], [1, 0]])
    table = [np.array(quarter) @ np.linalg.matrix_power(turn, k).T for k in range(4)]
    return np.concatenate(table).astype(np.int64)


DIRECTIONS = _directions()
"""(16,2,2) offsets (columns, rows) after one step and after two steps in 16 directions, clockwise
from the right. Each step goes to one of the eight neighbours."""


def first_known(known: Bool) -> NDArray[np.uint8]:
    """Return (16,H,W) steps to the first known pixel by `DIRECTIONS`: 0 at one, else `NONE`."""
    padded = np.full((len(DIRECTIONS), known.shape[0] + 4, known.shape[1] + 4), NONE, np.uint8)
    steps = padded[:, 2:-2, 2:-2]
    steps[:] = np.where(known, np.uint8(0), np.uint8(NONE))
    _march(padded)
    return steps


@Kernel
def _march(steps):  # type: ignore[no-untyped-def]
    """Fill in steps (16,H+4,W+4), 0 at known pixels; the border of two pixels stays unchanged."""
    height, width = steps.shape[1:]
    for d in range(len(DIRECTIONS)):
        u1, v1, u2, v2 = DIRECTIONS[d].ravel()
        for i in range(2, height - 2):
            row = height - 1 - i if v2 > 0 else i  # rows two steps on are done before
            line = steps[d, row, 2 : width - 2]
            if v2 == 0:
                for j in range(len(line)):
                    column = len(line) - 1 - j if u2 > 0 else j
                    before = steps[d, row, 2 + column + u1]
                    line[column] = 0 if line[column] == 0 else min(before, 254) + 1
                continue
            first = steps[d, row + v1, 2 + u1 : width - 2 + u1]
            second = steps[d, row + v2, 2 + u2 : width - 2 + u2]
            for j in range(len(line)):
                beyond = min(second[j], np.uint8(253)) + np.uint8(2)
                beyond = np.uint8(1) if first[j] == 0 else np.uint8(beyond)
                line[j] = np.uint8(0) if line[j] == 0 else beyond


@inlined
def offset(d, k):  # type: ignore[no-untyped-def]
    """Return the offset in columns and rows after k steps in direction d."""
    du = (k // 2) * DIRECTIONS[d, 1, 0] + (k % 2) * DIRECTIONS[d, 0, 0]
    dv = (k // 2) * DIRECTIONS[d, 1, 1] + (k % 2) * DIRECTIONS[d, 0, 1]
    return du, dv


@inlined
def extended(inverse, tilt, v, u, du, dv):  # type: ignore[no-untyped-def]
    """Return the inverse depth of a pixel if the surface of pixel (v, u) is extended to it.

    Pixel (v, u) is du columns and dv rows away. ``inverse`` (H,W) is in 1/m, ``tilt`` (H,W,2) is
    its slope to the right and down in 1/m per px.
    """
    known = inverse[v, u]
    return limited(known - tilt[v, u, 0] * du - tilt[v, u, 1] * dv, known)


@inlined
def limited(inverse, start):  # type: ignore[no-untyped-def]
    """Return inverse depth ``inverse``, kept between 1 / 1.4 and 1.4 times ``start``."""
    return min(max(inverse, start / _MOST), _MOST * start)


@inlined
def slopes(uu, uv, vv, uw, vw):  # type: ignore[no-untyped-def]
    """Return both slopes of the least-squares plane from centred second moments of `plane`."""
    determinant = uu * vv - uv * uv
    return (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant


@inlined
def plane(n, u, v, uu, uv, vv, w, uw, vw, ridge):  # type: ignore[no-untyped-def]
    """Return the inverse depth at the origin and both slopes of the least-squares plane.

    ``ridge`` is a variance in px² added in both directions. With it, pixels on one line do not tilt
    the plane across the line. The other arguments are sums over pixels: of the weight (n), and of
    the weight times products of column offset u, row offset v and inverse depth w.
    """
    u, v, w = u / n, v / n, w / n
    uu, vv, uv = uu / n - u * u + ridge, vv / n - v * v + ridge, uv / n - u * v
    slope_u, slope_v = slopes(uu, uv, vv, uw / n - u * w, vw / n - v * w)
    return w - slope_u * u - slope_v * v, slope_u, slope_v
