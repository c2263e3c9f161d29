# SPDX-License-Identifier: MIT
"""The picture of precision over density: what a least confidence buys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from densify.outputs.context import Context
from densify.outputs.png import Picture, write_picture
from densify.types import Result

_WIDTH_PX, _HEIGHT_PX, _LEFT_PX, _BOTTOM_PX, _TOP_PX = 800, 520, 90, 60, 40
_LEAST = 1e-4  # of outliers that the axis shows
_TICKS = (1e-4, 1e-3, 1e-2, 1e-1)
_COLOURS = ((80, 170, 255), (255, 150, 60), (120, 220, 120), (230, 120, 230))
_GRAY, _WHITE, _DARK = (90, 90, 90), (255, 255, 255), 20
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``curve.png``: of the first camera, if any method was scored with the key held out."""
    curves = {
        method: next(iter(held_out.values()))["curve"]
        for method, of_method in {**result.baselines, result.method: result}.items()
        if (held_out := of_method.metrics.get("held_out"))
    }
    if curves:
        write_picture(folder / "curve.png", draw_curve(curves))


def draw_curve(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> Picture:
    """Draw `densify.scores.depth_metrics.precision_density` of several methods.

    Density to the right, outliers upwards, logarithmic from 0.01 to 100 %, clamped below. Thin:
    measured pixels; thick: with filled ones. Returns (520,800,3) uint8 RGB.
    """
    canvas = np.full((_HEIGHT_PX, _WIDTH_PX, 3), _DARK, np.uint8)
    densities = [p[f"density_{kind}"] for c in curves.values() for p in c for kind in _KINDS]
    most = max([0.1, *densities])
    for tick in _TICKS:
        y = _y(tick)
        cv2.line(canvas, (_LEFT_PX, y), (_WIDTH_PX - 20, y), _GRAY, 1)
        _write(canvas, f"{100 * tick:g} %", 8, y + 5)
    for step in range(6):
        share = most * step / 5
        _write(canvas, f"{100 * share:.0f} %", _x(share, most) - 18, _HEIGHT_PX - 32)
    _write(canvas, "wrong, of the held-out key's returns", 8, 22)
    _write(canvas, "density of the image", _WIDTH_PX - 230, _HEIGHT_PX - 8)
    for (name, curve), colour in zip(curves.items(), _COLOURS, strict=False):
        for kind, thickness in _KINDS.items():
            points = [
                (_x(p[f"density_{kind}"], most), _y(p[f"outliers_{kind}"]))
                for p in curve
                if p[f"outliers_{kind}"] is not None
            ]
            if points:
                corners = [np.array(points, np.int32)]
                cv2.polylines(canvas, corners, False, colour, thickness, cv2.LINE_AA)
                _write(canvas, name, points[0][0] - 24, max(points[0][1] - 10, _TOP_PX), colour)
    return canvas


_KINDS = {"measured": 1, "filled": 3}


def _x(density: float, most: float) -> int:
    return _LEFT_PX + round((_WIDTH_PX - 40 - _LEFT_PX) * density / most)


def _y(outliers: float) -> int:
    share = np.log(max(outliers, _LEAST) / _LEAST) / np.log(1 / _LEAST)
    return round(float(_HEIGHT_PX - _BOTTOM_PX - (_HEIGHT_PX - _BOTTOM_PX - _TOP_PX) * share))


def _write(
    canvas: Picture, text: str, left: int, baseline: int, colour: tuple[int, int, int] = _WHITE
) -> None:
    cv2.putText(canvas, text, (left, baseline), _FONT, 0.5, colour, 1, cv2.LINE_AA)
