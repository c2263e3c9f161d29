# SPDX-License-Identifier: MIT
"""The picture of risk over coverage: what a least confidence buys, camera by camera.

Drawn with opencv, which is there anyway: matplotlib and what it needs are 100 MB more to install.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from densify.geometry.types import Float, Result
from densify.outputs.context import Context
from densify.outputs.png import Picture, write_picture

Curve = Sequence[Mapping[str, Any]]
"""`densify.scores.depth_metrics.precision_density`."""
Colour = tuple[int, int, int]

_WIDTH_PX, _HEIGHT_PX = 860, 480
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 84, 150, 98, 62
_NONE_PX = _HEIGHT_PX - _BOTTOM_PX  # the line of no error
_ZERO_PX = 34  # from the logarithmic axis down to the line of no error
_MAX_COLUMNS = 2
_KINDS = ("measured", "filled")
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2)
_MAX_STEPS = 6
_COLOURS = ((80, 170, 255), (255, 150, 60), (120, 220, 120), (230, 120, 230), (240, 220, 90))
_GRAY, _FAINT, _WHITE, _DARK = (110, 110, 110), (52, 52, 52), (235, 235, 235), 20
_ROUND = tuple(m * 10.0**power for power in range(-5, 0) for m in (1, 2, 5)) + (1.0,)
_SIZE = 0.5
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``curve.png``: of all cameras, if any method was scored with the key held out."""
    curves: dict[str, dict[str, Curve]] = {}
    for method, of_method in {**result.baselines, result.method: result}.items():
        for camera, scores in (of_method.metrics.get("held_out") or {}).items():
            curves.setdefault(camera, {})[method] = scores["curve"]
    if curves:
        write_picture(folder / "curve.png", draw_curves(curves))


def draw_curves(curves: Mapping[str, Mapping[str, Curve]]) -> Picture:
    """Draw the curves of several cameras and methods.

    curves: camera -> method -> for each least confidence density and outliers. Density to the
    right, from 0, in round steps; outliers upwards, in decades; no outlier at all is a line of its
    own below the logarithmic axis. Thin lines are of measured pixels, thick ones of filled ones
    too; each begins at the right, where nothing is left out. All cameras have the same axes. The
    titles say density and error of the last method. Returns (H,W,3) uint8 RGB, two cameras side by
    side.
    """
    axes = _Axes.over([p for methods in curves.values() for c in methods.values() for p in c])
    panels = [_panel(camera, methods, axes) for camera, methods in curves.items()]
    num_columns = min(_MAX_COLUMNS, len(panels))
    empty = np.full_like(panels[0], _DARK)
    panels += [empty] * (-len(panels) % num_columns)
    rows = [panels[i : i + num_columns] for i in range(0, len(panels), num_columns)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


class _Axes(NamedTuple):
    """step, most: of density. low, high: of the outliers, 1, 2 or 5 times a power of ten."""

    step: float
    most: float
    low: float
    high: float

    @staticmethod
    def over(points: Curve) -> _Axes:
        most = max((p[f"density_{kind}"] for p in points for kind in _KINDS), default=0.0)
        step = next((s for s in _STEPS if most <= s * _MAX_STEPS), _STEPS[-1])
        errors = [error for p in points for kind in _KINDS if (error := p[f"outliers_{kind}"])]
        least, greatest = min(errors, default=0.001), max(errors, default=0.1)
        low = max((r for r in _ROUND if r <= min(least, 0.1)), default=_ROUND[0])
        high = min(r for r in _ROUND if r >= max(greatest, 9.99 * low))  # a decade at least
        return _Axes(step, step * max(1, math.ceil(most / step - 1e-9)), low, high)

    def x(self, density: float) -> float:
        return _LEFT_PX + (_WIDTH_PX - _RIGHT_PX - _LEFT_PX) * density / self.most

    def y(self, outliers: float) -> float:
        """0 is below the axis, on a line of its own."""
        if outliers <= 0:
            return _NONE_PX
        share = math.log(max(outliers, self.low) / self.low) / math.log(self.high / self.low)
        return _NONE_PX - _ZERO_PX - (_NONE_PX - _ZERO_PX - _TOP_PX) * share


class _Line(NamedTuple):
    """points: (N,2) px from where nothing is left out."""

    name: str
    points: Float
    colour: Colour
    thick: bool


def _panel(camera: str, methods: Mapping[str, Curve], axes: _Axes) -> Picture:
    canvas = np.full((_HEIGHT_PX, _WIDTH_PX, 3), _DARK, np.uint8)
    _draw_axes(canvas, axes)
    lines, said = [], ""
    for (method, curve), colour in zip(methods.items(), cycle(_COLOURS)):
        parts = []
        for kind in _KINDS:
            known = [p for p in curve if p[f"outliers_{kind}"] is not None]
            if known:
                pairs = [(p[f"density_{kind}"], p[f"outliers_{kind}"]) for p in known]
                points = np.array([(axes.x(density), axes.y(wrong)) for density, wrong in pairs])
                lines.append(_Line(f"{method}, {kind}", points, colour, kind == "filled"))
                parts.append(f"{kind} {pairs[0][0]:.1%} of pixels, {pairs[0][1]:.2%} wrong")
        said = f"{method}: {'; '.join(parts)}"
    for line in lines:
        _draw_line(canvas, line)
    for line, place in zip(lines, _label_places(lines), strict=True):
        _write(canvas, line.name, *place, colour=line.colour)
    _write(canvas, f"{camera}, key held out", 12, 26, 0.65)
    _write(canvas, said, 12, 52)
    return canvas


def _draw_axes(canvas: Picture, axes: _Axes) -> None:
    left, right = _LEFT_PX, _WIDTH_PX - _RIGHT_PX
    for outliers in (0.0, *(r for r in _ROUND if axes.low <= r <= axes.high)):
        y = axes.y(outliers)
        said = _is_decade(outliers) or outliers in (0, axes.low, axes.high)
        _stroke(canvas, (left, y), (right, y), _GRAY if said else _FAINT)
        if said:
            _write(canvas, f"{100 * outliers:g} %", left - 10, round(y) + 5, right=True)
    for number in range(round(axes.most / axes.step) + 1):
        x = axes.x(number * axes.step)
        _stroke(canvas, (x, _NONE_PX), (x, _NONE_PX + 6), _GRAY)
        _write(
            canvas, f"{100 * number * axes.step:.0f} %", round(x) + 18, _NONE_PX + 24, right=True
        )
    _write(canvas, "wrong", left - 10, _TOP_PX - 18, right=True)
    _write(canvas, "density of the image", right, _NONE_PX + 48, right=True)


def _is_decade(outliers: float) -> bool:
    return outliers > 0 and abs(math.log10(outliers) - round(math.log10(outliers))) < 1e-9


def _draw_line(canvas: Picture, line: _Line) -> None:
    """A dot for each point, and strokes between those above the line of no error."""
    for begin, end in pairwise(line.points.tolist()):
        if max(begin[1], end[1]) < _NONE_PX:
            _stroke(canvas, begin, end, line.colour, 2 if line.thick else 1)
    for x, y in line.points:
        radius = 4 if line.thick else 2
        cv2.circle(canvas, (round(x), round(y)), radius, line.colour, -1, cv2.LINE_AA)


def _label_places(lines: Sequence[_Line]) -> list[tuple[int, int]]:
    """Left end and baseline of each line's name: at its first point, on no name, and on no line
    where there is room."""
    drawn = np.concatenate([np.zeros((0, 2)), *(_along(line.points) for line in lines)])
    named = np.zeros((0, 2))
    places = []
    for line in lines:
        (width, height), _ = cv2.getTextSize(line.name, _FONT, _SIZE, 1)
        x, y = line.points[0]
        tried = [
            (x + dx, y + dy)
            for away in range(1, 12)
            for dx, dy in (
                (12, height / 2 + 12 * (away - 1)),
                (12, height / 2 - 12 * (away - 1)),
                (-width / 2, -12 * away),
                (-width / 2, height + 12 * away),
            )
        ]
        free = (
            (x, y)
            for taken in (np.concatenate([drawn, named]), named)
            for x, y in tried
            if _is_free(x, y, width, height, taken)
        )
        left, baseline = next(free, tried[0])
        spread = np.linspace(left, left + width, max(2, width // 6))
        rows = [np.stack([spread, np.full_like(spread, baseline - h)], 1) for h in (0, height)]
        named = np.concatenate([named, *rows])
        places.append((round(left), round(baseline)))
    return places


def _is_free(left: float, baseline: float, width: int, height: int, taken: Float) -> bool:
    """Whether a text is inside the panel and touches nothing."""
    if not (_LEFT_PX < left < _WIDTH_PX - width and _TOP_PX - 10 < baseline < _NONE_PX - 6):
        return False
    x, y = taken.T
    beside = (x < left - 4) | (x > left + width + 4)
    return bool((beside | (y < baseline - height - 4) | (y > baseline + 4)).all())


def _along(points: Float) -> Float:
    """Places along a line, some px apart."""
    share = np.linspace(0, 1, 24)[:, None]
    parts = [begin + share * (end - begin) for begin, end in pairwise(points)]
    return np.concatenate([points, *parts])


def _stroke(
    canvas: Picture,
    begin: Sequence[float],
    end: Sequence[float],
    colour: Colour,
    width: int = 1,
) -> None:
    first, last = ([round(16 * c) for c in place] for place in (begin, end))
    cv2.line(canvas, first, last, colour, width, cv2.LINE_AA, 4)  # in sixteenths of a pixel


def _write(
    canvas: Picture,
    text: str,
    x: int,
    baseline: int,
    size: float = _SIZE,
    *,
    colour: Colour = _WHITE,
    right: bool = False,
) -> None:
    """x: where the text begins, or with right where it ends."""
    left = x - cv2.getTextSize(text, _FONT, size, 1)[0][0] if right else x
    cv2.putText(canvas, text, (left, baseline), _FONT, size, colour, 1, cv2.LINE_AA)
