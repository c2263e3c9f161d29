# SPDX-License-Identifier: MIT
"""A camera's image as depth maps look at it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.types import Bool, Float, Float32

_BLUR_PX = 0.6  # standard deviation; noise and the colour filter's pattern
_AROUND_PX = 20.0  # standard deviation; over which edges are compared
_EDGE_PX = 1.5  # standard deviation of the blur that tells which way depth changes
_MOST = 6000  # edges that are looked at
_STRONG = 4.0  # a stronger edge counts no more
_REACH = 14  # steps to all sides in which the image is laid elsewhere
_ASIDE, _ELSEWHERE = 3.2, 6.0  # steps; nearer and it fits, farther and it cannot
_LEAST_SCORE = 2.2  # standard deviations above what it is elsewhere
_LEAST_RATIO = 1.05  # to what it is elsewhere; noise reaches 1.03
_LEAST_GAIN = 0.1  # of what edges stand out by, for which the image is moved
_CERTAIN_GAIN = 1.0  # standard deviations elsewhere; right images reach 0.9
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
_REBLUR_PX = 1.5  # standard deviation
_MOST_BLUR = 2.0  # steps, standard deviation
_EDGES_LOOKED_AT = 0.03  # of the pixels


def lab(image: NDArray[np.uint8]) -> Float32:
    """(H,W,3) RGB -> (H,W,3) float32 CIE L*a*b*, L from 0 to 100, slightly blurred: distances tell
    about how different two colours look. A dark image is lightened until they do."""
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    light = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(light, 1.0)))


def blurred(values: Float32, blur_px: tuple[float, float]) -> Float32:
    """(H,W) blurred by a Gaussian, standard deviations down and across, out to 2.5 of them."""
    down_px, across_px = blur_px
    size = (2 * round(2.5 * across_px) + 1, 2 * round(2.5 * down_px) + 1)
    made = cv2.GaussianBlur(
        values, size, sigmaX=across_px, sigmaY=down_px, borderType=cv2.BORDER_REFLECT
    )
    return made.astype(np.float32, copy=False)


class Laid(NamedTuple):
    """An image (H,W,3) moved to where it fits. right_px, down_px: by how much it lay aside.
    certain: more than right images are moved by chance."""

    lab: Float32
    right_px: int = 0
    down_px: int = 0
    certain: bool = False

    def __str__(self) -> str:
        """How it lay aside: "2 px to the left and 1 px too high"."""
        across = f"{abs(self.right_px)} px to the {'right' if self.right_px > 0 else 'left'}"
        along = f"{abs(self.down_px)} px too {'low' if self.down_px > 0 else 'high'}"
        ways = ((self.right_px, across), (self.down_px, along))
        return " and ".join(said for off_px, said in ways if off_px)


def laid_over(lab: Float32, depth_m: Float32, at: Bool, step_px: int = 1) -> Laid | None:
    """The image moved to where it has edges where depth has; None if it does not fit.

    lab: (H,W,3). depth_m: (H,W), 0 none, with edges ``at`` (H,W). How much the image changes there
    across the edges of depth is summed up with the image as it is and laid elsewhere, by up to 14
    steps of ``step_px`` to all sides. It fits if the sum is largest at most 3.2 steps away, and 2.2
    standard deviations and a twentieth larger than 6 steps and more away, and if the image is not
    blurred by more than 2 steps: the sharper an edge, the more another blur takes from its gradient
    (Zhuo and Sim, "Defocus map estimation from a single image", 2011). It is moved if edges stand
    out a tenth more there.
    """
    if _blur_px(lab) > _MOST_BLUR * step_px:
        return None
    sums = _edge_sums(lab, depth_m, at, step_px)
    offsets = np.arange(-_REACH, _REACH + 1)
    steps = np.hypot(*np.meshgrid(offsets, offsets))
    elsewhere = sums[steps > _ELSEWHERE]
    mean, here = elsewhere.mean(), sums[_REACH, _REACH]
    best = sums[steps <= _ASIDE].max()
    least = max(mean + _LEAST_SCORE * elsewhere.std(), _LEAST_RATIO * mean)
    if best < sums.max() or best <= least:
        return None
    if best - here <= _LEAST_GAIN * (best - mean):
        return Laid(lab)
    down, right = step_px * (np.array(np.unravel_index(sums.argmax(), sums.shape)) - _REACH)
    rows, columns = (
        np.clip(np.arange(size) + off, 0, size - 1)
        for size, off in zip(lab.shape[:2], (down, right), strict=True)
    )
    moved = np.ascontiguousarray(lab[rows[:, None], columns])
    return Laid(moved, int(right), int(down), bool(best - here > _CERTAIN_GAIN * elsewhere.std()))


def _edge_sums(lab: Float32, depth_m: Float32, at: Bool, step_px: int) -> Float:
    """(29,29) how much the image laid so many steps down and to the right changes across the edges
    of depth."""
    row, column = (f[:: len(f) // _MOST + 1] // step_px for f in np.nonzero(at))
    right, down = _across(depth_m, step_px)[:, row, column]
    changes = _changes(_reduced(lab, step_px))
    changes = np.pad(changes, ((0, 0), (_REACH, _REACH), (_REACH, _REACH)), "edge")
    width, (x, y) = changes.shape[2], changes.reshape(2, -1)
    place = (row + _REACH) * width + column + _REACH
    offsets = range(-_REACH, _REACH + 1)

    def change(du: int, dv: int) -> float:
        there = place + dv * width + du
        return float(np.abs(x[there] * right + y[there] * down).mean())

    return np.array([[change(du, dv) for du in offsets] for dv in offsets])


def _blur_px(lab: Float32) -> float:
    """Standard deviation of the blur that the image's strongest edges have."""
    light = lab[..., 0]
    again = cv2.GaussianBlur(light, (0, 0), _REBLUR_PX).astype(np.float32, copy=False)
    before, after = (np.hypot(*_gradient(image)) for image in (light, again))
    edges = after >= max(float(np.quantile(after, 1 - _EDGES_LOOKED_AT)), 1e-6)
    if not edges.any():
        return np.inf
    steeper = float(np.median(before[edges] / after[edges]))
    return _REBLUR_PX / float(np.sqrt(max(steeper**2 - 1, 1e-6)))


def _reduced(image: Float32, step_px: int) -> Float32:
    """(H,W,…), each pixel the mean of ``step_px`` by ``step_px``."""
    if step_px == 1:
        return image
    size = (-(-image.shape[1] // step_px), -(-image.shape[0] // step_px))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32, copy=False)


def _across(depth_m: Float32, step_px: int) -> Float32:
    """(2,H,W) direction right and down in which depth changes most, of the reduced map."""
    known = depth_m > 0
    inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=known)
    sums, weight = (
        cv2.GaussianBlur(_reduced(part, step_px), (0, 0), _EDGE_PX)
        for part in (inverse, known.astype(np.float32))
    )
    direction = _gradient((sums / (weight + 1e-3)).astype(np.float32, copy=False))
    return direction / np.maximum(np.hypot(*direction), 1e-12)


def _changes(lab: Float32) -> Float32:
    """(2,H,W) gradient of the channel that changes most, against the changes around."""
    change, size = _gradient(lab[..., 0]), np.zeros(lab.shape[:2], np.float32)
    for channel in np.moveaxis(lab, 2, 0):
        gradient = _gradient(channel)
        length = np.hypot(*gradient)
        change = np.where(length > size, gradient, change)
        size = np.maximum(length, size)
    around = cv2.GaussianBlur(size, (0, 0), _AROUND_PX) + 1
    return change / np.maximum(around, size / _STRONG)


def _gradient(image: Float32) -> Float32:
    """(2,H,W) right and down."""
    orders = ((1, 0), (0, 1))
    return np.stack([cv2.Sobel(image, cv2.CV_32F, *order) for order in orders])
