# SPDX-License-Identifier: MIT
"""Draw figure.png and compare.png (depth over the image), and curve.png (outliers over density)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from densify.geometry.types import METHOD_NAMES, Float32, Result
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import Picture, encode_png
from densify.outputs.front_view import front_first
from densify.outputs.key_outputs import Context
from densify.scores.depth_metrics import precision_density

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curve = Sequence[Mapping[str, Any]]
"""Points of outliers over density, see `densify.scores.depth_metrics.precision_density`."""

_DPI = 100
# Figures over images are drawn with OpenCV: a run should not wait for matplotlib.
# The colour scale is fixed, so that pictures of different key sweeps can be compared.
_NEAR_M, _FAR_M = 3.0, 80.0
_TICKS_M = (3, 5, 10, 20, 40, 80)
_NO_DEPTH_M = np.float32(1e6)
_BRIGHTNESS = 0.45
_MIN_WIDTH_PX = 480
_POINT_SIZE_PX = 3
_TITLE_PX, _SCALE_PX, _BAR_PX, _MARGIN_PX = 36, 60, 15, 12
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.6
_FEWEST_OUTLIERS = 1e-4  # the axis is linear below this share and logarithmic above


def write_key_figure(result: Result, context: Context, folder: Path) -> None:
    """Write ``figure.png``: the maps of the baselines from top to bottom, then the result's."""
    write_figure(folder / "figure.png", {**result.baselines, result.method: result})


def write_figure(path: Path, results: Mapping[str, Result]) -> None:
    """Write each method's measured depth, and completed depth, in the camera that looks ahead."""
    method, last = list(results.items())[-1]
    if not last.depth:
        return
    camera = front_first([*last.depth], last.views, last.T_key_lidar)[0]
    panels = [(METHOD_NAMES.get(m, m), r, "measured") for m, r in results.items()]
    if camera in last.full:
        panels.append((f"{METHOD_NAMES.get(method, method)} and prior", last, "full"))
    drawn = {}
    for title, result, product in panels:
        depth_m = (result.full if product == "full" else result.depth)[camera].depth_m
        named = f", {camera}" * (len(last.depth) > 1)
        text = f"{title}{named}: {np.count_nonzero(depth_m) / depth_m.size:.1%} of pixels"
        drawn[text + _error(result, camera, product)] = depth_m
    write_file(path, encode_png(draw_figure(_image(last, camera), drawn)))


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


def draw_figure(image: Picture, panels: Mapping[str, Float32]) -> Picture:
    """Return a BGR picture (h,w,3) of panels with depth over a camera's image in gray.

    ``panels`` has title -> (H,W) metres, 0 for no depth. Each depth covers 3 x 3 pixels, nearest on
    top, from red at 3 m to blue at 80 m on a logarithmic scale. ``image`` is (H,W,3) RGB.
    """
    kernel = np.ones((_POINT_SIZE_PX, _POINT_SIZE_PX), np.uint8)
    gray = (_BRIGHTNESS * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.uint8)
    enlarge, parts = max(1.0, _MIN_WIDTH_PX / image.shape[1]), []
    for title, depth_m in panels.items():
        nearest_m = np.where(depth_m > 0, depth_m, _NO_DEPTH_M)
        nearest_m = cv2.erode(nearest_m, kernel).astype(np.float32, copy=False)
        picture = cv2.merge([gray, gray, gray])
        picture[nearest_m < _NO_DEPTH_M] = _colours(nearest_m)[nearest_m < _NO_DEPTH_M]
        picture = cv2.resize(picture, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_NEAREST)
        strip = np.full((_TITLE_PX, picture.shape[1], 3), 255, np.uint8)
        _write(strip, title, _MARGIN_PX, picture.shape[1] - _MARGIN_PX)
        parts += [strip, picture]
    return np.concatenate([*parts, _scale(parts[0].shape[1])])


def _colours(depth_m: Float32) -> Picture:
    """Return the (h,w,3) colours, as blue, green, red, of depths (h,w) in metres."""
    far = np.log(depth_m / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
    levels = np.rint(255 * (1 - np.clip(far, 0, 1))).astype(np.uint8)
    return cv2.applyColorMap(levels, cv2.COLORMAP_TURBO).astype(np.uint8, copy=False)


def _scale(width_px: int) -> Picture:
    """Return the (h,w,3) colour scale with its ticks."""
    scale = np.full((_SCALE_PX, width_px, 3), 255, np.uint8)
    left, long_px = width_px // 20, width_px - 2 * (width_px // 20)
    log = np.linspace(np.log(_NEAR_M), np.log(_FAR_M), long_px)
    bar = scale[_MARGIN_PX : _MARGIN_PX + _BAR_PX, left : left + long_px]
    bar[:] = _colours(np.exp(log).astype(np.float32)[None])
    for tick_m in _TICKS_M:
        at = left + int(np.searchsorted(log, np.log(tick_m) - 1e-9))
        scale[_MARGIN_PX + _BAR_PX : _MARGIN_PX + _BAR_PX + 4, at - 1 : at + 1] = 0
        _write(scale[_MARGIN_PX + _BAR_PX :], f"{tick_m} m", at - left, at + left, centred=True)
    return scale


def _write(strip: Picture, text: str, left_px: int, right_px: int, centred: bool = False) -> None:
    """Write a line of text into the middle of a strip (h,w,3), smaller if it is too long."""
    (width_px, height_px), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    shrink = min(1.0, (right_px - left_px) / width_px)
    if centred:
        left_px = (left_px + right_px - round(shrink * width_px)) // 2
    at = left_px, (strip.shape[0] + height_px) // 2
    cv2.putText(strip, text, at, _FONT, shrink * _FONT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)


def write_plot(path: Path, figure: Figure) -> None:
    """Write a matplotlib figure as PNG. Equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_file(path, buffer.getvalue())


def write_curve(result: Result, context: Context, folder: Path) -> None:
    """Write ``curve.png`` of all cameras, if a method has scores with the key sweep held out.

    If there is ground truth, the result is drawn against it too.
    """
    curves: dict[str, dict[str, Curve]] = {}
    for method, of_method in {**result.baselines, result.method: result}.items():
        for camera, scores in (of_method.metrics.get("held_out") or {}).items():
            curves.setdefault(f"{camera}, key held out", {})[method] = scores["curve"]
    for name, truth_m in result.truth_m.items() if curves else ():
        camera = result.views[name].camera
        of_name: dict[str, Curve] = {
            result.method: precision_density(result.depth[name], truth_m, camera)
        }
        curves[f"{name}, ground truth"] = of_name
    if curves:
        write_plot(folder / "curve.png", draw_curves(curves))


def draw_curves(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Draw the share of outliers over the density, and what the confidence expects of the last.

    ``curves`` is title -> method -> `precision_density`.
    """
    from matplotlib.figure import Figure

    columns, rows = min(2, len(curves)), -(-len(curves) // 2)
    figure = Figure(figsize=(8.6 * columns, 4.8 * rows), dpi=_DPI, layout="constrained")
    for place, (camera, methods) in enumerate(curves.items(), 1):
        axes = figure.add_subplot(rows, columns, place)
        last = [*methods][-1]
        for number, (method, curve) in enumerate(methods.items()):
            for kind, width in (("measured", 1.0), ("filled", 2.5)):  # thin and thick lines
                known = [p for p in curve if p[f"outliers_{kind}"] is not None]
                density = [100 * p[f"density_{kind}"] for p in known]
                outliers = [100 * p[f"outliers_{kind}"] for p in known]
                label = f"{METHOD_NAMES.get(method, method)}, {kind}"
                if known:
                    label += f": {density[0]:.1f} % of pixels, {outliers[0]:.2f} % outliers"
                line = axes.plot(density, outliers, "o-", color=f"C{number}", label=label)[0]
                line.set(linewidth=width, markersize=1 + 2 * width)
                if kind == "filled" and known and method == last:
                    expected = [100 * p[f"expected_{kind}"] for p in known]
                    axes.plot(density, expected, "k--", label="expected by confidence")
        axes.set(title=camera, xlabel="pixels with a depth, %")
        axes.set_ylabel("outliers, %")
        axes.set_yscale("symlog", linthresh=100 * _FEWEST_OUTLIERS)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure
