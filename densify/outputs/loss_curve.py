# SPDX-License-Identifier: MIT
"""The picture of a training: its loss, step by step, on a logarithmic scale."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from densify.geometry.types import Float
from densify.outputs.png import Picture

_WIDTH_PX, _HEIGHT_PX = 860, 420
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 84, 24, 52, 52
_DARK, _FAINT, _GRAY, _WHITE = 20, (52, 52, 52), (110, 110, 110), (235, 235, 235)
_POINT, _LINE = (60, 95, 130), (80, 170, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_ROUND = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
_SMOOTHED_OVER = 20  # of the whole, a twentieth


def draw_losses(losses: Float, title: str) -> Picture:
    """losses: (S,) positive, one a step: faint dots, and their running median as a line."""
    canvas = np.full((_HEIGHT_PX, _WIDTH_PX, 3), _DARK, np.uint8)
    shown = np.maximum(np.asarray(losses, float), 1e-12)
    _write(canvas, title, _LEFT_PX, 30, _WHITE)
    _write(canvas, "steps", _WIDTH_PX // 2, _HEIGHT_PX - 12, _GRAY)
    if not len(shown):
        return canvas
    low, high = shown.min(), max(shown.max(), shown.min() * 1.2)

    def place(step: ArrayLike, loss: ArrayLike) -> NDArray[np.int32]:
        share = np.log(np.asarray(loss) / low) / math.log(high / low)
        x = _LEFT_PX + (_WIDTH_PX - _LEFT_PX - _RIGHT_PX) * np.asarray(step) / max(len(shown), 1)
        y = _HEIGHT_PX - _BOTTOM_PX - (_HEIGHT_PX - _BOTTOM_PX - _TOP_PX) * share
        return np.rint(np.stack([x, y], axis=-1)).astype(np.int32)

    for power in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1):
        for factor in _ROUND:
            value = factor * 10.0**power
            if low <= value <= high:
                _, y = place(0, value)
                cv2.line(canvas, (_LEFT_PX, int(y)), (_WIDTH_PX - _RIGHT_PX, int(y)), _FAINT)
                _write(canvas, f"{value:g}", 12, int(y) + 5, _GRAY)
    for share in (0, 0.25, 0.5, 0.75, 1):
        step = round(share * len(shown))
        x, y = place(step, low)
        _write(canvas, str(step), int(x) - 8, int(y) + 22, _GRAY)
    for x, y in place(np.arange(len(shown)) + 0.5, shown):
        cv2.circle(canvas, (int(x), int(y)), 1, _POINT, -1, cv2.LINE_AA)
    half = max(1, len(shown) // _SMOOTHED_OVER // 2)
    steps = np.arange(len(shown))
    middle = np.array([np.median(shown[max(0, i - half) : i + half + 1]) for i in steps])
    cv2.polylines(canvas, [place(steps + 0.5, middle)], False, _LINE, 2, cv2.LINE_AA)
    return canvas


def _write(canvas: Picture, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    cv2.putText(canvas, text, (x, y), _FONT, 0.5, colour, 1, cv2.LINE_AA)
