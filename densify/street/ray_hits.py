# SPDX-License-Identifier: MIT
"""What rays make of the triangles they meet, compiled: see `densify.street.world`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float
from densify.geometry.compiled import Kernel, inlined

_STEP_M = 2e-3  # from a surface passed to where the ray goes on
_GOLDEN = 0.6180339887498949


class Surfaces(NamedTuple):
    """Triangles. corner, normal: (T,3). passes: (T,) probability that one lets a ray through."""

    corner: Float
    normal: Float
    passes: Float


class Stops(NamedTuple):
    """Where each of N rays stops, as `densify.street.world.Hits`."""

    range_m: Float
    triangle: NDArray[np.int64]
    barycentric: Float
    normal: Float


@Kernel
def pass_by(origin, direction, spread, centre, radius_m, passes):  # type: ignore[no-untyped-def]
    """passes: (B,N), filled: whether rays pass each of B balls, or begin in it.

    origin, direction: (3,N) of the rays. spread: rad to either side that count as the same ray.
    centre: (B,3). radius_m: (B,).
    """
    for b in range(len(centre)):
        for n in range(origin.shape[1]):
            x, y, z = (
                centre[b, 0] - origin[0, n],
                centre[b, 1] - origin[1, n],
                centre[b, 2] - origin[2, n],
            )
            along = x * direction[0, n] + y * direction[1, n] + z * direction[2, n]
            reach_m = radius_m[b] + spread * abs(along)
            is_near = x * x + y * y + z * z - along * along < reach_m * reach_m
            passes[b, n] = is_near & (along > -reach_m)


@inlined
def _dot(x, y, z, a, i):  # type: ignore[no-untyped-def]
    # In the order in which numpy's einsum adds three with AVX-512: streets keep their bytes.
    return (x * a[i, 0] + z * a[i, 2]) + y * a[i, 1]


@Kernel
def meet(rows, which, u, v, first, surfaces, origin, direction, luck, begin, stops, goes_on):  # type: ignore[no-untyped-def]
    """Let rays stop at the triangles they meet, or go on behind them.

    rows: (R,) of the rays. which: (R,) the triangle of their body, -1 none; first: the body's
    first. u, v: (R,) where on it. surfaces: `Surfaces`. origin, direction: (N,3).
    Filled: the `Stops` of rays that end here; luck and begin (N,) of those that pass, and goes_on
    (R,), whether they do. Distances are to the triangle's plane, in double precision.
    """
    for k in range(len(rows)):
        goes_on[k] = False
        if which[k] < 0:
            continue
        i, t = rows[k], first + np.int64(which[k])
        corner, normal = surfaces.corner, surfaces.normal
        x, y, z = (
            corner[t, 0] - origin[i, 0],
            corner[t, 1] - origin[i, 1],
            corner[t, 2] - origin[i, 2],
        )
        to_plane = _dot(x, y, z, normal, t)
        facing = _dot(direction[i, 0], direction[i, 1], direction[i, 2], normal, t)
        distance = to_plane / facing
        if luck[i] >= surfaces.passes[t]:
            stops.range_m[i], stops.triangle[i] = distance, t
            stops.barycentric[i, 0], stops.barycentric[i, 1] = u[k], v[k]
            for axis in range(3):
                stops.normal[i, axis] = normal[t, axis]
        else:
            begin[i], luck[i] = distance + _STEP_M, (luck[i] + _GOLDEN) % 1.0
            goes_on[k] = True
