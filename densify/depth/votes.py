# SPDX-License-Identifier: MIT
"""Let the known pixels around a pixel vote on its depth, by their surfaces and the camera image.

Known pixels are those with a depth. The first one in each of 16 directions votes, with less weight
the more the image's colours change in between, as in a bilateral grid or in geodesic matting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.measured_pixels import MapRecord
from densify.depth.patches import HIDDEN_FRACTION, HIDDEN_M, limit_inverse
from densify.geometry.arrays import Bool, Float32, Int
from densify.geometry.compiled import Kernel, inlined

NONE = int(np.iinfo(np.uint8).max)
"""Value of the number of steps if no known pixel is within 254 steps."""
_BLUR_PX = 0.6  # standard deviation; it removes noise and the pattern of the colour filter
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
VOTERS_REACH = 6.0
"""Greatest distance of a voting pixel, in spacings of neighbouring rays."""
_DECAY = 1.2  # distance at which a vote counts half, in spacings of neighbouring rays
_COLOURS = 6.0  # standard deviation of the colours of a surface, in L*a*b*
_ACROSS_EDGE = 0.001  # least weight of a vote, across an edge of the image
_STRIDE = 3.0  # number of compared colours per spacing of rays, on the path to a voter
# Weight of a constant vote, half of it for the depth and half against. Without it voters that are
# all beyond edges of the image, and weigh almost nothing, would decide.
_DOUBT = 0.04
_SHIFT = 0.6  # tested shift of the image, in spacings of neighbouring rays
# Tested shifts to the right and down, in units of `_SHIFT`: none, and one to each side
_SHIFTS = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
ROUNDED = 1 - 1e-6
"""Factor of a least share of votes, for rounding errors of the sums."""


def to_lab(image: NDArray[np.uint8]) -> Float32:
    """Convert (H,W,3) RGB to CIE L*a*b*, L from 0 to 100; slightly blurred, lightened if dark."""
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    lightest = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(lightest, 1.0)))


# Four directions, from the right to almost below. Turned by quarters they give all.
_QUARTER = np.array([[(1, 0), (2, 0)], [(1, 0), (2, 1)], [(1, 1), (2, 2)], [(0, 1), (1, 2)]])
_TURN = np.array([[0, -1], [1, 0]])
DIRECTIONS = np.concatenate([_QUARTER @ np.linalg.matrix_power(_TURN, k).T for k in range(4)])
"""(16,2,2) offsets (columns, rows) after one step and after two steps in 16 directions, clockwise
from the right. Each step goes to one of the eight neighbours."""


def steps_to_known(known: Bool) -> NDArray[np.uint8]:
    """Return (16,H,W) steps to the first known pixel in `DIRECTIONS`, 0 if known, or `NONE`."""
    # Two steps reach at most two pixels beyond the image: there is a border of two on each side.
    padded = np.full((len(DIRECTIONS), known.shape[0] + 4, known.shape[1] + 4), NONE, np.uint8)
    steps = padded[:, 2:-2, 2:-2]
    np.copyto(steps, 0, where=known)
    _march(padded)
    return steps


@Kernel
def _march(steps):  # type: ignore[no-untyped-def]
    """Fill in steps (16,H+4,W+4), 0 at known pixels; the border of two pixels stays unchanged."""
    # The steps of a pixel follow from those of the pixels one and two steps on. The rows go against
    # the direction, so that these are computed before.
    height, width = steps.shape[1:]
    for d in range(len(DIRECTIONS)):
        u1, v1, u2, v2 = DIRECTIONS[d].ravel()  # columns and rows after one step, after two steps
        for i in range(2, height - 2):
            row = height - 1 - i if v2 > 0 else i
            line = steps[d, row, 2 : width - 2]  # the pixels without the border
            if v2 == 0:
                # Horizontally all steps are equal: a pixel is one step farther than the next.
                for j in range(len(line)):
                    column = len(line) - 1 - j if u2 > 0 else j
                    next_steps = steps[d, row, 2 + column + u1]
                    line[column] = 0 if line[column] == 0 else min(next_steps, 254) + 1
                continue
            # 0 steps if known, 1 if the pixel one step on is, else two more than the pixel two on.
            # A sum above 255 (NONE) would overflow.
            after_one = steps[d, row + v1, 2 + u1 : width - 2 + u1]
            after_two = steps[d, row + v2, 2 + u2 : width - 2 + u2]
            for j in range(len(line)):
                farther = min(after_two[j], np.uint8(253)) + np.uint8(2)
                farther = np.uint8(1) if after_one[j] == 0 else np.uint8(farther)
                line[j] = np.uint8(0) if line[j] == 0 else farther


@inlined
def offset(d, k):  # type: ignore[no-untyped-def]
    """Return the offset in columns and rows after k steps in direction d of `DIRECTIONS`."""
    du = (k // 2) * DIRECTIONS[d, 1, 0] + (k % 2) * DIRECTIONS[d, 0, 0]
    dv = (k // 2) * DIRECTIONS[d, 1, 1] + (k % 2) * DIRECTIONS[d, 0, 1]
    return du, dv


@inlined
def extend(inverse, tilt, v, u, du, dv):  # type: ignore[no-untyped-def]
    """Return the inverse depth (1/m) at pixel (v - dv, u - du) of the surface of pixel (v, u).

    ``inverse`` (H,W) holds inverse depths in 1/m, ``tilt`` (H,W,2) their slopes to the right and
    down in 1/m per px. v and dv count rows, u and du columns.
    """
    at_start = inverse[v, u]
    on_plane = at_start - tilt[v, u, 0] * du - tilt[v, u, 1] * dv
    return limit_inverse(on_plane, at_start)


class Voters(NamedTuple):
    """Pixels with a known depth, which vote on the depths of pixels around them."""

    steps: NDArray[np.uint8]  # (16,H,W) of `steps_to_known`
    inverse: Float32  # (H,W) inverse depth in 1/m, 0 where the depth is unknown
    tilt: Float32  # (H,W,2) slope of the inverse depth to the right and down, 1/m per px

    @staticmethod
    def of(depth_m: Float32, tilt: Float32) -> Voters:
        """Return the pixels of a map (H,W) with a depth above 0."""
        known = depth_m > 0
        inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=known)
        return Voters(steps_to_known(known), inverse, tilt)


def votes_for(
    record: MapRecord, maps_m: Sequence[Float32], pixel: Int, depth_m: Float32, with_shifts: bool
) -> Float32:
    """Return the (P,) weighted share of the votes, 0 to 1, that confirm the depth of each pixel.

    The first known pixel in each of 16 directions votes, up to 6 ray spacings away. It votes for
    the depth if its own surface, extended to the pixel, has that depth to 0.2 m and 6 %, otherwise
    against. Edges of the record's image, and distance, weaken votes.

    Args:
        maps_m: Depths (H,W) of the pixels that vote, 0 for other pixels. The least share of the
            maps counts.
        pixel: (P,) flat indices of the pixels, whose depths ``depth_m`` (P,) are to be confirmed.
        with_shifts: Take the least share of five positions of the image, unshifted and shifted by
            0.6 ray spacings to each side, with a small constant vote. Otherwise the image is
            unshifted, and the share is 0 without voters.
    """
    shares = np.ones((len(maps_m), len(pixel)), np.float32)
    # The kernel is compiled for each memory layout of its arrays: here they have one.
    tilt, inverse = np.ascontiguousarray(record.tilt), 1 / depth_m
    colours, gap_px = np.ascontiguousarray(record.lab), record.gap_px
    for map_m, share in zip(maps_m, shares, strict=True):
        voters = Voters.of(map_m, tilt)
        _vote.over_rows(len(pixel), pixel, inverse, voters, colours, gap_px, with_shifts, share)
    return shares.min(axis=0)


@inlined
def _steps_to_other(steps, d, v, u):  # type: ignore[no-untyped-def]
    """Return the steps in direction d from row v, column u to another known pixel, or `NONE`."""
    num_steps = np.int64(steps[d, v, u])
    height, width = steps.shape[1:]
    # A known pixel is 0 steps from itself, and the pixels one and two steps on decide. For other
    # pixels the loop is empty.
    for k in range(1, 3 if num_steps == 0 else 1):
        du, dv = offset(d, k)
        if not (0 <= u + du < width and 0 <= v + dv < height):
            return NONE
        num_steps = k + np.int64(steps[d, v + dv, u + du])
        if num_steps == k:
            return num_steps
    return min(num_steps, NONE)


@inlined
def _cast_votes(voters, v, u, depth_m, gap_px, steps, agrees):  # type: ignore[no-untyped-def]
    """Fill in ``steps`` (16,) to the voters (0: none) and ``agrees`` (16,); count both votes."""
    tolerance_m = HIDDEN_M + HIDDEN_FRACTION * depth_m
    num_for, num_against = 0, 0
    for d in range(len(steps)):
        k = _steps_to_other(voters.steps, d, v, u)
        du, dv = offset(d, k)
        steps[d], agrees[d] = 0, False
        if k == NONE or max(abs(du), abs(dv)) > VOTERS_REACH * gap_px:
            continue
        steps[d] = k
        predicted = extend(voters.inverse, voters.tilt, v + dv, u + du, du, dv)
        agrees[d] = abs(1 / predicted - depth_m) <= tolerance_m
        num_for += agrees[d]
        num_against += not agrees[d]
    return num_for, num_against


@inlined
def _colour_weight(lab, v, u, d, k, gap_px):  # type: ignore[no-untyped-def]
    """Return the weight of a vote by the greatest colour change on k steps in direction d."""
    if lab.size == 0:
        return 1 + _ACROSS_EDGE  # as without any change
    stride = max(np.int64(gap_px / _STRIDE), 1)
    height, width = lab.shape[:2]
    # Positions beyond the image, which may be shifted, take the colour at its border.
    row, column = min(max(v, 0), height - 1), min(max(u, 0), width - 1)
    light, a, b = lab[row, column, 0], lab[row, column, 1], lab[row, column, 2]
    greatest_squared = np.float32(0)
    # The first step is chosen so that the last one is the voter itself.
    for step in range((k - 1) % stride + 1, k + 1, stride):
        du, dv = offset(d, step)
        row, column = min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)
        change_light, change_a = lab[row, column, 0] - light, lab[row, column, 1] - a
        change_b = lab[row, column, 2] - b
        squared = change_light * change_light + change_a * change_a + change_b * change_b
        greatest_squared = max(greatest_squared, squared)
    return np.exp(-0.5 / (_COLOURS * _COLOURS) * greatest_squared) + _ACROSS_EDGE


@Kernel
def _vote(first, last, pixel, inverse, voters, lab, gap_px, with_shifts, share):  # type: ignore[no-untyped-def]
    """Fill ``share`` (P,) with the share of the votes for inverse depths ``inverse`` (P,), 1/m."""
    width, num_directions = gap_px.shape[1], len(DIRECTIONS)
    steps, agrees = np.empty(num_directions, np.int64), np.empty(num_directions, np.bool_)
    doubt = _DOUBT if with_shifts else 0.0
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        gap = gap_px[v, u]
        num_for, num_against = _cast_votes(voters, v, u, 1 / inverse[i], gap, steps, agrees)
        if not with_shifts and (num_for == 0 or num_against == 0):
            share[i] = num_for > 0  # all votes are equal, whatever they weigh, or there is none
            continue
        # The least share of all positions of the image. A shift of 0 px would repeat the first.
        shift_px = np.int64(np.rint(_SHIFT * gap)) if with_shifts else 0
        least_share = 1.0
        for side in range(len(_SHIFTS) if shift_px else 1):
            right, down = shift_px * _SHIFTS[side, 0], shift_px * _SHIFTS[side, 1]
            sum_for, sum_all = 0.5 * doubt, doubt  # half of the constant vote is for the depth
            for d in range(num_directions):
                k = steps[d]
                if k == 0:  # no voter in this direction
                    continue
                colour_weight = _colour_weight(lab, v + down, u + right, d, k, gap)
                weight = colour_weight / (1 + k / (_DECAY * gap))
                sum_all += weight
                sum_for += weight * agrees[d]
            least_share = min(least_share, sum_for / sum_all)
        share[i] = least_share
