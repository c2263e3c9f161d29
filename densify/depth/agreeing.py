# SPDX-License-Identifier: MIT
"""How many of the measured pixels around contradict a depth, compiled: see
`densify.depth.agreement`."""

from __future__ import annotations

from typing import NamedTuple

from densify.geometry.compiled import Kernel

_LEAST, _MOST = 0.7, 1.4  # of the inverse depth around: how far its slope is followed


class Rule(NamedTuple):
    """What is elsewhere: off by both ``apart``, an inverse depth (1/m), and ``fraction`` of it.
    num_given: so many more are taken to agree."""

    num_given: float
    apart: float
    fraction: float


@Kernel
def contradicted(first, last, pixel, inverse, known, tilt, half_px, rule, share):  # type: ignore[no-untyped-def]
    """share: (P,) float32, filled for each ``pixel`` (P,) with the share of the known ones around
    whose surface is elsewhere there.

    inverse: (H,W) float32 depth of the pixels, 1/m. known: (H,W) float32, of those around, 0 none.
    tilt: (H,W,2) float32 its slope, 1/m per px. half_px: how far around, to all sides; every pixel
    is looked at, or every n-th, up to 11 across. rule: `Rule`.
    """
    height, width = known.shape
    step = max(1, -(-half_px // 5))
    half_px = half_px // step * step
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        here = inverse[v, u]
        least = max(rule.apart, rule.fraction * here)
        num = against = 0
        for dv in range(-half_px, half_px + 1, step):
            row = v + dv
            if row < 0 or row >= height:
                continue
            for du in range(-half_px, half_px + 1, step):
                column = u + du
                if column < 0 or column >= width or (du == 0 and dv == 0):
                    continue
                there = known[row, column]
                if there == 0:
                    continue
                on = there - tilt[row, column, 0] * du - tilt[row, column, 1] * dv
                on = min(max(on, _LEAST * there), _MOST * there)
                num += 1
                against += abs(on - here) > least
        share[i] = against / (num + rule.num_given)
