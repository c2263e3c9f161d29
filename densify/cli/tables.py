# SPDX-License-Identifier: MIT
"""What `run` and `compare` say on the screen. Reads `Result.metrics`:

- ``ghosts``: `densify.scores.ghost_scores`;
- ``depth``: camera -> `densify.scores.depth_scores`, where there is truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from densify.types import Result

_NONE = "-"
_SCORES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("coverage", "coverage", lambda value: f"{100 * value:.1f} %"),
    ("mae_m", "MAE", lambda value: f"{value:.3f} m"),
    ("rmse_m", "RMSE", lambda value: f"{value:.3f} m"),
    ("outliers", "outliers", lambda value: f"{100 * value:.2f} %"),
)
_PARTS = ("all", "moving", "static")


def summary(result: Result) -> str:
    """Three or so lines about one densified key."""
    cloud = result.cloud
    first, last = min(result.frames), max(result.frames)
    lines = [
        f"key {result.key}, {result.method}: {len(cloud):,} points of {len(result.frames)} sweeps "
        f"({first}-{last}), {np.count_nonzero(cloud.moving):,} on moving objects"
    ]
    for name in result.depth:
        measured, filled = (_density(result, name, product) for product in ("measured", "filled"))
        lines.append(f"{name}: depth in {measured} of the pixels, {filled} with filled ones")
    ghosts = _percent(_look_up(result.metrics, "ghosts", "all"))
    if ghosts != _NONE:
        baseline = _NONE
        if "icp" in result.baselines:
            baseline = _percent(_look_up(result.baselines["icp"].metrics, "ghosts", "all"))
        beside = "" if baseline == _NONE else f" ({baseline} by registration alone)"
        lines.append(f"ghosts: {ghosts} of the accumulated points{beside}")
    return "\n".join(lines)


def comparison(results: Mapping[str, Result]) -> str:
    """A table with one column per method.

    Rows: points, image density per camera, ghost rate (needs no truth), and where there is truth,
    coverage, MAE, RMSE and KITTI outliers of the measured depth at all, moving and static pixels.
    """
    columns = list(results.values())
    rows = [
        ["", *results],
        ["points", *(f"{len(result.cloud):,}" for result in columns)],
    ]
    for name in columns[0].depth:
        for product in ("measured", "filled"):
            densities = [_density(result, name, product) for result in columns]
            rows.append([f"{name} density, {product}", *densities])
    rates = [_look_up(result.metrics, "ghosts", "all") for result in columns]
    rows.append(["ghost rate", *map(_percent, rates)])
    for name in columns[0].depth:
        if any(_look_up(result.metrics, "depth", name) for result in columns):
            rows += _truth_rows(columns, name)
    return _aligned(rows)


def _truth_rows(columns: Sequence[Result], camera: str) -> list[list[str]]:
    rows: list[list[str]] = [[]]
    for part in _PARTS:
        for key, title, write in _SCORES:
            values = [
                _look_up(result.metrics, "depth", camera, "measured", part, key)
                for result in columns
            ]
            cells = [_NONE if value is None else write(value) for value in values]
            rows.append([f"{camera} {part}, {title}", *cells])
    return rows


def _density(result: Result, camera: str, product: str) -> str:
    depth = result.depth[camera]
    image = depth.depth_m if product == "measured" else depth.filled_m
    return _percent(np.count_nonzero(image) / image.size, digits=1)


def _percent(value: float | None, digits: int = 2) -> str:
    return _NONE if value is None else f"{100 * value:.{digits}f} %"


def _look_up(metrics: Mapping[str, Any], *path: str) -> Any:
    """metrics[a][b]..., None where a step of it is missing."""
    value: Any = metrics
    for step in path:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; an empty row is a blank line."""
    widths = [max(map(len, column)) for column in zip(*filter(None, rows), strict=True)]
    lines = []
    for row in rows:
        first, *others = row or [""]
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=False)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)
