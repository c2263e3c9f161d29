# SPDX-License-Identifier: MIT
"""Draw depth over the image (figure.png, compare.png) and outliers over density (curve.png)."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from densify.geometry.types import METHOD_NAMES, CameraView, Float, Float32, Result
from densify.outputs.depth_png import Picture, encode_png
from densify.outputs.folders import write_file
from densify.scores.metrics import precision_density

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curve = Sequence[Mapping[str, Any]]
"""Points of outliers over density, see `densify.scores.metrics.precision_density`."""

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
_AXES_INCH = (8.6, 4.8)
# An SVG of a score: a histogram at the left, dots at the right, frame numbers below.
_PLOT_PX, _PLOT_TOP_PX, _PLOT_BASE_PX = (400, 160), 26, 138
_LABELS_PX, _HISTOGRAM_PX, _GAP_PX = 40, 60, 6
_FEWEST_IN_HISTOGRAM, _NUM_BINS, _LEAST_LABEL_PX = 20, 20, 70
_AXIS_ENDS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # times a power of ten
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
        axes = (views[name].T_cam_key[2, :3] if name in views else None for name in names)
        ahead = [-np.inf if axis is None else float(axis @ travel_m) for axis in axes]
    else:
        # "front" counts more than a word such as "left" in the same name.
        ahead = [float("front" in name.lower()) - 0.5 * bool(_SIDE.search(name)) for name in names]
    first = int(np.argmax(ahead)) if len(names) else 0
    return [*names[first : first + 1], *names[:first], *names[first + 1 :]]


def write_figure(path: Path, results: Mapping[str, Result]) -> None:
    """Write a figure of each method's and the prior's depth ahead, or nothing without maps."""
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
    enlarge = max(1.0, _MIN_WIDTH_PX / image.shape[1])
    rows = []
    for title, depth_m in panels.items():
        nearest_m = np.where(depth_m > 0, depth_m, _NO_DEPTH_M)
        nearest_m = cv2.erode(nearest_m, kernel).astype(np.float32, copy=False)
        drawn = depth_over_image(image, np.where(nearest_m < _NO_DEPTH_M, nearest_m, 0))
        picture = cv2.resize(drawn, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_NEAREST)
        strip = np.full((_TITLE_PX, picture.shape[1], 3), 255, np.uint8)
        _write(strip, title, _MARGIN_PX, picture.shape[1] - _MARGIN_PX)
        rows += [strip, picture]
    return np.concatenate([*rows, _scale(rows[0].shape[1])])


def depth_over_image(image: Picture, depth_m: Float32) -> Picture:
    """Return the picture (H,W,3), as blue, green, red, of depth over a dark gray image.

    ``image`` (H,W,3) is RGB. ``depth_m`` (H,W) is in metres, coloured by `colour_depth`, 0 for
    none.
    """
    gray = (_BRIGHTNESS * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.uint8)
    picture = cv2.merge([gray, gray, gray]).astype(np.uint8, copy=False)
    picture[depth_m > 0] = colour_depth(depth_m)[depth_m > 0]
    return picture


def colour_depth(depth_m: Float32) -> Picture:
    """Return the colours (h,w,3), as blue, green, red, of depths (h,w) in metres, black for 0."""
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


class Dot(NamedTuple):
    """A key in the plot of a score."""

    recording: str
    frame: int
    value: float
    is_kept: bool  # False draws a hollow dot
    target: str  # identifier of the element of the page that the dot leads to


def score_plot(title: str, unit: str, dots: Sequence[Dot], usual: Sequence[float] = ()) -> str:
    """Return SVG with a score over the frame numbers of each recording, from 20 keys a histogram.

    Args:
        title: Name of the score.
        unit: Unit of its values.
        dots: The keys, ordered by recording and frame.
        usual: Lowest and highest usual value, drawn as a band; empty for none.
    """
    largest = max((dot.value for dot in dots), default=0.0) or 1.0
    power = 10.0 ** np.floor(np.log10(largest))
    end = next(power * factor for factor in _AXIS_ENDS if power * factor >= 0.999 * largest)
    scale_px = (_PLOT_BASE_PX - _PLOT_TOP_PX) / end  # per unit of the score
    (width_px, height_px), left_px = _PLOT_PX, _LABELS_PX
    parts = [f'<text x="{left_px}" y="14" class="title">{html.escape(title)}, {unit}</text>']
    if usual:
        top, bottom = (_PLOT_BASE_PX - min(value, end) * scale_px for value in reversed(usual))
        parts.append(
            f'<rect x="{left_px}" y="{top:.1f}" width="{width_px - left_px}" '
            f'height="{bottom - top:.1f}" class="usual"><title>usual on KITTI</title></rect>'
        )
    for tick in (0.0, end / 2, end):
        y = _PLOT_BASE_PX - tick * scale_px
        parts.append(f'<path d="M{left_px} {y:.1f}H{width_px}"/>')
        parts.append(f'<text x="{left_px - 4}" y="{y + 4:.1f}" class="end">{tick:g}</text>')
    if len(dots) >= _FEWEST_IN_HISTOGRAM:
        counts = np.histogram([dot.value for dot in dots], _NUM_BINS, (0, end))[0]
        bar_px = (_PLOT_BASE_PX - _PLOT_TOP_PX) / _NUM_BINS
        parts += [
            f'<rect x="{left_px}" y="{_PLOT_BASE_PX - (row + 1) * bar_px:.1f}" height="'
            f'{bar_px - 1:.1f}" width="{_HISTOGRAM_PX * num / counts.max():.1f}"/>'
            for row, num in enumerate(counts)
        ]
        left_px += _HISTOGRAM_PX
    parts += _draw_dots(dots, left_px + _GAP_PX, unit, scale_px)
    label = html.escape(f"{title} of each key over its frame number")
    size = f"0 0 {width_px} {height_px}"
    return f'<svg viewBox="{size}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _draw_dots(dots: Sequence[Dot], left_px: float, unit: str, scale_px: float) -> list[str]:
    """Return the dots of all recordings side by side, with the first and last frame of each."""
    groups = [list(group) for _, group in groupby(dots, key=lambda dot: dot.recording)]
    spans = [max(1, group[-1].frame - group[0].frame) for group in groups]
    room_px = _PLOT_PX[0] - left_px - _GAP_PX * (2 * len(groups) - 1)
    frame_px = max(room_px, 1) / max(sum(spans), 1)
    parts = []
    for group, span in zip(groups, spans, strict=True):
        first, last = group[0].frame, group[-1].frame
        for dot in group:
            x, y = left_px + (dot.frame - first) * frame_px, _PLOT_BASE_PX - dot.value * scale_px
            hollow = "" if dot.is_kept else ' class="hollow"'
            text = html.escape(f"{dot.recording}, key {dot.frame}: {dot.value:.3g} {unit}")
            parts.append(
                f'<a href="#{html.escape(dot.target)}"><circle cx="{x:.1f}" cy="{y:.1f}" r="3"'
                f"{hollow}><title>{text}</title></circle></a>"
            )
        end_px = left_px + span * frame_px
        if span * frame_px >= _LEAST_LABEL_PX:
            parts.append(f'<text x="{left_px:.1f}" y="154">frame {first}</text>')
            parts.append(f'<text x="{end_px:.1f}" y="154" class="end">{last}</text>')
        left_px = end_px + 2 * _GAP_PX
    return parts


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
            for product, width in (("measured", 1.0), ("filled", 2.5)):
                points = _percentages(curve, product, "outliers")
                label = f"{METHOD_NAMES.get(method, method)}, {product}"
                if points:
                    density, outliers = points[0]
                    label += f": {density:.1f} % of pixels, {outliers:.2f} % outliers"
                style = dict[str, Any](color=f"C{color}", linewidth=width, markersize=1 + 2 * width)
                axes.plot(*np.reshape(points, (-1, 2)).T, "o-", label=label, **style)
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


def _percentages(curve: Curve, product: str, score: str) -> list[tuple[float, float]]:
    """Return (density, score) in percent of the points of a curve whose outliers are known."""
    known = [point for point in curve if point[f"outliers_{product}"] is not None]
    return [(100 * p[f"density_{product}"], 100 * p[f"{score}_{product}"]) for p in known]
