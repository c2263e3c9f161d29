# SPDX-License-Identifier: MIT
"""The picture of scene flows of one sweep, from above, beside each other."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from densify.geometry.types import Float
from densify.outputs.png import Picture

HALF_M = 35.0
"""Shown to each side of the origin."""
LONGER = 3.0
"""Arrows are drawn so many times as long as the flow."""
LEAST_M = 0.05
"""Shorter flow has no arrow."""
_SIDE_PX, _TITLE_PX, _COLUMNS = 480, 26, 2
_DARK, _GRAY, _WHITE = 20, (105, 105, 105), (235, 235, 235)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # binary digits behind the point, of coordinates in pixels


def draw_arrows(points: Float, flows: Mapping[str, Float]) -> Picture:
    """points: (n,3) metres, x ahead (up in the picture), y to the left. flows: title to (n,3)
    metres. Two panels in a row; what moves has an arrow coloured by its direction, what does not is
    a gray dot."""
    num_rows = -(-len(flows) // _COLUMNS)
    height_px = _SIDE_PX + _TITLE_PX
    canvas = np.full((num_rows * height_px, _COLUMNS * _SIDE_PX, 3), _DARK, np.uint8)
    for i, (title, flow) in enumerate(flows.items()):
        top, left = i // _COLUMNS * height_px, i % _COLUMNS * _SIDE_PX
        cv2.putText(canvas, title, (left + 8, top + 18), _FONT, 0.5, _WHITE, 1, cv2.LINE_AA)
        panel = canvas[top + _TITLE_PX : top + height_px, left : left + _SIDE_PX]
        panel[:] = _panel(points, flow)
    return canvas


def _panel(points: Float, flow: Float) -> Picture:
    panel = np.full((_SIDE_PX, _SIDE_PX, 3), _DARK, np.uint8)
    panel[[0, -1]] = panel[:, [0, -1]] = 60
    length_m = np.linalg.norm(flow[:, :2], axis=1)
    moves = length_m >= LEAST_M
    for x, y in _places_px(points[~moves]):
        cv2.circle(panel, (int(x), int(y)), 1 << _SHIFT, _GRAY, -1, cv2.LINE_AA, _SHIFT)
    hue = np.rint((np.arctan2(flow[:, 1], flow[:, 0]) / np.pi + 1) * 89.5).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 190), np.full_like(hue, 255)], axis=1)
    colours = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    starts = _places_px(points[moves])
    ends = _places_px(points[moves] + LONGER * flow[moves])
    for start, end, colour in zip(starts, ends, colours[moves], strict=True):
        shade = tuple(int(c) for c in colour)
        cv2.line(panel, tuple(start), tuple(end), shade, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(panel, tuple(end), 1 << _SHIFT, shade, -1, cv2.LINE_AA, _SHIFT)
    return panel


def _places_px(points: Float) -> np.ndarray:
    """(n,2) in sixteenths of a pixel."""
    px = _SIDE_PX / 2 - points[:, [1, 0]] * _SIDE_PX / 2 / HALF_M
    return np.rint(np.clip(px, -1e4, 1e4) * (1 << _SHIFT)).astype(np.int32)
