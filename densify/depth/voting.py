# SPDX-License-Identifier: MIT
"""Which of the surfaces around it a pixel belongs to, by the image, compiled: see
`densify.depth.rims`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.marching import NONE
from densify.geometry.arrays import Float32
from densify.geometry.compiled import Kernel, inlined

NUM_PLACES = 5
"""Where the image is laid: as it is, to the right, to the left, down, up."""

_NONE = 1000  # steps, where there is no seed
_STRIDE = 3.0  # the colours looked at on the way to a seed, by gap between rays
_ROUNDED = 1 - 1e-9  # just the share needed is enough, whatever the rounding
_LEAST, _MOST = 0.7, 1.4  # of a seed's inverse depth: how far its slope is followed


class Seeds(NamedTuple):
    """Pixels whose depth is known. steps: (16,H,W) to the first of them in each of ``directions``
    (16,2,2), see `densify.depth.marching`. inverse: (H,W) 1/m. tilt: (H,W,2) its slope, 1/m per
    px."""

    steps: NDArray[np.uint8]
    directions: NDArray[np.int64]
    inverse: Float32
    tilt: Float32


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
def _offset(directions, d, k):  # type: ignore[no-untyped-def]
    """Columns and rows of ``k`` steps."""
    one, two = k & 1, k >> 1
    right = two * directions[d, 1, 0] + one * directions[d, 0, 0]
    return right, two * directions[d, 1, 1] + one * directions[d, 0, 1]


@inlined
def _steps(steps, directions, d, v, u):  # type: ignore[no-untyped-def]
    """Steps from a pixel, which may be a seed itself, to the first other one."""
    here = steps[d, v, u]
    if here:
        return np.int64(here) if here < NONE else _NONE
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
        steps[d], agrees[d] = 0, False
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
def _change(lab, v, u, directions, d, k, stride, most):  # type: ignore[no-untyped-def]
    """Square of the largest distance in colour from a pixel to every ``stride``-th one on the way
    of ``k`` steps; ``most`` is as good as more. The image goes on at its border."""
    height, width = lab.shape[:2]
    row, column = min(max(v, 0), height - 1), min(max(u, 0), width - 1)
    light, a, b = lab[row, column, 0], lab[row, column, 1], lab[row, column, 2]
    change = np.float32(0)
    for step in range((k - 1) % stride + 1, k + 1, stride):
        du, dv = _offset(directions, d, step)
        row, column = min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)
        off_light, off_a = lab[row, column, 0] - light, lab[row, column, 1] - a
        off_b = lab[row, column, 2] - b
        change = max(change, off_light * off_light + off_a * off_a + off_b * off_b)
        if change > most:
            break
    return change


@inlined
def _alike(lab, v, u, directions, d, k, gap, rules):  # type: ignore[no-untyped-def]
    """What the image, if there is one, leaves of a vote: exp(-c² / 2 s²) + ``through``, c the
    largest distance in colour on the way, s ``colours``."""
    if lab.size == 0:
        return 1 + rules.through
    narrow = -0.5 / (rules.colours * rules.colours)
    most = np.float32(np.log(0.01 * rules.through) / narrow)
    stride = max(np.int64(gap / _STRIDE), 1)
    change = _change(lab, v, u, directions, d, k, stride, most)
    return np.exp(narrow * change) + rules.through


@Kernel
def canvass(first, last, pixel, inverse, seeds, lab, gap_px, rules, seed, agrees, tie):  # type: ignore[no-untyped-def]
    """Who votes on each ``pixel`` (P,) of ``inverse`` depth (P,), how, and with how much of a vote.

    seeds: `Seeds`. lab: (H,W,3) float32, empty without an image. gap_px: (H,W) float32 between
    rays. rules: `Rules`.

    The first seed in each direction votes, less the farther it is, and less the more colour changes
    on the way to it (`_alike`). Filled: seed (P,16) int32, which pixel that is, -1 none; agrees
    (P,16) bool, whether its surface goes on to the pixel; tie (P,NUM_PLACES,16) float32, what is
    left of its vote with the image in its place and ``aside`` to all four sides.
    """
    width = gap_px.shape[1]
    steps = np.zeros(len(seeds.directions), np.int64)
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        gap = gap_px[v, u]
        _agree(seeds, rules, v, u, 1 / inverse[i], gap, steps, agrees[i])
        aside = np.int64(np.rint(rules.aside * gap))
        for d in range(len(steps)):
            k = steps[d]
            du, dv = _offset(seeds.directions, d, k)
            seed[i, d] = (v + dv) * width + u + du if k else -1
            for side in range(NUM_PLACES if k else 0):
                down = aside * ((side == 3) - (side == 4))
                right = aside * ((side == 1) - (side == 2))
                if side and not aside:
                    tie[i, side, d] = tie[i, 0, d]
                    continue
                alike = _alike(lab, v + down, u + right, seeds.directions, d, k, gap, rules)
                tie[i, side, d] = alike / (1 + k / (rules.decay * gap))


@Kernel
def count(first, last, seed, agrees, tie, weight, doubt, share):  # type: ignore[no-untyped-def]
    """share: (P,) float32, filled with the weight of the seeds on whose surface pixels lie, as a
    share of all seeds'; the least wherever the image is laid.

    seed, agrees, tie: of `canvass`. weight: (H W,) float32 of each seed's vote. doubt: of `Rules`.
    """
    for i in range(first, last):
        least = 1.0
        for side in range(tie.shape[1]):
            votes_for, votes = 0.5 * doubt, doubt
            for d in range(tie.shape[2]):
                if seed[i, d] < 0:
                    continue
                vote = np.float64(weight[seed[i, d]]) * tie[i, side, d]
                votes += vote
                if agrees[i, d]:
                    votes_for += vote
            least = min(least, votes_for / votes)
        share[i] = least


@Kernel
def elect(first, last, pixel, inverse, seeds, lab, gap_px, rules, share, elected):  # type: ignore[no-untyped-def]
    """elected: (P,) bool, True where ``share`` of the votes, or more, is in favour of ``pixel``
    (P,) of ``inverse`` depth (P,); never without any.

    As `canvass` and `count` with seeds of one weight, the image in its place and no doubt; but
    votes are looked at only until they suffice: those against first, each at least ``through``.
    """
    width, num = gap_px.shape[1], len(seeds.directions)
    steps, agrees, whole = np.zeros(num, np.int64), np.zeros(num, np.bool_), np.zeros(num)
    counted, left = np.zeros(2), np.zeros(2)
    needed = _ROUNDED * share / (1 - share)
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        gap = gap_px[v, u]
        num_for, num_against = _agree(seeds, rules, v, u, 1 / inverse[i], gap, steps, agrees)
        if num_for == 0 or num_against == 0:
            elected[i] = num_for > 0
            continue
        # Of those against and those for: what is counted, and what may be added to it.
        counted[:], left[:] = 0.0, 0.0
        for d in range(num):
            whole[d] = 1 / (1 + steps[d] / (rules.decay * gap)) if steps[d] else 0.0
            counted[np.int64(agrees[d])] += rules.through * whole[d]
            left[np.int64(agrees[d])] += whole[d]
        for e in range(2 * num):
            d, side = e % num, e // num
            if steps[d] == 0 or np.int64(agrees[d]) != side:
                continue
            surely = counted[1] >= needed * (counted[0] + left[0])
            if surely or counted[1] + left[1] < needed * counted[0]:
                break
            alike = _alike(lab, v, u, seeds.directions, d, steps[d], gap, rules)
            counted[side] += whole[d] * (alike - rules.through)
            left[side] -= whole[d]
        elected[i] = counted[1] >= needed * counted[0]
