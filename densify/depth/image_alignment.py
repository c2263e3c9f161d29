# SPDX-License-Identifier: MIT
"""Convert a camera image to L*a*b*, and align it with the depth map.

The image is shifted in steps of a third of the spacing of neighbouring rays. The score of a shift
is the sum of the image's colour changes on depth discontinuities. At the right shift this sum is
much larger than at all others.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.layers import Layers
from densify.geometry.types import Float, Float32, Int

_BLUR_PX = 0.6  # standard deviation; it removes noise and the pattern of the colour filter
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
_REACH = 14  # steps to all sides
_ASIDE, _ELSEWHERE = 3.2, 6.0  # steps: greatest accepted shift, least shift of the comparison
# In standard deviations of the shifts elsewhere. Good images have 3.1 to 11 at no shift, and at
# most 1.9 more nearby. Mirrored images reach 3.0.
_LEAST, _LEAST_ASIDE, _CLEARLY = 3.05, 5.0, 1.9
_TREND = 3  # degree of the polynomial of the slow trend
_MOST = 6000  # number of compared edges of each kind
_JUMPS_COUNT = 0.4  # weight of each kind of depth jumps, relative to boundary pixels
_ONE_SURFACE, _JUMP = (0.1, 0.02), (0.3, 0.05)  # metres plus share of the depth
_GAP, _STRICT_GAP = 3, 10  # steps between neighbouring pixels, without boundary pixels
_EDGE_PX = 1.5  # standard deviation of the blur for the direction of a discontinuity
_AROUND_PX, _STRONG = 20.0, 4.0  # surroundings of an edge; greatest relative strength
_REBLUR_PX, _MOST_BLUR, _EDGES_LOOKED_AT = 1.5, 2.0, 0.03  # px; steps; share of the pixels


def lab(image: NDArray[np.uint8]) -> Float32:
    """Convert an (H,W,3) RGB image to (H,W,3) float32 CIE L*a*b* with L from 0 to 100.

    The result is slightly blurred, and lightened if it is dark. In L*a*b* the distance of two
    colours measures how different they look.
    """
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    light = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(light, 1.0)))


class Aligned(NamedTuple):
    """An image, shifted to fit the depth map, and its offset before.

    Attributes:
        lab: (H,W,3) shifted image in L*a*b*.
        right_px: Pixels by which the image was too far to the right.
        down_px: Pixels by which the image was too low.
    """

    lab: Float32
    right_px: int = 0
    down_px: int = 0

    def __str__(self) -> str:
        """Return the offset in words, such as "2 px to the left and 1 px too high"."""
        across = f"{abs(self.right_px)} px to the {'right' if self.right_px > 0 else 'left'}"
        along = f"{abs(self.down_px)} px too {'low' if self.down_px > 0 else 'high'}"
        ways = ((self.right_px, across), (self.down_px, along))
        return " and ".join(said for off_px, said in ways if off_px)


def align_image(layers: Layers) -> Aligned | None:
    """Return the layers' image, shifted to fit the depth; None if it does not fit or is blurred.

    Shifts are tried in steps of 0.3 ray spacings. The score of a shift is in standard deviations of
    the scores of distant shifts. The best shift must be at most 3.2 steps long. If the score
    without a shift is 3.05 or more, the image stays in place, unless the best score is more than
    1.9 higher. Otherwise it is shifted if the best score is at least 5.

    An image whose edges have a blur of more than two steps is not used. The sharper an edge, the
    more another blur lowers its gradient (Zhuo and Sim, "Defocus map estimation from a single
    image", 2011).
    """
    lab, step_px = layers.lab, max(1, round(0.3 * float(np.median(layers.gap_px))))
    if lab is None or _blur_px(lab) > _MOST_BLUR * step_px:
        return None
    found = _standing_out(_edge_sums(lab, layers, step_px))
    here, most = found[_REACH, _REACH], found.max()
    down, right = np.array(np.unravel_index(found.argmax(), found.shape)) - _REACH
    if np.hypot(down, right) > _ASIDE:
        return None
    if here >= _LEAST and most - here <= _CLEARLY:
        return Aligned(lab)
    if most < _LEAST_ASIDE:
        return None
    down, right = step_px * down, step_px * right
    rows, columns = (
        np.clip(np.arange(size) + off, 0, size - 1)
        for size, off in zip(lab.shape[:2], (down, right), strict=True)
    )
    return Aligned(np.ascontiguousarray(lab[rows[:, None], columns]), int(right), int(down))


def _standing_out(sums: Float) -> Float:
    """Return the (29,29) scores of all shifts, in standard deviations of distant shifts.

    A slow trend over the shifts is removed. sums: (29,29) sum of each shift, from `_edge_sums`.
    """
    offsets = np.arange(-_REACH, _REACH + 1)
    right, down = np.meshgrid(offsets, offsets)
    elsewhere = np.hypot(right, down) > _ELSEWHERE
    powers = [(i, j) for i in range(_TREND + 1) for j in range(_TREND + 1 - i)]
    terms = np.stack([(right / _REACH) ** i * (down / _REACH) ** j for i, j in powers], axis=2)
    trend = np.linalg.lstsq(terms[elsewhere], sums[elsewhere], rcond=None)[0]
    left: Float = sums - terms @ trend
    return left / max(float(left[elsewhere].std()), 1e-12)


def _edge_sums(lab: Float32, layers: Layers, step_px: int) -> Float:
    """Return the (29,29) sum of colour changes across depth discontinuities for each shift.

    Row and column are the shift of the image down and to the right, from -14 to 14 steps of
    ``step_px`` pixels. Discontinuities are boundary pixels, and depth jumps between neighbouring
    known pixels, with boundary pixels and without. The sums of each kind are divided by their mean.
    """
    known_m = np.maximum(layers.depth_m, layers.rim_m)
    strict_m = np.where(layers.rim_m == 0, layers.depth_m, np.float32(0))
    row, column = (_some(f) // step_px for f in np.nonzero((known_m > 0) & (layers.rim_m > 0)))
    changes = _changes(_reduced(lab, step_px))
    changes = np.pad(changes, ((0, 0), (_REACH, _REACH), (_REACH, _REACH)), "edge")
    sums = _sums(changes, row, column, *_across(known_m, step_px)[:, row, column])
    total = sums / max(float(sums.mean()), 1e-12)
    for depth_m, gap in ((known_m, _GAP), (strict_m, _STRICT_GAP)):
        row, column = _jumps(depth_m, gap, step_px)
        sums = _sums(changes, row, column, 1.0, 0.0)
        column, row = _jumps(np.ascontiguousarray(depth_m.T), gap, step_px)
        sums += _sums(changes, row, column, 0.0, 1.0)
        total += _JUMPS_COUNT * sums / max(float(sums.mean()), 1e-12)
    return total


def _sums(
    changes: Float32, row: Int, column: Int, right: float | Float32, down: float | Float32
) -> Float:
    """Return the (29,29) sums of colour changes at E pixels, one sum for each shift of the image.

    Args:
        changes: (2,h,w) colour change per step to the right and down, padded by 14 steps.
        row: (E,) row of each pixel, in steps.
        column: (E,) column of each pixel, in steps.
        right: Part to the right of the unit direction across the discontinuity, (E,) or common.
        down: Part of this direction downwards, (E,) or common.
    """
    width, (x, y) = changes.shape[2], changes.reshape(2, -1)
    offsets = np.arange(-_REACH, _REACH + 1)
    beside = (row + _REACH) * width + column + _REACH + offsets[:, None]
    rows = []
    for there in (beside + down_steps * width for down_steps in offsets):
        rows.append(np.abs(x.take(there) * right + y.take(there) * down).sum(axis=1))
    return np.array(rows, np.float64)


def _some(values: Int) -> Int:
    """Return the values, or at most 6,000 evenly spaced ones among them."""
    return values[:: len(values) // _MOST + 1]


def _jumps(depth_m: Float32, gap: int, step_px: int) -> tuple[Int, Int]:
    """Return the positions of depth jumps between neighbouring known pixels of an image row.

    On both sides of the jump the next known pixel must continue the surface, which excludes most
    foliage.

    Args:
        depth_m: (H,W) depth in metres, 0 for unknown pixels.
        gap: Greatest distance between the two pixels of a jump, in steps.
        step_px: Length of a step of the search, in pixels.

    Returns:
        The (E,) row and the (E,) column of the middle of each jump, in steps.
    """
    row, column = np.nonzero(depth_m)
    known_m = depth_m[row, column]
    off_m, least_m = np.abs(np.diff(known_m)), np.minimum(known_m[1:], known_m[:-1])
    near = (np.diff(row) == 0) & (np.diff(column) <= gap * step_px)
    on = near & (off_m < _ONE_SURFACE[0] + _ONE_SURFACE[1] * least_m)
    jumps = near & (off_m >= _JUMP[0] + _JUMP[1] * least_m)
    at = 1 + np.flatnonzero(on[:-2] & jumps[1:-1] & on[2:])
    middle = (column[at] + column[at + 1]) // 2
    return _some(row[at]) // step_px, _some(middle) // step_px


def _blur_px(lab: Float32) -> float:
    """Return the standard deviation, in px, of the blur of the image's strongest edges."""
    light = lab[..., 0]
    again = cv2.GaussianBlur(light, (0, 0), _REBLUR_PX).astype(np.float32, copy=False)
    before, after = (np.hypot(*_gradient(image)) for image in (light, again))
    edges = after >= max(float(np.quantile(after, 1 - _EDGES_LOOKED_AT)), 1e-6)
    if not edges.any():
        return np.inf
    steeper = float(np.median(before[edges] / after[edges]))
    return _REBLUR_PX / float(np.sqrt(max(steeper**2 - 1, 1e-6)))


def _reduced(image: Float32, step_px: int) -> Float32:
    """Return an image of means over ``step_px`` by ``step_px`` pixels."""
    if step_px == 1:
        return image
    size = (-(-image.shape[1] // step_px), -(-image.shape[0] // step_px))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32, copy=False)


def _across(depth_m: Float32, step_px: int) -> Float32:
    """Return (2,h,w) the unit direction (right, down) of the greatest change of depth.

    The map of h by w cells has one cell for ``step_px`` by ``step_px`` pixels of ``depth_m`` (H,W).
    """
    known = depth_m > 0
    inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=known)
    sums, weight = (
        cv2.GaussianBlur(_reduced(part, step_px), (0, 0), _EDGE_PX)
        for part in (inverse, known.astype(np.float32))
    )
    direction = _gradient((sums / (weight + 1e-3)).astype(np.float32, copy=False))
    return direction / np.maximum(np.hypot(*direction), 1e-12)


def _changes(lab: Float32) -> Float32:
    """Return (2,H,W) the gradient of the strongest channel, relative to its surroundings."""
    change, size = _gradient(lab[..., 0]), np.zeros(lab.shape[:2], np.float32)
    for channel in np.moveaxis(lab, 2, 0):
        gradient = _gradient(channel)
        length = np.hypot(*gradient)
        change = np.where(length > size, gradient, change)
        size = np.maximum(length, size)
    around = cv2.GaussianBlur(size, (0, 0), _AROUND_PX) + 1
    return change / np.maximum(around, size / _STRONG)


def _gradient(image: Float32) -> Float32:
    """Return the (2,H,W) gradient of an image (H,W) to the right and down."""
    return np.stack([cv2.Sobel(image, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))])
