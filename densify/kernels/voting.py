# SPDX-License-Identifier: MIT
"""To which of the surfaces around it a pixel belongs, by the image, compiled: see
`densify.depth.rims`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.arrays import Float32
from densify.kernels import Kernel, inlined

_LEAST, _MOST = 0.7, 1.4  # of a seed's inverse depth: how far its slope is followed


class Seeds(NamedTuple):
    """Pixels whose depth is known. steps: (16,H,W) to the first of them in each of ``directions``
    (16,2,2), see `densify.kernels.marching`. inverse: (H,W) 1/m. tilt: (H,W,2) its slope, 1/m per
    px. weight: (H,W) of its vote."""

    steps: NDArray[np.uint8]
    directions: NDArray[np.int64]
    inverse: Float32
    tilt: Float32
    weight: Float32


class Rules(NamedTuple):
    """reach: how far away a seed may be, in gaps between rays, across and down. decay: gaps at
    which its vote counts half. same_m, same_fraction: metres plus share of the depth within which
    it agrees. colours: standard deviation of a surface's, in L*a*b*. through: what is left of a
    vote across an edge of the image. doubt: a vote that is always there, half of it for. aside:
    gaps by which the image may lie beside the depth."""

    reach: float
    decay: float
    same_m: float
    same_fraction: float
    colours: float
    through: float
    doubt: float
    aside: float


@inlined
def _difference(lab, row, column, to_row, to_column):  # type: ignore[no-untyped-def]
    """Square of the distance between two pixels' colours; the image goes on at its border."""
    height, width = lab.shape[:2]
    row, to_row = min(max(row, 0), height - 1), min(max(to_row, 0), height - 1)
    column, to_column = min(max(column, 0), width - 1), min(max(to_column, 0), width - 1)
    square = np.float32(0)
    for channel in range(3):
        off = lab[to_row, to_column, channel] - lab[row, column, channel]
        square += off * off
    return square


@inlined
def _steps(steps, directions, d, v, u):  # type: ignore[no-untyped-def]
    """Steps from a pixel, which may be a seed itself, to the first other one; large without."""
    height, width = steps.shape[1:]
    u1, v1, u2, v2 = directions[d].ravel()
    if not (0 <= u + u1 < width and 0 <= v + v1 < height):
        return 1000
    if steps[d, v + v1, u + u1] == 0:
        return 1
    if not (0 <= u + u2 < width and 0 <= v + v2 < height):
        return 1000
    beyond = steps[d, v + v2, u + u2]
    return 2 + np.int64(beyond) if beyond < 254 else 1000


@Kernel
def vote(first, last, pixel, inverse, seeds, lab, gap_px, rules, share):  # type: ignore[no-untyped-def]
    """share: (P,) float32, filled with the weight of the seeds on whose surface ``pixel`` (P,), of
    ``inverse`` depth (P,), lies, as a share of all seeds'.

    seeds: `Seeds`. lab: (H,W,3) float32. gap_px: (H,W) float32 between rays. rules: `Rules`.

    The first seed in each direction votes, less the farther it is, and less the more colour changes
    on the way to it: exp(-c² / 2 s²) + ``through`` of a vote, c the largest distance in colour to
    the pixel met, s ``colours``. The image is laid ``aside`` to all four sides too, and the least
    share counts.
    """
    width = gap_px.shape[1]
    narrow = -0.5 / (rules.colours * rules.colours)
    change, votes_for, votes = np.zeros(5, np.float32), np.zeros(5), np.zeros(5)
    aside_u, aside_v = np.zeros(5, np.int64), np.zeros(5, np.int64)
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        depth, gap = 1 / inverse[i], gap_px[v, u]
        same = rules.same_m + rules.same_fraction * depth
        aside = np.int64(np.rint(rules.aside * gap))
        aside_u[1], aside_u[2], aside_v[3], aside_v[4] = aside, -aside, aside, -aside
        votes_for[:], votes[:] = 0.5 * rules.doubt, rules.doubt
        for d in range(len(seeds.directions)):
            k = _steps(seeds.steps, seeds.directions, d, v, u)
            u1, v1, u2, v2 = seeds.directions[d].ravel()
            du, dv = k // 2 * u2 + k % 2 * u1, k // 2 * v2 + k % 2 * v1
            if k == 1000 or max(abs(du), abs(dv)) > rules.reach * gap:
                continue
            change[:] = 0
            for step in range(1, k + 1):
                right, down = step // 2 * u2 + step % 2 * u1, step // 2 * v2 + step % 2 * v1
                for a in range(5):
                    row, column = v + aside_v[a], u + aside_u[a]
                    off = _difference(lab, row, column, row + down, column + right)
                    change[a] = max(change[a], off)
            row, column = v + dv, u + du
            there = seeds.inverse[row, column]
            here = there - seeds.tilt[row, column, 0] * du - seeds.tilt[row, column, 1] * dv
            here = min(max(here, _LEAST * there), _MOST * there)
            agrees = abs(1 / here - depth) <= same
            weight = seeds.weight[row, column] / (1 + k / (rules.decay * gap))
            for a in range(5):
                counts = weight * (np.exp(narrow * change[a]) + rules.through)
                votes[a] += counts
                if agrees:
                    votes_for[a] += counts
        least = 1.0
        for a in range(5):
            least = min(least, votes_for[a] / votes[a])
        share[i] = least
