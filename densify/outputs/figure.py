# SPDX-License-Identifier: MIT
"""The picture of a result: depth maps one below the other, each over the darkened image, distances
in colour with a scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float32, Reason, Result
from densify.outputs.context import Context
from densify.outputs.png import Picture, write_picture

# Fixed, so that pictures of different keys compare; logarithmic, as accuracy and density are.
_NEAR_M, _FAR_M = 3.0, 80.0
_TICKS_M = (3, 5, 10, 20, 40, 80)
_TURBO_LEVELS = 20, 238  # without the map's two dark ends, lost on a dark image
_BRIGHTNESS = 0.45
_REFERENCE_WIDTH_PX = 1242
_MIN_WIDTH_PX = 480
_POINT_SIZE_PX = 3
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TITLES = {"none": "sparse"}
_LEGEND_PX = 38
_REASON_COLOURS = {
    Reason.VETOED: (255, 70, 70),
    Reason.HIDDEN: (80, 140, 255),
    Reason.UNSUPPORTED: (255, 210, 60),
    Reason.EDGE: (90, 230, 120),
    Reason.GLASS: (235, 120, 255),
}


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``figure.png``: the result's baselines from top to bottom, then the result."""
    methods = {**result.baselines, result.method: result}
    write_figure(folder / "figure.png", methods, context)


def write_figure(path: Path, results: Mapping[str, Result], context: Context) -> None:
    """The measured depth of each method in the first camera, if there is one, and the last one's
    completed with a prior, if there was one."""
    depth = next(iter(results.values())).depth
    if not depth:
        return
    camera = next(iter(depth))
    image = context.image(camera, depth[camera].depth_m.shape)
    panels = {_TITLES.get(m, m): r.depth[camera].depth_m for m, r in results.items()}
    said = {_TITLES.get(m, m): _error(r, camera, "measured") for m, r in results.items()}
    method, result = list(results.items())[-1]
    if camera in result.full:
        title = f"{method} and prior"
        panels[title], said[title] = result.full[camera].depth_m, _error(result, camera, "full")
    write_picture(path, draw_figure(image, panels, said))


def _error(result: Result, camera: str, product: str) -> str:
    """How much is wrong, against the truth where there is some, else with the key held out."""
    for source, against in (("depth", "truth"), ("held_out", "key held out")):
        scores = (result.metrics.get(source) or {}).get(camera, {}).get(product)
        if scores and scores["all"]["outliers"] is not None:
            return f", {scores['all']['outliers']:.2%} wrong ({against})"
    return ""


def draw_figure(
    image: Picture, panels: Mapping[str, Float32], said: Mapping[str, str] | None = None
) -> Picture:
    """Draw depth maps over an image, from top to bottom in the mapping's order.

    image: (H,W,3) uint8 RGB. panels: title to (H,W) depth in metres, 0 none. Each is drawn over
    the image in gray; a depth covers 3 x 3 pixels (the nearest wins) so that single returns are
    seen; the share of pixels that have one stands beside the title, and behind it what is said of
    that title. Near is red, far is blue, logarithmic from 3 to 80 m, clamped beyond.

    Returns (H',W',3) uint8 RGB, at least 480 pixels wide.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"image: expected (H,W,3) uint8, got {image.dtype} {image.shape}")
    for title, depth_m in panels.items():
        if depth_m.shape != image.shape[:2]:
            raise ValueError(f"panel {title}: expected {image.shape[:2]}, got {depth_m.shape}")
    enlarge = -(-_MIN_WIDTH_PX // image.shape[1])  # whole factors keep pixels square and sharp
    width = image.shape[1] * enlarge
    rows = []
    for title, depth_m in panels.items():
        density = np.count_nonzero(depth_m) / depth_m.size
        beside = (said or {}).get(title, "")
        rows.append(_title(f"{title}: {density:.1%} of pixels{beside}", width))
        panel = _overlay(image, depth_m)
        rows.append(panel.repeat(enlarge, axis=0).repeat(enlarge, axis=1))
    rows.append(_colour_scale(width))
    return np.concatenate(rows)


def draw_rejected(image: Picture, reason: NDArray[np.uint8]) -> Picture:
    """Draw over an image in gray what was left out, in a colour for each `Reason`.

    image: (H,W,3) uint8 RGB. reason: (H,W), 0 none. Returns (H',W,3) with the legend below.
    """
    gray = _BRIGHTNESS * (image @ np.array([0.299, 0.587, 0.114]))
    canvas = np.repeat(np.rint(gray).astype(np.uint8)[:, :, None], 3, axis=2)
    legend = np.full((_LEGEND_PX, image.shape[1], 3), 20, np.uint8)
    left = 12
    for which, colour in _REASON_COLOURS.items():
        canvas[reason == which] = colour
        text = which.name.lower()
        cv2.putText(legend, text, (left, 26), _FONT, 0.6, colour, 1, cv2.LINE_AA)
        left += 20 + cv2.getTextSize(text, _FONT, 0.6, 1)[0][0]
    return np.concatenate([canvas, legend])


def _overlay(image: Picture, depth_m: Float32) -> Picture:
    gray = _BRIGHTNESS * (image @ np.array([0.299, 0.587, 0.114]))
    canvas = np.repeat(np.rint(gray).astype(np.uint8)[:, :, None], 3, axis=2)
    empty = np.float32(np.finfo(np.float32).max)
    nearest = cv2.erode(
        np.where(depth_m > 0, depth_m, empty).astype(np.float32),
        np.ones((_POINT_SIZE_PX, _POINT_SIZE_PX), np.uint8),
    )
    drawn = nearest < empty
    canvas[drawn] = _colours(nearest[drawn])
    return canvas


def _colours(depth_m: Float32) -> Picture:
    """(N,) metres -> (N,3) RGB."""
    near, far = np.log(_NEAR_M), np.log(_FAR_M)
    nearness = (far - np.log(depth_m.astype(np.float64))) / (far - near)
    dark, bright = _TURBO_LEVELS
    levels = np.rint(dark + (bright - dark) * np.clip(nearness, 0, 1)).astype(np.uint8)
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_TURBO)
    turbo: Picture = bgr.reshape(256, 3)[:, ::-1].astype(np.uint8)
    return turbo[levels]


def _title(text: str, width: int) -> Picture:
    size = max(width / _REFERENCE_WIDTH_PX, 0.5)
    bar = np.full((round(38 * size), width, 3), 20, np.uint8)
    scale = 0.85 * size
    room = width - round(24 * size)
    wide = cv2.getTextSize(text, _FONT, scale, _thickness(scale))[0][0]
    _write(bar, text, round(12 * size), round(27 * size), scale * min(1, room / wide))
    return bar


def _colour_scale(width: int) -> Picture:
    size = max(width / _REFERENCE_WIDTH_PX, 0.5)
    margin, top, bottom = round(60 * size), round(14 * size), round(34 * size)
    bar = np.full((round(68 * size), width, 3), 20, np.uint8)
    columns = np.arange(margin, width - margin)
    span = columns[-1] - columns[0]
    depth_m = _NEAR_M * (_FAR_M / _NEAR_M) ** ((columns - columns[0]) / span)
    bar[top:bottom, columns] = _colours(depth_m.astype(np.float32))
    for tick_m in _TICKS_M:
        fraction = np.log(tick_m / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
        column = columns[0] + round(float(fraction * span))
        bar[bottom : bottom + round(6 * size), column - 1 : column + 1] = 255
        text = f"{tick_m} m"
        text_width = cv2.getTextSize(text, _FONT, 0.65 * size, _thickness(size))[0][0]
        _write(bar, text, column - text_width // 2, round(60 * size), 0.65 * size)
    return bar


def _write(canvas: Picture, text: str, left: int, baseline: int, font_scale: float) -> None:
    white, thickness = (255, 255, 255), _thickness(font_scale)
    cv2.putText(canvas, text, (left, baseline), _FONT, font_scale, white, thickness, cv2.LINE_AA)


def _thickness(font_scale: float) -> int:
    return 2 if font_scale > 0.8 else 1
