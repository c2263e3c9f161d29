# SPDX-License-Identifier: MIT
"""To which of the surfaces around it a pixel belongs, by the image, compiled: see
`densify.depth.rims`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.arrays import Float32
from densify.kernels import Kernel, inlined

_NONE = 1000  # steps, where there is no seed
_STRIDE = 3.0  # the colours looked at on the way to a seed, by gap between rays
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
def _offset(directions, d, k):  # type: ignore[no-untyped-def]
    """Columns and rows of ``k`` steps."""
    one, two = k % 2, k // 2
    right = two * directions[d, 1, 0] + one * directions[d, 0, 0]
    return right, two * directions[d, 1, 1] + one * directions[d, 0, 1]


@inlined
def _steps(steps, directions, d, v, u):  # type: ignore[no-untyped-def]
    """Steps from a pixel, which may be a seed itself, to the first other one."""
    height, width = steps.shape[1:]
    u1, v1 = directions[d, 0]
    u2, v2 = directions[d, 1]
    if not (0 <= u + u1 < width and 0 <= v + v1 < height):
        return _NONE
    if steps[d, v + v1, u + u1] == 0:
        return 1
    if not (0 <= u + u2 < width and 0 <= v + v2 < height):
        return _NONE
    beyond = steps[d, v + v2, u + u2]
    return 2 + np.int64(beyond) if beyond < 254 else _NONE


@inlined
def _agree(seeds, rules, v, u, depth, gap, steps, agrees):  # type: ignore[no-untyped-def]
    """Steps to the seed in each direction, 0 where none is near, and whether its surface goes on to
    the pixel; returns how many do and how many do not."""
    same = rules.same_m + rules.same_fraction * depth
    num_for, num_against = 0, 0
    for d in range(len(steps)):
        k = _steps(seeds.steps, seeds.directions, d, v, u)
        du, dv = _offset(seeds.directions, d, k)
        steps[d] = 0
        if k == _NONE or max(abs(du), abs(dv)) > rules.reach * gap:
            continue
        steps[d] = k
        there = seeds.inverse[v + dv, u + du]
        here = there - seeds.tilt[v + dv, u + du, 0] * du - seeds.tilt[v + dv, u + du, 1] * dv
        here = min(max(here, _LEAST * there), _MOST * there)
        agrees[d] = abs(1 / here - depth) <= same
        num_for += agrees[d]
        num_against += not agrees[d]
    return num_for, num_against


@inlined
def _change(lab, v, u, right, down, directions, d, k, stride, most):  # type: ignore[no-untyped-def]
    """Square of the largest distance in colour to every ``stride``-th pixel on the way of ``k``
    steps, of the image laid aside by ``right`` and ``down``; ``most`` is as good as more."""
    change = np.float32(0)
    for step in range((k - 1) % stride + 1, k + 1, stride):
        du, dv = _offset(directions, d, step)
        off = _difference(lab, v + down, u + right, v + down + dv, u + right + du)
        change = max(change, off)
        if change > most:
            break
    return change


@Kernel
def vote(first, last, pixel, inverse, seeds, lab, gap_px, rules, share):  # type: ignore[no-untyped-def]
    """share: (P,) float32, filled with the weight of the seeds on whose surface ``pixel`` (P,), of
    ``inverse`` depth (P,), lies, as a share of all seeds'.

    seeds: `Seeds`. lab: (H,W,3) float32. gap_px: (H,W) float32 between rays. rules: `Rules`.

    The first seed in each direction votes, less the farther it is, and less the more colour changes
    on the way to it: exp(-c² / 2 s²) + ``through`` of a vote, c the largest distance in colour to
    the pixel met, s ``colours``. The image is laid ``aside`` to all four sides too, and the least
    share counts. Without any seed the share is 0.
    """
    width = gap_px.shape[1]
    narrow = -0.5 / (rules.colours * rules.colours)
    most = np.float32(np.log(0.01 * rules.through) / narrow)
    steps, agrees = np.zeros(len(seeds.directions), np.int64), np.zeros(16, np.bool_)
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        depth, gap = 1 / inverse[i], gap_px[v, u]
        num_for, num_against = _agree(seeds, rules, v, u, depth, gap, steps, agrees)
        if rules.doubt == 0 and (num_for == 0 or num_against == 0):
            share[i] = np.float32(num_for > 0)
            continue
        aside, stride = np.int64(np.rint(rules.aside * gap)), max(np.int64(gap / _STRIDE), 1)
        least = 1.0
        for side in range(5 if aside else 1):
            right = aside * ((side == 1) - (side == 2))
            down = aside * ((side == 3) - (side == 4))
            votes_for, votes = 0.5 * rules.doubt, rules.doubt
            for d in range(len(steps)):
                k = steps[d]
                if k == 0:
                    continue
                change = _change(lab, v, u, right, down, seeds.directions, d, k, stride, most)
                du, dv = _offset(seeds.directions, d, k)
                weight = seeds.weight[v + dv, u + du] / (1 + k / (rules.decay * gap))
                weight *= np.exp(narrow * change) + rules.through
                votes += weight
                if agrees[d]:
                    votes_for += weight
            least = min(least, votes_for / votes)
        share[i] = least
