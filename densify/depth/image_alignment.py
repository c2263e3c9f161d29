# SPDX-License-Identifier: MIT
"""A camera's image in L*a*b*, and where it lies over the depth map.

Where an image fits, it changes across the edges of depth. The sum of its changes there is compared
with that of the image shifted, in steps of a third of the gap between rays: a cross-correlation.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.depth.layers import Layers
from densify.geometry.types import Float, Float32

_BLUR_PX = 0.6  # standard deviation; noise and the colour filter's pattern
_LEAST_LIGHT = 70.0  # L of the lightest hundredth; a darker image is lightened
_ASIDE = 3  # steps; nearer than these and it fits, farther than twice as many and it cannot
# Standard deviations of the shifts at which it cannot fit. Right images reach 3.8 to 7.2, and where
# they are at most 0.7 less; mirrored ones and those of other scenes reach 3.1.
_LEAST, _CLEARLY = 3.5, 1.2


def lab(image: NDArray[np.uint8]) -> Float32:
    """Return (H,W,3) float32 CIE L*a*b*, L from 0 to 100, of an (H,W,3) RGB image.

    It is slightly blurred, and lightened if it is dark: distances say how different colours look.
    """
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    colours = cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
    light = float(np.percentile(colours[..., 0], 99))
    return colours * np.float32(max(1.0, _LEAST_LIGHT / max(light, 1.0)))


class Aligned(NamedTuple):
    """An image (H,W,3) moved to where it fits, and by how much it lay aside."""

    lab: Float32
    right_px: int = 0
    down_px: int = 0

    def __str__(self) -> str:
        """Return where it lay, such as "2 px to the left and 1 px too high"."""
        across = f"{abs(self.right_px)} px to the {'right' if self.right_px > 0 else 'left'}"
        along = f"{abs(self.down_px)} px too {'low' if self.down_px > 0 else 'high'}"
        ways = ((self.right_px, across), (self.down_px, along))
        return " and ".join(said for off_px, said in ways if off_px)


def align_image(layers: Layers) -> Aligned | None:
    """Return the image of the layers, moved to where it fits; None if it fits nowhere near.

    At most 3 steps away its edges must stand out by 3.5 standard deviations. It is moved there if
    they stand out by 1.2 more than where it is.
    """
    lab, step_px = layers.lab, max(1, round(0.3 * float(np.median(layers.gap_px))))
    if lab is None:
        return None
    reach = 4 * _ASIDE
    right, down = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    sums = _edge_sums(lab, layers, step_px)[down, right]
    away = np.hypot(right, down)
    elsewhere = away > 2 * _ASIDE
    terms = np.stack([right, down, np.ones_like(right)], axis=2)
    trend = np.linalg.lstsq(terms[elsewhere], sums[elsewhere], rcond=None)[0]
    left = sums - terms @ trend
    stands_out = left / max(float(left[elsewhere].std()), float(np.finfo(np.float32).tiny))
    stands_out[away > _ASIDE] = -np.inf
    best = np.unravel_index(stands_out.argmax(), away.shape)
    if stands_out[best] < _LEAST:
        return None
    if stands_out[best] - stands_out[reach, reach] <= _CLEARLY:
        return Aligned(lab)
    by_px = step_px * down[best], step_px * right[best]
    rows, columns = (
        np.clip(np.arange(size) + off, 0, size - 1)
        for size, off in zip(lab.shape[:2], by_px, strict=True)
    )
    return Aligned(np.ascontiguousarray(lab[rows[:, None], columns]), int(by_px[1]), int(by_px[0]))


def _edge_sums(lab: Float32, layers: Layers, step_px: int) -> Float:
    """Return (H,W) how much the image changes across the edges of depth, by the steps that it is
    shifted down and to the right; negative ones count from the end.

    Of each boundary pixel it is the squared gradient of lightness along the gradient of depth.
    Gradients are a share of their sum with the usual one: a strong one counts no more than a few.
    """
    clear_m = np.where(layers.veiled, np.float32(0), np.maximum(layers.depth_m, layers.rim_m))
    known = clear_m > 0
    inverse = np.divide(1, clear_m, out=np.zeros_like(clear_m), where=known)
    light, nearness, weight, rims = (
        _reduced(part, step_px)
        for part in (lab[..., 0], inverse, known, known & (layers.rim_m > 0))
    )
    change = _gradient(light)
    size = np.hypot(*change)
    change /= np.maximum(size + np.median(size), np.finfo(np.float32).tiny)
    nearness, weight = (
        cv2.GaussianBlur(a, (0, 0), 1).astype(np.float32, copy=False) for a in (nearness, weight)
    )
    across = _gradient(nearness / np.maximum(weight, np.finfo(np.float32).eps))
    across /= np.maximum(np.hypot(*across), np.finfo(np.float32).tiny)
    spectrum = sum(
        np.fft.rfft2(change[i] * change[j]) * np.conj(np.fft.rfft2(rims * across[i] * across[j]))
        for i in (0, 1)
        for j in (0, 1)
    )
    sums: Float = np.fft.irfft2(spectrum, light.shape)
    return sums


def _reduced(image: NDArray[np.generic], step_px: int) -> Float32:
    """Return an image each pixel of which is the mean of ``step_px`` by ``step_px``."""
    size = (-(-image.shape[1] // step_px), -(-image.shape[0] // step_px))
    reduced = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return reduced.astype(np.float32, copy=False)


def _gradient(image: Float32) -> Float32:
    """Return (2,H,W) the gradient right and down."""
    return np.stack([cv2.Sobel(image, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))])
