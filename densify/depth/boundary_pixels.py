# SPDX-License-Identifier: MIT
"""Decide by the camera image which pixels close to a depth discontinuity are kept.

Known pixels around a boundary pixel vote on its measured depth (`vote`). A vote weighs less the
more the image's colours change between both pixels, as in a bilateral grid or in geodesic matting.
Two pixels without an image edge between them belong to the same surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.image_points import HIDDEN_FRACTION, HIDDEN_M
from densify.depth.layers import Layers
from densify.depth.neighbours import DIRECTIONS, NONE, extended, first_known, offset
from densify.geometry.arrays import Float32, Int
from densify.geometry.compiled import Kernel, inlined

LEAST_SHARE = 0.97  # share of the votes for a pixel that is kept
_BLUR_PX = 0.6  # standard deviation; it removes noise and the pattern of the colour filter
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
VOTERS_REACH = 6.0
"""Greatest distance of a voting pixel, in spacings of neighbouring rays."""
_DECAY = 1.2  # distance at which a vote counts half, in spacings of neighbouring rays
_COLOURS = 6.0  # standard deviation of the colours of a surface, in L*a*b*
_THROUGH = 0.001  # weight of a vote across an edge of the image
_STRIDE = 3.0  # number of compared colours per spacing of rays, on the path to a voter
_DOUBT = 0.04  # weight of a constant vote, half of it for the depth and half against
_ASIDE = 0.6  # tested shift of the image, in spacings of neighbouring rays
ROUNDED = 1 - 1e-6
"""Tolerance for rounding of a share of votes."""


def lab(image: NDArray[np.uint8]) -> Float32:
    """Convert (H,W,3) RGB to CIE L*a*b*, L from 0 to 100; slightly blurred, lightened if dark."""
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    light = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(light, 1.0)))


def accept_boundary_pixels(layers: Layers, rims: str) -> Layers:
    """Return the layers with the boundary pixels (``rim_m``) accepted that the image confirms.

    With ``rims=image`` a pixel is accepted if 97 % of the votes are for its depth. ``keep`` accepts
    all pixels, ``strict`` none. The others become ``rejected_m``.
    """
    pixel = np.flatnonzero(layers.rim_m)
    share = np.full(len(pixel), np.float32(0.5))
    if layers.lab is not None:
        known = voters(layers.depth_m, layers.tilt)
        share = vote(layers, known, pixel, layers.rim_m.flat[pixel], surely=True)
    accepted = np.full(len(pixel), rims == "keep")
    if rims == "image":
        accepted = share >= LEAST_SHARE
    depth_m, votes = layers.depth_m.copy(), layers.votes.copy()
    depth_m.flat[pixel[accepted]] = layers.rim_m.flat[pixel[accepted]]
    votes.flat[pixel] = share
    rejected_m = np.where(depth_m > 0, np.float32(0), layers.rim_m)
    return replace(layers, depth_m=depth_m, filled_m=depth_m, votes=votes, rejected_m=rejected_m)


def least_votes(
    layers: Layers,
    known_m: Sequence[Float32],
    pixel: Int,
    depth_m: Float32,
    surely: bool = False,
) -> Float32:
    """Return the (P,) least share of the votes for the given depth of a pixel, see `vote`.

    ``known_m`` are maps (H,W) with the depth in metres of the pixels that vote, 0 for other pixels.
    The least share of the maps counts. All have the same depths where they vote. The other
    arguments are as in `vote`.
    """
    least_share = np.ones(len(pixel), np.float32)
    steps = None
    for map_m in known_m:
        known = voters(map_m, layers.tilt)
        other_voters = True if steps is None else (known.steps != steps).any(axis=0).flat[pixel]
        rows, steps = np.flatnonzero(other_voters & (least_share > 0)), known.steps
        share = vote(layers, known, pixel[rows], depth_m[rows], surely)
        least_share[rows] = np.minimum(least_share[rows], share)
    return least_share


class Voters(NamedTuple):
    """Pixels with a known depth, which vote on the depths of pixels around them."""

    # (16,H,W) number of steps from each pixel to the first known pixel in 16 directions, from
    # `densify.depth.neighbours.first_known`
    steps: NDArray[np.uint8]
    inverse: Float32  # (H,W) inverse depth in 1/m, 0 where the depth is unknown
    tilt: Float32  # (H,W,2) slope of the inverse depth to the right and down, 1/m per px


def voters(known_m: Float32, tilt: Float32) -> Voters:
    """Return the pixels with a depth ``known_m`` (H,W) above 0, in metres, as voters."""
    inverse = np.divide(1, known_m, out=np.zeros_like(known_m), where=known_m > 0)
    return Voters(first_known(known_m > 0), inverse, np.ascontiguousarray(tilt))


def vote(layers: Layers, voters: Voters, pixel: Int, depth_m: Float32, surely: bool) -> Float32:
    """Return the (P,) weighted share of the votes, 0 to 1, that confirm the depth of each pixel.

    The first known pixel in each of 16 directions votes for the depth if its own surface, extended
    to the pixel, has that depth. Otherwise it votes against. Edges of the image weaken votes.

    Args:
        pixel: (P,) flat indices (row · W + column) of the pixels to confirm.
        depth_m: (P,) depths to confirm.
        surely: True takes the least share of five positions of the image (unshifted, and shifted by
            0.6 ray spacings to each side), with a small constant vote. False takes the unshifted
            image; the share is 0 without voters.
    """
    share = np.zeros(len(pixel), np.float32)
    # of one layout, or `_vote` is compiled for each
    lab = (
        np.zeros((0, 0, 3), np.float32) if layers.lab is None else np.ascontiguousarray(layers.lab)
    )
    _vote.over_rows(len(pixel), pixel, 1 / depth_m, voters, lab, layers.gap_px, surely, share)
    return share


@inlined
def _steps_to(steps, d, v, u):  # type: ignore[no-untyped-def]
    """Return the number of steps in direction d from row v, column u to the next known pixel."""
    num_steps = np.int64(steps[d, v, u])
    height, width = steps.shape[1:]
    for k in range(1, 3 if num_steps == 0 else 1):
        du, dv = offset(d, k)
        if not (0 <= u + du < width and 0 <= v + dv < height):
            return NONE
        num_steps = k + np.int64(steps[d, v + dv, u + du])
        if num_steps == k:
            return num_steps
    return min(num_steps, NONE)


@inlined
def _agree(voters, v, u, depth, gap, steps, agrees):  # type: ignore[no-untyped-def]
    """Fill in the 16 votes on the pixel in row v, column u; return the numbers for and against."""
    # depth in metres, gap in px; steps: to the voter in each direction, 0 without a vote
    agree_m = HIDDEN_M + HIDDEN_FRACTION * depth
    num_for, num_against = 0, 0
    for d in range(len(steps)):
        k = _steps_to(voters.steps, d, v, u)
        du, dv = offset(d, k)
        steps[d], agrees[d] = 0, False
        if k == NONE or max(abs(du), abs(dv)) > VOTERS_REACH * gap:
            continue
        steps[d] = k
        predicted = extended(voters.inverse, voters.tilt, v + dv, u + du, du, dv)
        agrees[d] = abs(1 / predicted - depth) <= agree_m
        num_for += agrees[d]
        num_against += not agrees[d]
    return num_for, num_against


@inlined
def _alike(lab, v, u, d, k, gap):  # type: ignore[no-untyped-def]
    """Return the weight exp(-c² / 2 s²) + ``_THROUGH`` of a vote by the colours of the image."""
    if lab.size == 0:
        return 1 + _THROUGH
    stride = max(np.int64(gap / _STRIDE), 1)
    height, width = lab.shape[:2]
    row, column = min(max(v, 0), height - 1), min(max(u, 0), width - 1)
    light, a, b = lab[row, column, 0], lab[row, column, 1], lab[row, column, 2]
    # c²: greatest squared colour distance from the start along the path; s is _COLOURS
    change = np.float32(0)
    for step in range((k - 1) % stride + 1, k + 1, stride):
        du, dv = offset(d, step)
        row, column = min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)
        off_light, off_a = lab[row, column, 0] - light, lab[row, column, 1] - a
        off_b = lab[row, column, 2] - b
        change = max(change, off_light * off_light + off_a * off_a + off_b * off_b)
    return np.exp(-0.5 / (_COLOURS * _COLOURS) * change) + _THROUGH


@Kernel
def _vote(first, last, pixel, inverse, voters, lab, gap_px, surely, share):  # type: ignore[no-untyped-def]
    """Fill ``share`` (P,), the result of `vote` on the inverse depths ``inverse`` (P,) in 1/m."""
    width, num = gap_px.shape[1], len(DIRECTIONS)
    steps, agrees = np.empty(num, np.int64), np.empty(num, np.bool_)
    doubt = _DOUBT if surely else 0.0
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        gap = gap_px[v, u]
        num_for, num_against = _agree(voters, v, u, 1 / inverse[i], gap, steps, agrees)
        if not surely and (num_for == 0 or num_against == 0):
            share[i] = num_for > 0
            continue
        aside = np.int64(np.rint(_ASIDE * gap)) if surely else 0
        least_share = 1.0
        for side in range(5 if aside else 1):
            down = aside * ((side == 3) - (side == 4))
            right = aside * ((side == 1) - (side == 2))
            votes_for, votes = 0.5 * doubt, doubt
            for d in range(num):
                k = steps[d]
                if k == 0:
                    continue
                weight = _alike(lab, v + down, u + right, d, k, gap) / (1 + k / (_DECAY * gap))
                votes += weight
                votes_for += weight * agrees[d]
            least_share = min(least_share, votes_for / votes)
        share[i] = least_share
