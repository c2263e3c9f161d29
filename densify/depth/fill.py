# SPDX-License-Identifier: MIT
"""Add pixels to the measured ones of a depth map, where the votes of known pixels confirm them.

Known pixels are those with a depth. Boundary pixels and pixels between the measured ones are added.
The first known pixel in each of 16 directions votes on a pixel by its surface, with less weight the
more the image's colours change in between, as in a bilateral grid or in geodesic matting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.measured_pixels import MapRecord
from densify.depth.patches import (
    AGREE_FRACTION,
    AGREE_M,
    FOOTPRINT,
    HIDDEN_FRACTION,
    HIDDEN_M,
    add_moments,
    limit_inverse,
    plane,
)
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.compiled import Kernel, inlined

_NONE = int(np.iinfo(np.uint8).max)  # number of steps if no known pixel is within 254 steps
_BLUR_PX = 0.6  # standard deviation; it removes noise and the pattern of the colour filter
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
_DECAY = 1.2  # distance at which a vote counts half, in spacings of neighbouring rays
VOTERS_REACH = 5 * _DECAY
"""Greatest distance of a voting pixel, in spacings of neighbouring rays."""
_COLOURS = 6.0  # standard deviation of the colours of a surface, in L*a*b*
_ACROSS_EDGE = 0.001  # least weight of a vote, across an edge of the image
_STRIDE = 3.0  # number of compared colours per spacing of rays, on the path to a voter
# Weight of a constant vote, half of it for the depth and half against. Without it voters that are
# all beyond edges of the image, and weigh almost nothing, would decide.
_DOUBT = 0.04
_SHIFT = 0.6  # tested shift of the image, in spacings of neighbouring rays
# Tested shifts to the right and down, in units of `_SHIFT`: none, and one to each side
_SHIFTS = np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)]).astype(np.int64)
ROUNDED = 1 - 1e-6
"""Factor of a least share of votes, for rounding errors of the sums."""
# Four directions, from the right to almost below. Turned by quarters they give all.
DIRECTIONS = np.concatenate(
    [
        np.array([[(1, 0), (2, 0)], [(1, 0), (2, 1)], [(1, 1), (2, 2)], [(0, 1), (1, 2)]])
        @ np.linalg.matrix_power([[0, -1], [1, 0]], num_turns).T
        for num_turns in range(4)
    ]
)
"""(16,2,2) offsets (columns, rows) after one step and after two steps in 16 directions, clockwise
from the right. Each step goes to one of the eight neighbours."""
LEAST_SHARE = 0.97
"""Share of the votes for a boundary pixel that is kept."""
_FILL_SHARE, _STAR_SHARE = 0.9, 0.8  # share of the votes for a pixel of `fill`, of `fill_stars`
_NUM_SIZES = 3  # number of window sizes, up to a half size of a spacing of rays
_RIDGE_PX2 = 1e-7  # see `densify.depth.patches.plane`
_MIN_PLANE_PX = 6  # fewer pixels do not distinguish a plane from a step
_MOST_PX = 120  # greatest half size of a window, limits the time
_MIN_MET = len(DIRECTIONS) // 2  # least number of directions with a known pixel
# Number of neighbouring directions without a known pixel from which the hole is open to one side
_OPEN_SIDE = len(DIRECTIONS) // 2
_STAR_SPREAD = 0.1  # greatest difference between the predictions, as a share of inverse depth
_SPOT_PX = 4  # greatest radius of a laser's spot


def to_lab(image: NDArray[np.uint8]) -> Float32:
    """Return an RGB image (H,W,3) in CIE L*a*b*, slightly blurred, and lightened if dark."""
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    lightest = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(lightest, 1.0)))


@Kernel
def _march(steps):  # type: ignore[no-untyped-def]
    """Fill in ``steps`` (16,H+4,W+4) to the next known pixel; known pixels and border are given."""
    # The steps of a pixel follow from the steps of the pixels one and two steps on. Rows are
    # visited against the direction, so that those two pixels come first.
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
            # A known pixel has 0 steps. A pixel has 1 step if the pixel one step on is known, else
            # two more than the pixel two steps on. A sum above 255 (_NONE) would overflow.
            after_one = steps[d, row + v1, 2 + u1 : width - 2 + u1]
            after_two = steps[d, row + v2, 2 + u2 : width - 2 + u2]
            for j in range(len(line)):
                farther = min(after_two[j], np.uint8(253)) + np.uint8(2)
                farther = np.uint8(1) if after_one[j] == 0 else np.uint8(farther)
                line[j] = np.uint8(0) if line[j] == 0 else farther


@inlined
def offset(d, k):  # type: ignore[no-untyped-def]
    """Return the offset in columns and in rows after k steps in direction d of `DIRECTIONS`."""
    du = (k // 2) * DIRECTIONS[d, 1, 0] + (k % 2) * DIRECTIONS[d, 0, 0]
    dv = (k // 2) * DIRECTIONS[d, 1, 1] + (k % 2) * DIRECTIONS[d, 0, 1]
    return du, dv


@inlined
def extend(inverse, tilt, v, u, du, dv):  # type: ignore[no-untyped-def]
    """Return the inverse depth (1/m) of the surface of pixel (v, u), extended to (v - dv, u - du).

    ``inverse`` (H,W) holds inverse depths in 1/m, ``tilt`` (H,W,2) their slopes to the right and
    down in 1/m per px. v and dv count rows, u and du columns.
    """
    at_start = inverse[v, u]
    on_plane = at_start - tilt[v, u, 0] * du - tilt[v, u, 1] * dv
    return limit_inverse(on_plane, at_start)


class Voters(NamedTuple):
    """Pixels with a known depth, which vote on the depths of pixels around them."""

    # (16,H,W) steps to the first voter in each of `DIRECTIONS`, 0 at a voter, `_NONE` without one
    steps: NDArray[np.uint8]
    inverse: Float32  # (H,W) inverse depth in 1/m, 0 where the depth is unknown
    tilt: Float32  # (H,W,2) slope of the inverse depth to the right and down, 1/m per px

    @staticmethod
    def of(depth_m: Float32, tilt: Float32) -> Voters:
        """Return the pixels with a depth above 0 of a map (H,W) in metres as voters."""
        known = depth_m > 0
        height, width = known.shape
        # Two steps reach at most two pixels beyond the image, hence a border of two on each side.
        padded = np.full((len(DIRECTIONS), height + 4, width + 4), _NONE, np.uint8)
        steps = padded[:, 2:-2, 2:-2]
        np.copyto(steps, 0, where=known)
        _march(padded)
        inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=known)
        return Voters(steps, inverse, tilt)


def votes_for(
    record: MapRecord, maps_m: Sequence[Float32], pixel: Int, depth_m: Float32, with_shifts: bool
) -> Float32:
    """Return the (P,) weighted share of the votes, 0 to 1, that confirm the depth of each pixel.

    The first known pixel in each of 16 directions votes, up to 6 ray spacings away. It votes for
    the depth if its own surface, extended to the pixel, has this depth to 0.2 m and 6 %, otherwise
    against. Edges of the record's image, and distance, weaken votes.

    Args:
        maps_m: Depths (H,W) in metres of the pixels that vote, 0 for other pixels. The least share
            of the maps counts.
        pixel: (P,) flat indices of the pixels.
        depth_m: (P,) depths of the pixels in metres, which are to be confirmed.
        with_shifts: Take the least share of five positions of the image, unshifted and shifted by
            0.6 ray spacings to each side, with a small constant vote. Otherwise the image is
            unshifted, and a pixel without voters has the share 0.
    """
    shares = np.ones((len(maps_m), len(pixel)), np.float32)
    # The kernel is compiled for each memory layout of its arrays: one layout saves time.
    tilt, inverse = np.ascontiguousarray(record.tilt), 1 / depth_m
    colours, gap_px = np.ascontiguousarray(record.lab), record.gap_px
    for map_m, share in zip(maps_m, shares, strict=True):
        voters = Voters.of(map_m, tilt)
        _vote.over_rows(len(pixel), pixel, inverse, voters, colours, gap_px, with_shifts, share)
    return shares.min(axis=0)


@inlined
def _steps_to_other(steps, d, v, u):  # type: ignore[no-untyped-def]
    """Return the steps in direction d from row v, column u to another known pixel, or `_NONE`."""
    num_steps = np.int64(steps[d, v, u])
    height, width = steps.shape[1:]
    # A known pixel is 0 steps from itself, so the pixels one and two steps on decide. For unknown
    # pixels the loop is empty.
    for k in range(1, 3 if num_steps == 0 else 1):
        du, dv = offset(d, k)
        if not (0 <= u + du < width and 0 <= v + dv < height):
            return _NONE
        num_steps = k + np.int64(steps[d, v + dv, u + du])
        if num_steps == k:
            return num_steps
    return min(num_steps, _NONE)


@inlined
def _cast_votes(voters, v, u, depth_m, gap_px, steps, agrees):  # type: ignore[no-untyped-def]
    """Fill ``steps`` (16,) to the voters, 0 without one, and ``agrees`` (16,), and count votes."""
    tolerance_m = HIDDEN_M + HIDDEN_FRACTION * depth_m
    num_for, num_against = 0, 0
    for d in range(len(steps)):
        k = _steps_to_other(voters.steps, d, v, u)
        du, dv = offset(d, k)
        steps[d], agrees[d] = 0, False
        if k == _NONE or max(abs(du), abs(dv)) > VOTERS_REACH * gap_px:
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
def _vote(begin, end, pixel, inverse, voters, lab, gap_px, with_shifts, share):  # type: ignore[no-untyped-def]
    """Fill ``share`` (P,) with the share of the votes for inverse depths ``inverse`` (P,), 1/m."""
    width, num_directions = gap_px.shape[1], len(DIRECTIONS)
    steps, agrees = np.empty(num_directions, np.int64), np.empty(num_directions, np.bool_)
    doubt = _DOUBT if with_shifts else 0.0
    for i in range(begin, end):
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


def accept_boundary_pixels(record: MapRecord, rims: str) -> None:
    """Accept or reject each boundary pixel of the record, in place.

    By ``rims``, the setting ``project.rims``, ``image`` accepts pixels with 97 % of the votes, or
    no pixel without an image. ``keep`` accepts all pixels, and any other value none.
    """
    pixel = np.flatnonzero(record.boundary_m)
    depth_m = record.boundary_m.flat[pixel]
    if record.lab.size:
        share = votes_for(record, [record.depth_m], pixel, depth_m, with_shifts=True)
    else:
        share = np.full(len(pixel), np.float32(0.5))  # without an image neither for nor against
    accepted = share >= LEAST_SHARE if rims == "image" else np.full(len(pixel), rims == "keep")
    record.votes.flat[pixel] = share
    record.depth_m.flat[pixel[accepted]] = depth_m[accepted]
    record.rejected_m.flat[pixel[~accepted]] = depth_m[~accepted]
    record.filled_m[:] = record.depth_m


def _reject_unconfirmed(record: MapRecord, empty: Bool, least_share: float) -> None:
    """Reject filled pixels that were ``empty`` (H,W) and have less than this share of votes."""
    is_new = empty & (record.filled_m > 0)
    pixel = np.flatnonzero(is_new)
    # Filled pixels have no vote, because they would confirm themselves. Boundary pixels that were
    # not accepted vote in one of two maps. The lesser share counts, so they can only lower a share.
    # This protects the pillar of a car, which has few measured pixels.
    maps_m = np.maximum(record.depth_m, record.boundary_m), record.depth_m
    share = votes_for(record, maps_m, pixel, record.filled_m.flat[pixel], with_shifts=False)
    record.votes.flat[pixel] = share
    is_rejected = np.zeros_like(is_new)
    is_rejected.flat[pixel] = share < ROUNDED * least_share
    record.reject(is_rejected)


class _Known(NamedTuple):
    """The K known pixels of a map, row by row."""

    # (H,W+1) index of the first known pixel from row r, column c on: the number of known pixels
    # above row r, and left of column c in row r
    before: NDArray[np.int32]
    integral: NDArray[np.int32]  # (H+1,W+1) number of known pixels above row r, left of column c
    column: NDArray[np.int32]  # (K,) column of each pixel
    inverse: Float  # (K,) float64 inverse depth of each pixel, 1/m


def fill(record: MapRecord, reach: float) -> None:
    """Interpolate empty pixels of the record that have measured pixels on both sides, in place.

    The window around an empty pixel must hold measured pixels to its left, to its right, above and
    below: nothing is extrapolated. No depth discontinuity may run through the window. Pixels on
    both sides of a discontinuity deviate from a plane by amounts that differ by over 0.2 m and 6 %
    of the nearest depth. With fewer than six pixels the depths themselves are compared.

    The pixel gets the depth of the weighted plane in inverse depth. The half size of the window
    grows in thirds of the ray spacing, then to ``reach`` spacings. The smallest sufficient window
    is taken. Pixels with less than nine tenths of the votes are rejected.
    """
    sizes = min(reach, 1.0) * np.arange(1, _NUM_SIZES + 1) / _NUM_SIZES
    reaches = np.append(sizes, reach) if reach > 1 else sizes
    filled_m = record.filled_m
    is_known = filled_m > 0
    height, width = is_known.shape
    before = np.zeros((height, width + 1), np.int32)
    np.cumsum(is_known, axis=1, dtype=np.int32, out=before[:, 1:])
    integral = np.zeros((height + 1, width + 1), np.int32)
    np.cumsum(before, axis=0, out=integral[1:])
    before += integral[:-1, -1:]  # the pixels of the rows above
    column = np.nonzero(is_known)[1].astype(np.int32)
    known = _Known(before, integral, column, inverse=1 / filled_m[is_known].astype(np.float64))
    _fill.over_rows(filled_m.size, known, record.spacing_px, reaches, filled_m, record.tilt)
    _reject_unconfirmed(record, ~is_known, _FILL_SHARE)


@inlined
def _has_known(total, top, bottom, left, right):  # type: ignore[no-untyped-def]
    """Return True if a rectangle has known pixels, by the integral image ``total`` of them."""
    return total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left] > 0


@inlined
def _is_surrounded(integral, window, row, column):  # type: ignore[no-untyped-def]
    """Return True if a window has known pixels to the left, to the right, above and below."""
    top, bottom, left, right = window
    return (
        _has_known(integral, top, bottom, left, column)
        and _has_known(integral, top, bottom, column + 1, right)
        and _has_known(integral, top, row, left, right)
        and _has_known(integral, row + 1, bottom, left, right)
    )


@inlined
def _sum_window(known, window, row, column, moments):  # type: ignore[no-untyped-def]
    """Fill in the ``moments`` (9,) of a window's known pixels, for `plane` around (row, column).

    Returned are their number, and the inverse depths (1/m) of the nearest and of the farthest one.
    """
    top, bottom, left, right = window
    # The image may cut the window on one side.
    reach_v, reach_u = max(row - top, bottom - 1 - row), max(column - left, right - 1 - column)
    num_known, nearest, farthest = 0, 0.0, np.inf
    moments[:] = 0.0
    for r in range(top, bottom):
        for k in range(known.before[r, left], known.before[r, right]):
            inverse, du, dv = known.inverse[k], known.column[k] - column, r - row
            # The weight falls to 0 one pixel outside the window.
            weight = (1 - abs(dv) / (reach_v + 1)) * (1 - abs(du) / (reach_u + 1))
            add_moments(moments, weight, du, dv, inverse)
            num_known += 1
            nearest, farthest = max(nearest, inverse), min(farthest, inverse)
    return num_known, nearest, farthest


@inlined
def _spread(known, window, row, column, centre, slope_u, slope_v):  # type: ignore[no-untyped-def]
    """Return the greatest minus the least deviation (1/m) of a window's pixels from a plane."""
    top, bottom, left, right = window
    low, high = np.inf, -np.inf
    for r in range(top, bottom):
        on_plane = centre + (r - row) * slope_v
        for k in range(known.before[r, left], known.before[r, right]):
            deviation = known.inverse[k] - on_plane - (known.column[k] - column) * slope_u
            low, high = min(low, deviation), max(high, deviation)
    return high - low


@Kernel
def _fill(begin, end, known, spacing_px, reaches, filled_m, tilt):  # type: ignore[no-untyped-def]
    """Interpolate empty pixels by the first sufficient window; ``reaches`` (spacings) ascend."""
    height, width = filled_m.shape
    moments = np.empty(9)
    for p in range(begin, end):
        row, column = p // width, p % width
        if filled_m[row, column] > 0:
            continue
        last_u, last_v = 0, 0  # half size of the last window
        for reach in reaches:
            # The window, unless rounding makes it equal to the last one
            across_px = reach * spacing_px[row, column, 0]
            down_px = reach * spacing_px[row, column, 1]
            reach_u = min(max(int(np.rint(across_px)), 1), _MOST_PX)
            reach_v = min(max(int(np.rint(down_px)), 1), _MOST_PX)
            if reach_u == last_u and reach_v == last_v:
                continue
            last_u, last_v = reach_u, reach_v
            window = (
                max(row - reach_v, 0),
                min(row + reach_v + 1, height),
                max(column - reach_u, 0),
                min(column + reach_u + 1, width),
            )
            if not _is_surrounded(known.integral, window, row, column):
                continue

            # No depth discontinuity: few pixels are compared by their depths, more by a plane.
            num_known, nearest, farthest = _sum_window(known, window, row, column, moments)
            allowed_m = max(HIDDEN_M, HIDDEN_FRACTION / nearest)
            if num_known < _MIN_PLANE_PX and 1 / farthest - 1 / nearest > allowed_m:
                continue
            centre, slope_u, slope_v = plane(moments, _RIDGE_PX2)
            spread = _spread(known, window, row, column, centre, slope_u, slope_v)
            # A difference of inverse depth, over its square, is a difference of depth (m).
            if num_known >= _MIN_PLANE_PX and spread / (centre * centre) > allowed_m:
                continue
            if centre > 0:
                filled_m[row, column] = 1 / centre
                tilt[row, column, 0], tilt[row, column, 1] = slope_u, slope_v
                break


def fill_stars(record: MapRecord) -> None:
    """Fill holes from the first known pixel, measured or filled, in each of 16 directions.

    At least eight directions need a known pixel within a ray spacing. At most seven neighbouring
    directions may have none, otherwise the depth would be extrapolated. The surfaces of the known
    pixels, extended to the hole, must agree to 10 % of inverse depth. The hole gets their mean,
    weighted by the reciprocal of the number of steps. A pixel needs eight tenths of the votes.
    """
    empty = record.filled_m == 0
    pixel = np.flatnonzero(empty)
    predicted_m = np.zeros(len(pixel), np.float32)
    known = Voters.of(record.filled_m, record.tilt)
    _star.over_rows(len(pixel), pixel, known, record.spacing_px, predicted_m)
    record.filled_m.flat[pixel] = predicted_m
    _reject_unconfirmed(record, empty, _STAR_SHARE)


@inlined
def _widest_gap(met):  # type: ignore[no-untyped-def]
    """Return the largest number of neighbouring directions where ``met`` (16,) is False."""
    widest = run = 0
    for d in range(2 * len(met)):  # twice around, for gaps across the first direction
        run = 0 if met[d % len(met)] else run + 1
        widest = max(widest, run)
    return min(widest, len(met))


@Kernel
def _star(begin, end, pixel, known, spacing_px, predicted_m):  # type: ignore[no-untyped-def]
    """Fill ``predicted_m`` (P,) with the depths of `fill_stars` at empty pixels, 0 for none."""
    width = known.inverse.shape[1]
    met = np.empty(len(DIRECTIONS), np.bool_)
    for p in range(begin, end):
        row, column = pixel[p] // width, pixel[p] % width
        reach_px = max(spacing_px[row, column, 0], spacing_px[row, column, 1])
        num_met, nearest, farthest = 0, 0.0, np.inf
        weighted_sum, sum_weights = 0.0, 0.0
        for d in range(len(DIRECTIONS)):
            k = np.int64(known.steps[d, row, column])  # at least 1, as the pixel is empty
            du, dv = offset(d, k)
            met[d] = k != _NONE and du * du + dv * dv <= reach_px * reach_px
            if met[d]:
                inverse = extend(known.inverse, known.tilt, row + dv, column + du, du, dv)
                nearest, farthest = max(nearest, inverse), min(farthest, inverse)
                weighted_sum += inverse / k
                sum_weights += 1 / k
                num_met += 1
        if num_met < _MIN_MET or _widest_gap(met) >= _OPEN_SIDE:
            continue
        mean = weighted_sum / sum_weights
        if nearest - farthest <= _STAR_SPREAD * mean:
            predicted_m[p] = 1 / mean


def measure_spots(record: MapRecord) -> None:
    """Mark filled pixels as measured, with their depth unchanged, if a laser spot covers them."""
    # The spot of the return that measured each pixel
    points = record.points
    measured = np.flatnonzero(record.depth_m > 0)
    index_in_image = np.zeros(len(record.reason), np.int64)  # by index in the cloud
    index_in_image[points.rows] = np.arange(len(points.rows))
    point = index_in_image[record.point.flat[measured]]
    radius_px = np.minimum(FOOTPRINT * points.spacing_px[point, 0], _SPOT_PX)
    uv = points.uv[point]

    # Each covered pixel takes the source of the return with the nearest spot.
    interpolated_m = np.where(record.depth_m == 0, record.filled_m, np.float32(0))
    source = np.full(interpolated_m.shape, -1)  # flat index of a measured pixel
    least_px2 = np.full(interpolated_m.shape, np.inf)
    _cover(measured, uv, radius_px, record.depth_m, record.tilt, interpolated_m, source, least_px2)
    covered = np.flatnonzero(source >= 0)
    record.depth_m.flat[covered] = record.filled_m.flat[covered]
    record.point.flat[covered] = record.point.flat[source.flat[covered]]


@Kernel
def _cover(pixel, uv, radius_px, depth_m, tilt, interpolated_m, source, least_px2):  # type: ignore[no-untyped-def]
    """Fill ``source`` (H,W) with the measured pixel whose spot covers each interpolated pixel.

    The spots of the measured pixels, flat indices ``pixel`` (P,), have the centres ``uv`` (P,2) and
    radii (P,). The nearest centre counts; ``least_px2`` (H,W) is its squared distance, inf before.
    """
    height, width = interpolated_m.shape
    for i in range(len(pixel)):
        v, u = pixel[i] // width, pixel[i] % width
        return_m = depth_m[v, u]
        reach = int(radius_px[i] + 0.5)  # the spot's centre is up to half a pixel from the pixel's
        for row in range(max(v - reach, 0), min(v + reach + 1, height)):
            for column in range(max(u - reach, 0), min(u + reach + 1, width)):
                fill_m = interpolated_m[row, column]
                if fill_m == 0:
                    continue
                px2 = (column - uv[i, 0]) ** 2 + (row - uv[i, 1]) ** 2
                if px2 > radius_px[i] * radius_px[i] or px2 >= least_px2[row, column]:
                    continue
                # The surface of the return, extended to the pixel, must have the filled depth:
                # |fill / surface - 1| is at most the tolerance as a share of the surface.
                inverse = 1 / return_m + (column - u) * tilt[v, u, 0] + (row - v) * tilt[v, u, 1]
                tolerance_m = AGREE_M + AGREE_FRACTION * return_m
                if abs(fill_m * inverse - 1) <= tolerance_m * abs(inverse):
                    least_px2[row, column] = px2
                    source[row, column] = pixel[i]
