# SPDX-License-Identifier: MIT
"""Pictures of depth maps over the camera's image: figure.png, compare.png and rejected/."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float32, Reason, Result
from densify.outputs.context import Context
from densify.outputs.map_outputs import map_path
from densify.outputs.plots import DPI, write_plot
from densify.outputs.png import Picture

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

# Fixed, so that the pictures of different keys compare.
_NEAR_M, _FAR_M = 3.0, 80.0
_TICKS_M = (3, 5, 10, 20, 40, 80)
_BRIGHTNESS = 0.45
_MIN_WIDTH_PX = 480
_POINT_SIZE_PX = 3
_TITLE_PX, _SCALE_PX = 36, 60
_FONT_PT, _LETTER_PX = 13.0, 0.85  # width of a letter, per point of the font
_TITLES = {"none": "sparse"}
_REASON_COLOURS = {
    Reason.VETOED: (255, 70, 70),
    Reason.HIDDEN: (80, 140, 255),
    Reason.UNSUPPORTED: (255, 210, 60),
    Reason.EDGE: (90, 230, 120),
    Reason.GLASS: (235, 120, 255),
}


def write_key_figure(result: Result, context: Context, folder: Path) -> None:
    """Write ``figure.png``: the baselines from top to bottom, then the result."""
    methods = {**result.baselines, result.method: result}
    write_figure(folder / "figure.png", methods, context)


def write_figure(path: Path, results: Mapping[str, Result], context: Context) -> None:
    """Write the measured depth of each method in the first camera, and the last method's depth
    completed with a prior, if there is one. Without a camera nothing is written."""
    depth = next(iter(results.values())).depth
    if not depth:
        return
    camera = next(iter(depth))
    image = context.image(camera, depth[camera].depth_m.shape)
    panels = {_TITLES.get(m, m): r.depth[camera].depth_m for m, r in results.items()}
    notes = {_TITLES.get(m, m): _error(r, camera, "measured") for m, r in results.items()}
    method, result = list(results.items())[-1]
    if camera in result.full:
        title = f"{method} and prior"
        panels[title], notes[title] = result.full[camera].depth_m, _error(result, camera, "full")
    write_plot(path, draw_figure(image, panels, notes))


def _error(result: Result, camera: str, product: str) -> str:
    """Return the fraction of outliers, against the truth if there is one, else the held-out key."""
    for source, against in (("depth", "truth"), ("held_out", "key held out")):
        scores = (result.metrics.get(source) or {}).get(camera, {}).get(product)
        if scores and scores["all"]["outliers"] is not None:
            return f", {scores['all']['outliers']:.2%} outliers ({against})"
    return ""


def draw_figure(
    image: Picture, panels: Mapping[str, Float32], notes: Mapping[str, str] | None = None
) -> Figure:
    """Draw depth maps over an image, from top to bottom in the mapping's order.

    image: (H,W,3) uint8 RGB, drawn in gray.
    panels: title -> (H,W) depth in metres, 0 none. A depth covers 3 x 3 pixels, and the nearest
        wins. Near is red, far is blue, logarithmic from 3 to 80 m.
    notes: title -> what stands behind the title and the fraction of pixels with a depth.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    scale = ScalarMappable(LogNorm(_NEAR_M, _FAR_M, clip=True), "turbo_r")
    figure = _panels(image, len(panels))
    for axes, (title, depth_m) in zip(figure.axes, panels.items(), strict=True):
        density = np.count_nonzero(depth_m) / depth_m.size
        text = f"{title}: {density:.1%} of pixels{(notes or {}).get(title, '')}"
        size = min(_FONT_PT, figure.bbox.width / (_LETTER_PX * len(text)))
        axes.set_title(text, loc="left", x=0.01, fontsize=size)
        axes.imshow(_overlay(image, depth_m, scale), interpolation="nearest", aspect="auto")
    height = figure.bbox.height
    bar = figure.add_axes((0.05, 0.6 * _SCALE_PX / height, 0.9, 0.25 * _SCALE_PX / height))
    colours = figure.colorbar(scale, bar, orientation="horizontal", ticks=_TICKS_M, format="%d m")
    colours.minorticks_off()
    return figure


def write_rejected(result: Result, context: Context, folder: Path) -> None:
    """Write ``rejected/CAMERA.png``, if it was asked for."""
    for camera, reason in result.rejected.items():
        figure = draw_rejected(context.image(camera, reason.shape), reason)
        write_plot(map_path(folder, "rejected", camera), figure)


def draw_rejected(image: Picture, reason: NDArray[np.uint8]) -> Figure:
    """Draw over an image in gray what was rejected, in a colour for each `Reason`.

    image: (H,W,3) uint8 RGB. reason: (H,W), 0 none.
    """
    from matplotlib.patches import Patch

    figure, canvas = _panels(image, 1), _darkened(image)
    for which, colour in _REASON_COLOURS.items():
        canvas[reason == which] = colour
    figure.axes[0].imshow(canvas, interpolation="nearest", aspect="auto")
    handles = [
        Patch(color="#{:02x}{:02x}{:02x}".format(*colour), label=which.name.lower())
        for which, colour in _REASON_COLOURS.items()
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False)
    return figure


def _panels(image: Picture, number: int) -> Figure:
    """Return a figure with axes of the image's size, a title's room above each."""
    from matplotlib.figure import Figure

    height_px, width_px = image.shape[:2]
    enlarge = max(1.0, _MIN_WIDTH_PX / width_px)
    width, panel = enlarge * width_px, enlarge * height_px
    height = number * (panel + _TITLE_PX) + _SCALE_PX
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    for i in range(number):
        bottom = height - (i + 1) * (panel + _TITLE_PX)
        figure.add_axes((0, bottom / height, 1, panel / height)).set_axis_off()
    return figure


def _overlay(image: Picture, depth_m: Float32, scale: ScalarMappable) -> Picture:
    empty = np.float32(np.finfo(np.float32).max)
    kernel = np.ones((_POINT_SIZE_PX, _POINT_SIZE_PX), np.uint8)
    nearest = cv2.erode(np.where(depth_m > 0, depth_m, empty).astype(np.float32), kernel)
    drawn = nearest < empty
    canvas = _darkened(image)
    canvas[drawn] = scale.to_rgba(nearest[drawn], bytes=True)[:, :3]
    return canvas


def _darkened(image: Picture) -> Picture:
    gray = _BRIGHTNESS * (image @ np.array([0.299, 0.587, 0.114]))
    return np.repeat(np.rint(gray).astype(np.uint8)[:, :, None], 3, axis=2)
