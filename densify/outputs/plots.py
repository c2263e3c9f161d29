# SPDX-License-Identifier: MIT
"""Draw pictures with matplotlib: figure.png, compare.png, curve.png, and the loss of a training.

figure.png and compare.png show depth over the camera's image. curve.png shows outliers over
density.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from densify.geometry.types import METHOD_NAMES, Float32, Result
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import Picture
from densify.outputs.key_outputs import Context

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curve = Sequence[Mapping[str, Any]]
"""Points of outliers over density, see `densify.scores.depth_metrics.precision_density`."""

_DPI = 100
# The colour scale is fixed, so that pictures of different key sweeps can be compared.
_NEAR_M, _FAR_M = 3.0, 80.0
_TICKS_M = (3, 5, 10, 20, 40, 80)
_NO_DEPTH_M = np.float32(1e6)
_BRIGHTNESS = 0.45
_MIN_WIDTH_PX = 480
_POINT_SIZE_PX = 3
_TITLE_PX, _SCALE_PX = 36, 60
_FONT_PT, _LETTER_PX = 13.0, 0.85  # width of a letter, per point of the font
_FEWEST_OUTLIERS = 1e-4  # the axis is linear below this share and logarithmic above


def write_plot(path: Path, figure: Figure) -> None:
    """Write a matplotlib figure as PNG. Equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_file(path, buffer.getvalue())


def write_key_figure(result: Result, context: Context, folder: Path) -> None:
    """Write ``figure.png``: the maps of the baselines from top to bottom, then the result's."""
    write_figure(folder / "figure.png", {**result.baselines, result.method: result})


def write_figure(path: Path, results: Mapping[str, Result]) -> None:
    """Write a figure with the measured depth of each method in the first camera.

    With a prior, the figure also shows the completed depth of the last method. Without a camera no
    file is written.

    Args:
        results: Method -> result for the same key sweep.
    """
    method, last = list(results.items())[-1]
    if not last.depth:
        return
    camera = next(iter(last.depth))
    panels = [(METHOD_NAMES.get(m, m), r, "measured") for m, r in results.items()]
    if camera in last.full:
        panels.append((f"{METHOD_NAMES.get(method, method)} and prior", last, "full"))
    drawn = {}
    for title, result, product in panels:
        depth_m = (result.full if product == "full" else result.depth)[camera].depth_m
        text = f"{title}: {np.count_nonzero(depth_m) / depth_m.size:.1%} of pixels"
        drawn[text + _error(result, camera, product)] = depth_m
    write_plot(path, draw_figure(_image(last, camera), drawn))


def _image(result: Result, camera: str) -> Picture:
    """Return the (H,W,3) RGB image of a camera, black if the recording has no image."""
    shape = (*result.depth[camera].depth_m.shape, 3)
    return result.images.get(camera, np.zeros(shape, np.uint8))


def _error(result: Result, camera: str, product: str) -> str:
    """Return text with the share of outliers against ground truth, else the held-out key sweep."""
    for source, against in (("depth", "truth"), ("held_out", "key held out")):
        scores = (result.metrics.get(source) or {}).get(camera, {}).get(product)
        if scores and scores["all"]["outliers"] is not None:
            return f", {scores['all']['outliers']:.2%} outliers ({against})"
    return ""


def draw_figure(image: Picture, panels: Mapping[str, Float32]) -> Figure:
    """Draw depth maps over an image, from top to bottom in the order of the mapping.

    Each depth covers 3 x 3 pixels. Where they overlap, the nearest depth is drawn. Colours run from
    red at 3 m to blue at 80 m on a logarithmic scale.

    Args:
        image: (H,W,3) uint8 RGB image, drawn in gray.
        panels: Title -> (H,W) depth in metres, 0 for no depth.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    scale = ScalarMappable(LogNorm(_NEAR_M, _FAR_M, clip=True), "turbo_r")
    kernel = np.ones((_POINT_SIZE_PX, _POINT_SIZE_PX), np.uint8)
    enlarge = max(1.0, _MIN_WIDTH_PX / image.shape[1])
    panel, width = (enlarge * size_px for size_px in image.shape[:2])
    height = len(panels) * (panel + _TITLE_PX) + _SCALE_PX
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    gray = _BRIGHTNESS * (image @ np.array([0.299, 0.587, 0.114]))
    for number, (title, depth_m) in enumerate(panels.items(), 1):
        bottom = height - number * (panel + _TITLE_PX)
        axes = figure.add_axes((0, bottom / height, 1, panel / height))
        axes.set_axis_off()
        size = min(_FONT_PT, width / (_LETTER_PX * len(title)))
        axes.set_title(title, loc="left", x=0.01, fontsize=size)
        axes.imshow(gray, "gray", vmin=0, vmax=255, interpolation="nearest", aspect="auto")
        nearest = cv2.erode(np.where(depth_m > 0, depth_m, _NO_DEPTH_M), kernel)
        colours = scale.to_rgba(nearest, bytes=True)
        colours[nearest >= _NO_DEPTH_M] = 0
        axes.imshow(colours, interpolation="nearest", aspect="auto")
    bar = figure.add_axes((0.05, 0.6 * _SCALE_PX / height, 0.9, 0.25 * _SCALE_PX / height))
    shown = figure.colorbar(scale, bar, orientation="horizontal", ticks=_TICKS_M, format="%d m")
    shown.minorticks_off()
    return figure


def write_curve(result: Result, context: Context, folder: Path) -> None:
    """Write ``curve.png`` of all cameras, if a method has scores with the key sweep held out."""
    curves: dict[str, dict[str, Curve]] = {}
    for method, of_method in {**result.baselines, result.method: result}.items():
        for camera, scores in (of_method.metrics.get("held_out") or {}).items():
            curves.setdefault(camera, {})[method] = scores["curve"]
    if curves:
        write_plot(folder / "curve.png", draw_curves(curves))


def draw_curves(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Draw the share of outliers over the density, one point for each confidence threshold.

    Each camera has its own axes, two in a row. Thin lines show measured pixels, thick lines the
    filled map.

    Args:
        curves: Camera -> method -> points of `densify.scores.depth_metrics.precision_density`.
    """
    from matplotlib.figure import Figure

    columns, rows = min(2, len(curves)), -(-len(curves) // 2)
    figure = Figure(figsize=(8.6 * columns, 4.8 * rows), dpi=_DPI, layout="constrained")
    for place, (camera, methods) in enumerate(curves.items(), 1):
        axes = figure.add_subplot(rows, columns, place)
        for number, (method, curve) in enumerate(methods.items()):
            for kind, width in (("measured", 1.0), ("filled", 2.5)):
                known = [p for p in curve if p[f"outliers_{kind}"] is not None]
                density = [100 * p[f"density_{kind}"] for p in known]
                outliers = [100 * p[f"outliers_{kind}"] for p in known]
                label = f"{METHOD_NAMES.get(method, method)}, {kind}"
                if known:
                    label += f": {density[0]:.1f} % of pixels, {outliers[0]:.2f} % outliers"
                line = axes.plot(density, outliers, "o-", color=f"C{number}", label=label)[0]
                line.set(linewidth=width, markersize=1 + 2 * width)
        axes.set(title=f"{camera}, key held out", xlabel="pixels with a depth, %")
        axes.set_ylabel("outliers, %")
        axes.set_yscale("symlog", linthresh=100 * _FEWEST_OUTLIERS)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure
