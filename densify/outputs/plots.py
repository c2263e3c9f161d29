# SPDX-License-Identifier: MIT
"""Draw depth over the image (figure.png, compare.png) and outliers over density (curve.png)."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from densify.geometry.types import METHOD_NAMES, CameraView, Float, Float32, Result
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import Picture, encode_png
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
_AXES_INCH, _SCORE_INCH = (8.6, 4.8), (5.2, 2.2)
_BLUE = "#4662d7"
_FEWEST_OUTLIERS = 1e-4  # the axis is linear below this share and logarithmic above
_MIN_TRAVEL_M = 1.0
"""A shorter way may be noise of the registration, of a vehicle at rest."""
_SIDE = re.compile(r"left|right|side|rear|back", re.IGNORECASE)


def order_front_first(
    names: Sequence[str], views: Mapping[str, CameraView], T_key_lidar: Mapping[int, Float]
) -> list[str]:
    """Return the names of maps: first that of the camera that looks ahead, the others in order.

    Ahead is the direction of motion in ``T_key_lidar``, (4,4) by frame number. Without motion, a
    camera whose name holds "front" is taken.
    """
    frames = sorted(T_key_lidar)
    travel_m = np.zeros(3)
    if frames:
        travel_m = T_key_lidar[frames[-1]][:3, 3] - T_key_lidar[frames[0]][:3, 3]
    if np.linalg.norm(travel_m) >= _MIN_TRAVEL_M:
        # Row z of a camera's rotation is its optical axis in the key frame.
        ahead = [
            float(views[name].T_cam_key[2, :3] @ travel_m) if name in views else -np.inf
            for name in names
        ]
    else:
        # "front" counts more than a word such as "left" in the same name.
        ahead = [float("front" in name.lower()) - 0.5 * bool(_SIDE.search(name)) for name in names]
    first = int(np.argmax(ahead)) if len(names) else 0
    return [*names[first : first + 1], *names[:first], *names[first + 1 :]]


def write_key_figure(result: Result, folder: Path) -> None:
    """Write ``figure.png``: the maps of the baselines from top to bottom, then the result's."""
    write_figure(folder / "figure.png", {**result.baselines, result.method: result})


def write_figure(path: Path, results: Mapping[str, Result]) -> None:
    """Write a figure of each method's depth, and the prior's, ahead; nothing without maps."""
    method, last = list(results.items())[-1]
    if not last.depth:
        return
    camera = order_front_first([*last.depth], last.views, last.T_key_lidar)[0]
    panels = [(METHOD_NAMES.get(m, m), r, "measured") for m, r in results.items()]
    if camera in last.full:
        panels.append((f"{METHOD_NAMES.get(method, method)} and prior", last, "full"))
    maps_m = {}
    camera_name = f", {camera}" if len(last.depth) > 1 else ""
    for title, result, product in panels:
        depth_m = (result.full if product == "full" else result.depth)[camera].depth_m
        text = f"{title}{camera_name}: {np.count_nonzero(depth_m) / depth_m.size:.1%} of pixels"
        maps_m[text + _error(result, camera, product)] = depth_m
    black = np.zeros((*last.depth[camera].depth_m.shape, 3), np.uint8)
    write_file(path, encode_png(draw_figure(last.images.get(camera, black), maps_m)))


def _error(result: Result, camera: str, product: str) -> str:
    """Return text with the share of outliers against ground truth, else the held-out key sweep."""
    for source, against in (("depth", "truth"), ("held_out", "key held out")):
        scores = (result.metrics.get(source) or {}).get(camera, {}).get(product)
        if scores and scores["all"]["outliers"] is not None:
            return f", {scores['all']['outliers']:.2%} outliers ({against})"
    return ""


def draw_figure(image: Picture, panels: Mapping[str, Float32]) -> Picture:
    """Return a BGR picture (h,w,3) of panels with depth over a camera's RGB image in gray.

    ``panels`` has title -> (H,W) metres, 0 for no depth, drawn in 3 x 3 pixels, nearest on top,
    from red at 3 m to blue at 80 m on a logarithmic scale.
    """
    kernel = np.ones((_POINT_SIZE_PX, _POINT_SIZE_PX), np.uint8)
    gray = (_BRIGHTNESS * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.uint8)
    enlarge = max(1.0, _MIN_WIDTH_PX / image.shape[1])
    rows = []
    for title, depth_m in panels.items():
        nearest_m = np.where(depth_m > 0, depth_m, _NO_DEPTH_M)
        nearest_m = cv2.erode(nearest_m, kernel).astype(np.float32, copy=False)
        picture = cv2.merge([gray, gray, gray])
        picture[nearest_m < _NO_DEPTH_M] = colour_depth(nearest_m)[nearest_m < _NO_DEPTH_M]
        picture = cv2.resize(picture, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_NEAREST)
        strip = np.full((_TITLE_PX, picture.shape[1], 3), 255, np.uint8)
        _write(strip, title, _MARGIN_PX, picture.shape[1] - _MARGIN_PX)
        rows += [strip, picture]
    return np.concatenate([*rows, _scale(rows[0].shape[1])])


def colour_depth(depth_m: Float32) -> Picture:
    """Return the (h,w,3) colours, as blue, green, red, of depths (h,w) in metres; 0 is black."""
    share = np.log(np.maximum(depth_m, _NEAR_M) / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
    levels = np.rint(255 * (1 - np.minimum(share, 1))).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO).astype(np.uint8, copy=False)
    picture[depth_m <= 0] = 0
    return picture


def _scale(width_px: int) -> Picture:
    """Return the (h,w,3) colour scale with its ticks."""
    scale = np.full((_SCALE_PX, width_px, 3), 255, np.uint8)
    left = width_px // 20
    bar_width_px = width_px - 2 * left
    bottom = _MARGIN_PX + _BAR_PX
    log_m = np.linspace(np.log(_NEAR_M), np.log(_FAR_M), bar_width_px)
    bar = scale[_MARGIN_PX:bottom, left : left + bar_width_px]
    bar[:] = colour_depth(np.exp(log_m).astype(np.float32)[None])
    # A tick is 2 px wide and 4 px high, with its label below.
    for tick_m in _TICKS_M:
        column = left + int(np.searchsorted(log_m, np.log(tick_m) - 1e-9))
        scale[bottom : bottom + 4, column - 1 : column + 1] = 0
        _write(scale[bottom:], f"{tick_m} m", column - left, column + left, centred=True)
    return scale


def _write(strip: Picture, text: str, left_px: int, right_px: int, centred: bool = False) -> None:
    """Write a line of text into the middle of a strip (h,w,3), smaller if it is too long."""
    (width_px, height_px), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    shrink = min(1.0, (right_px - left_px) / width_px)
    if centred:
        left_px = (left_px + right_px - round(shrink * width_px)) // 2
    at = left_px, (strip.shape[0] + height_px) // 2
    cv2.putText(strip, text, at, _FONT, shrink * _FONT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)


def score_figure(title: str, unit: str, values: Float) -> str:
    """Return the histogram and the timeline of a score of N keys as SVG; NaN is no value."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SCORE_INCH, layout="constrained")
    histogram, timeline = figure.subplots(1, 2, sharey=True, width_ratios=(1, 3))
    histogram.hist(values[np.isfinite(values)], bins=20, orientation="horizontal", color=_BLUE)
    histogram.set(ylabel=unit, xlabel="keys")
    timeline.plot(values, ".", color=_BLUE, markersize=4)
    timeline.set(title=title, xlabel="keys in order of recording and time")
    for axes in (histogram, timeline):
        axes.xaxis.get_major_locator().set_params(integer=True)
    file = io.StringIO()
    with rc_context({"svg.hashsalt": title}):  # equal figures have equal bytes
        figure.savefig(file, format="svg", metadata={"Date": None})
    svg = file.getvalue()
    return svg[svg.index("<svg") :]


def write_curve(result: Result, folder: Path) -> None:
    """Write ``curve.png`` of all cameras, if a method has scores with the key sweep held out."""
    curves: dict[str, dict[str, Curve]] = {}
    for method, of_method in {**result.baselines, result.method: result}.items():
        for camera, scores in (of_method.metrics.get("held_out") or {}).items():
            curves.setdefault(f"{camera}, key held out", {})[method] = scores["curve"]
    for name, truth_m in result.truth_m.items() if curves else ():
        camera = result.views[name].camera
        curve = precision_density(result.depth[name], truth_m, camera)
        curves[f"{name}, ground truth"] = {result.method: curve}
    if curves:
        buffer = io.BytesIO()
        # Without the name of the program, equal figures give equal bytes.
        draw_curves(curves).savefig(buffer, format="png", metadata={"Software": None})
        write_file(folder / "curve.png", buffer.getvalue())


def draw_curves(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Return a figure of outliers over density: title of the axes -> method -> `Curve`."""
    from matplotlib.figure import Figure

    columns, rows = min(2, len(curves)), -(-len(curves) // 2)
    size_inch = (_AXES_INCH[0] * columns, _AXES_INCH[1] * rows)
    figure = Figure(figsize=size_inch, dpi=_DPI, layout="constrained")
    for number, (title, methods) in enumerate(curves.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        for color, (method, curve) in enumerate(methods.items()):
            _draw_curve(axes, method, curve, f"C{color}")
        last = [*methods.values()][-1]
        if expected := _percentages(last, "filled", "expected"):
            axes.plot(*zip(*expected, strict=True), "k--", label="expected by confidence")
        axes.set(title=title, xlabel="pixels with a depth, %", ylabel="outliers, %")
        axes.set_yscale("symlog", linthresh=100 * _FEWEST_OUTLIERS)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure


def _draw_curve(axes: Any, method: str, curve: Curve, color: str) -> None:
    """Draw a method's outliers over density: a thin line if measured, a thick one if filled."""
    for product, width in (("measured", 1.0), ("filled", 2.5)):
        points = _percentages(curve, product, "outliers")
        label = f"{METHOD_NAMES.get(method, method)}, {product}"
        if points:
            density, outliers = points[0]
            label += f": {density:.1f} % of pixels, {outliers:.2f} % outliers"
        x_y = zip(*points, strict=True) if points else ((), ())
        axes.plot(*x_y, "o-", color=color, label=label, linewidth=width, markersize=1 + 2 * width)


def _percentages(curve: Curve, product: str, score: str) -> list[tuple[float, float]]:
    """Return (density, score) in percent of the points of a curve whose outliers are known."""
    known = [point for point in curve if point[f"outliers_{product}"] is not None]
    return [(100 * p[f"density_{product}"], 100 * p[f"{score}_{product}"]) for p in known]
