# SPDX-License-Identifier: MIT
"""Draw depth over the image (figure.png, compare.png) and outliers over density (curve.png)."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from densify.geometry.types import METHOD_NAMES, CameraView, Float, Float32, Result
from densify.outputs.depth_png import Picture, encode_png
from densify.outputs.folders import write_file
from densify.scores.metrics import LEAST_PIXELS, precision_density, shown_score

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
_TEXT_WIDTH_PX = 1000  # width of a figure from which on its text grows
_POINT_SIZE_PX = 3
_TITLE_PX, _SCALE_PX, _BAR_PX, _MARGIN_PX = 36, 60, 15, 12
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.6
_AXES_INCH = (8.6, 4.8)
# An SVG of a score: a histogram at the left, dots at the right, frame numbers below.
_PLOT_PX, _PLOT_TOP_PX, _PLOT_BASE_PX = (400, 160), 26, 138
_LABELS_PX, _HISTOGRAM_PX, _GAP_PX = 30, 60, 8
_NUM_BINS, _LEAST_LABEL_PX, _NUM_TICKS = 20, 90, 3
_MANY_DOTS = 300  # more of them are small
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
    """Write a figure of each method's and the prior's depth ahead, or nothing without maps.

    Below are the other cameras, smaller, with the last method's depth.
    """
    method, last = list(results.items())[-1]
    if not last.depth:
        return
    camera, *others = order_front_first([*last.depth], last.views, last.T_key_lidar)
    panels = [(METHOD_NAMES.get(m, m), r, "measured") for m, r in results.items()]
    if camera in last.full:
        panels.append((f"{METHOD_NAMES.get(method, method)} and prior", last, "full"))
    maps_m = {}
    camera_name = f", {camera}" if len(last.depth) > 1 else ""
    for title, result, product in panels:
        depth_m = (result.full if product == "full" else result.depth)[camera].depth_m
        text = f"{title}{camera_name}: {_density(depth_m)}"
        maps_m[text + _error(result, camera, product)] = depth_m
    of_others = []
    for name in others:
        depth_m = last.depth[name].depth_m
        text = f"{METHOD_NAMES.get(method, method)}, {name}: {_density(depth_m)}"
        of_others.append((text + _error(last, name, "measured"), _image(last, name), depth_m))
    write_file(path, encode_png(draw_figure(_image(last, camera), maps_m, of_others)))


def _image(result: Result, camera: str) -> Picture:
    """Return the image (H,W,3) of a map, black if there is none."""
    shape = *result.depth[camera].depth_m.shape, 3
    return result.images.get(camera, np.zeros(shape, np.uint8))


def _density(depth_m: Float32) -> str:
    """Return text with the share of pixels that have a depth."""
    return f"{100 * np.count_nonzero(depth_m) / depth_m.size:.1f} % of pixels"


def _error(result: Result, camera: str, product: str) -> str:
    """Return text with the share of outliers against ground truth, else the held-out key sweep."""
    for source, against in (("depth", "truth"), ("held_out", "key held out")):
        scores = (result.metrics.get(source) or {}).get(camera, {}).get(product)
        if scores and scores["all"]["outliers"] is not None:
            outliers = shown_score(scores["all"], "outliers")
            if outliers is None:
                return f", outliers ({against}): fewer than {LEAST_PIXELS} pixels to judge"
            return f", {100 * outliers:.2f} % outliers ({against})"
    return ""


def draw_figure(
    image: Picture,
    panels: Mapping[str, Float32],
    others: Sequence[tuple[str, Picture, Float32]] = (),
) -> Picture:
    """Return a BGR picture (h,w,3) of panels with depth over a camera's RGB image in gray.

    Depth is drawn in 3 x 3 pixels, nearest on top, from red at 3 m to blue at 80 m on a logarithmic
    scale.

    Args:
        image: (H,W,3) image of the first camera.
        panels: Title -> (H,W) metres, 0 for no depth, drawn below each other.
        others: Title, image and metres of other cameras, drawn below, two beside each other.
    """
    width_px = max(image.shape[1], _MIN_WIDTH_PX)
    text_scale = max(1.0, width_px / _TEXT_WIDTH_PX)
    rows = [
        _panel(title, image, depth_m, width_px, text_scale) for title, depth_m in panels.items()
    ]
    columns = min(2, max(1, len(others)))
    cell_px = (width_px - (columns - 1) * _MARGIN_PX) // columns
    cells = [_panel(*other, cell_px, text_scale) for other in others]
    for first in range(0, len(cells), columns):
        beside = cells[first : first + columns]
        row = np.full((max(len(cell) for cell in beside), width_px, 3), 255, np.uint8)
        for column, cell in enumerate(beside):
            left_px = column * (cell_px + _MARGIN_PX)
            row[: len(cell), left_px : left_px + cell_px] = cell
        rows.append(row)
    return np.concatenate([*rows, _scale(width_px, text_scale)])


def _panel(
    title: str, image: Picture, depth_m: Float32, width_px: int, text_scale: float
) -> Picture:
    """Return the picture (h,width_px,3) of depth over an image, with its title above."""
    enlarge = width_px / image.shape[1]
    # A point is at least 3 x 3 pixels in a smaller picture too.
    size_px = _POINT_SIZE_PX if enlarge >= 1 else 2 * round(_POINT_SIZE_PX / enlarge / 2) + 1
    nearest_m = np.where(depth_m > 0, depth_m, _NO_DEPTH_M)
    nearest_m = cv2.erode(nearest_m, np.ones((size_px, size_px), np.uint8))
    nearest_m = nearest_m.astype(np.float32, copy=False)
    drawn = depth_over_image(image, np.where(nearest_m < _NO_DEPTH_M, nearest_m, 0))
    shape = width_px, max(1, round(enlarge * image.shape[0]))
    method = cv2.INTER_NEAREST if enlarge >= 1 else cv2.INTER_AREA
    picture = cv2.resize(drawn, shape, interpolation=method)
    strip = np.full((round(text_scale * _TITLE_PX), width_px, 3), 255, np.uint8)
    _write(strip, title, _MARGIN_PX, width_px - _MARGIN_PX, text_scale)
    return np.concatenate([strip, picture.astype(np.uint8, copy=False)])


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


def _scale(width_px: int, text_scale: float) -> Picture:
    """Return the (h,w,3) colour scale with its ticks."""
    scale = np.full((round(text_scale * _SCALE_PX), width_px, 3), 255, np.uint8)
    left = width_px // 20
    bar_width_px = width_px - 2 * left
    bottom = _MARGIN_PX + round(text_scale * _BAR_PX)
    log_m = np.linspace(np.log(_NEAR_M), np.log(_FAR_M), bar_width_px)
    bar = scale[_MARGIN_PX:bottom, left : left + bar_width_px]
    bar[:] = colour_depth(np.exp(log_m).astype(np.float32)[None])
    # A tick is 2 px wide and 4 px high, with its label below.
    for tick_m in _TICKS_M:
        column = left + int(np.searchsorted(log_m, np.log(tick_m) - 1e-9))
        scale[bottom : bottom + 4, column - 1 : column + 1] = 0
        sides = column - left, column + left
        _write(scale[bottom:], f"{tick_m} m", *sides, text_scale, centred=True)
    return scale


def _write(
    strip: Picture,
    text: str,
    left_px: int,
    right_px: int,
    text_scale: float,
    centred: bool = False,
) -> None:
    """Write a line of text into the middle of a strip (h,w,3), smaller if it is too long."""
    size, stroke_px = text_scale * _FONT_SCALE, round(text_scale)
    (width_px, height_px), _ = cv2.getTextSize(text, _FONT, size, stroke_px)
    shrink = min(1.0, (right_px - left_px) / width_px)
    if centred:
        left_px = (left_px + right_px - round(shrink * width_px)) // 2
    at = left_px, (strip.shape[0] + height_px) // 2
    cv2.putText(strip, text, at, _FONT, shrink * size, (0, 0, 0), stroke_px, cv2.LINE_AA)


class Dot(NamedTuple):
    """A key in the plot of a score."""

    recording: str
    frame: int
    value: float | None  # None draws a cross below, for a key that failed
    style: str  # names of the style sheet, such as "hollow" or "suspect"
    text: str  # shown under the pointer
    target: str  # identifier of the element of the page that the dot leads to, "" for none


class Axis(NamedTuple):
    """The values of a score that a plot shows, and what is drawn behind its dots."""

    title: str
    lowest: float
    highest: float
    values: Mapping[str, Sequence[float]]  # style of the bars -> values of the histogram
    bounds: Mapping[str, float]  # style of a dashed line -> its value

    def ticks(self) -> list[float]:
        """Return round values that enclose the shown ones."""
        span = self.highest - self.lowest
        span = span if span > 1e-6 else 1.0  # equal values
        room = span / _NUM_TICKS
        power = 10.0 ** np.floor(np.log10(room))
        step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= 0.999 * room)
        first = np.floor(self.lowest / step + 1e-6)
        last = np.ceil((self.lowest + span) / step - 1e-6)
        return [float(round(step * row, 9)) for row in np.arange(first, last + 1)]


def score_plot(axis: Axis, dots: Sequence[Dot]) -> str:
    """Return SVG with a histogram of a score, and the score over the frames of each recording.

    Args:
        axis: The score and its values.
        dots: Keys, ordered by recording and frame.
    """
    ticks, (width_px, height_px) = axis.ticks(), _PLOT_PX
    scale_px = (_PLOT_BASE_PX - _PLOT_TOP_PX) / (ticks[-1] - ticks[0])  # per unit of the score

    def height(value: float) -> float:
        """Return the y of a value, within the plot."""
        return _PLOT_BASE_PX - (min(max(value, ticks[0]), ticks[-1]) - ticks[0]) * scale_px

    parts = [f'<text x="0" y="14" class="title">{html.escape(axis.title)}</text>']
    parts += _draw_histograms(axis.values, (ticks[0], ticks[-1]))
    left_px = float(_LABELS_PX + _HISTOGRAM_PX)
    for tick in ticks:
        parts.append(f'<path d="M{_LABELS_PX} {height(tick):.1f}H{width_px}"/>')
        text = f'<text x="{_LABELS_PX - 4}" y="{height(tick) + 4:.1f}" class="end">'
        parts.append(f"{text}{tick:g}</text>")
    parts += [
        f'<path class="limit {style}" d="M{left_px} {height(bound):.1f}H{width_px}"/>'
        for style, bound in axis.bounds.items()
        if ticks[0] <= bound <= ticks[-1]
    ]
    parts += _draw_dots(dots, left_px, height)
    label = html.escape(f"{axis.title} of each key over its frame number")
    size = f"0 0 {width_px} {height_px}"
    return f'<svg viewBox="{size}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _draw_histograms(values: Mapping[str, Sequence[float]], ends: tuple[float, float]) -> list[str]:
    """Return the bars of histograms over one another, each bar as high as its values."""
    counts = {style: np.histogram(v, _NUM_BINS, ends)[0] for style, v in values.items()}
    most = max((int(c.max()) for c in counts.values()), default=0) or 1
    bar_px = (_PLOT_BASE_PX - _PLOT_TOP_PX) / _NUM_BINS
    return [
        f'<rect x="{_LABELS_PX}" y="{_PLOT_BASE_PX - (row + 1) * bar_px:.1f}" class="bar {style}" '
        f'height="{bar_px - 1:.1f}" width="{(_HISTOGRAM_PX - 8) * num / most:.1f}">'
        f"<title>{num:,}</title></rect>"
        for style, of_style in counts.items()
        for row, num in enumerate(of_style)
        if num
    ]


def _draw_dots(dots: Sequence[Dot], left_px: float, height: Callable[[float], float]) -> list[str]:
    """Return the dots of all recordings side by side, every second one on a shaded ground."""
    groups = [list(group) for _, group in groupby(dots, key=lambda dot: dot.recording)]
    spans = [max(1, group[-1].frame - group[0].frame) for group in groups]
    room_px = _PLOT_PX[0] - left_px
    margin_px = min(_GAP_PX, room_px / (4 * max(len(groups), 1)))  # at both sides of a recording
    frame_px = (room_px - 2 * margin_px * len(groups)) / max(sum(spans), 1)
    parts = []
    for number, (group, span) in enumerate(zip(groups, spans, strict=True)):
        lane_px, first, last = span * frame_px + 2 * margin_px, group[0].frame, group[-1].frame
        if number % 2:
            parts.append(
                f'<rect class="lane" x="{left_px:.1f}" y="{_PLOT_TOP_PX}" width="{lane_px:.1f}" '
                f'height="{_PLOT_BASE_PX - _PLOT_TOP_PX}"/>'
            )
        radius_px = 3.0 if len(dots) <= _MANY_DOTS else 1.5
        for dot in group:
            x = left_px + margin_px + (dot.frame - first) * frame_px
            y = None if dot.value is None else height(dot.value)
            parts.append(_draw_dot(dot, x, y, radius_px))
        if lane_px >= _LEAST_LABEL_PX:
            parts.append(f'<text x="{left_px + margin_px:.1f}" y="154">frame {first}</text>')
            end_px = left_px + lane_px - margin_px
            parts.append(f'<text x="{end_px:.1f}" y="154" class="end">{last}</text>')
        left_px += lane_px
    return parts


def _draw_dot(dot: Dot, x: float, y: float | None, radius_px: float) -> str:
    style = html.escape(dot.style)
    if y is None:
        shape = f'<path class="failed" d="M{x - 3:.1f} {_PLOT_BASE_PX + 1}l6 6m0 -6l-6 6"/>'
    elif "above" in dot.style:  # the plot ends below the value
        shape = f'<path class="{style}" d="M{x - 4:.1f} {_PLOT_TOP_PX + 7}h8l-4 -7z"/>'
    else:
        shape = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius_px}" class="{style}"/>'
    mark = f"<g>{shape}<title>{html.escape(dot.text)}</title></g>"
    return f'<a href="#{html.escape(dot.target)}">{mark}</a>' if dot.target else mark


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
