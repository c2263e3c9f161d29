# SPDX-License-Identifier: MIT
"""What is said of results and exports. Reads `Result.metrics`:

- ``ghosts``: `densify.scores.cloud_scores.ghost_scores`;
- ``held_out``: camera -> the same for the key densified from its neighbours alone;
- ``depth``: camera -> `densify.scores.depth_metrics.depth_scores`, where there is truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from densify.cli.tables import NONE, aligned, look_up, percent
from densify.geometry.types import Result
from densify.outputs import Export
from densify.outputs.plain import plain
from densify.readers.timeline import format_frames

FIRST_OF_RUN = {
    "report.html": "all of it, in a browser",
    "*.webp": "the film",
    "*.gif": "the film",
    "figure.png": "what was gained, at a glance",
    "depth_filled/*.png": "a depth map: 256 x metres",
    "depth_filled/*/*.png": "a depth map: 256 x metres",
    "cloud.laz": "the accumulated cloud",
    "metrics.json": "the scores",
    "run.yaml": "how it was made",
}
FIRST_OF_COMPARISON = {
    "compare.html": "all of it, in a browser",
    "compare.png": "the methods side by side",
    "compare.json": "their scores",
    "compare/cloud.laz": "the last method's cloud",
}
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
    lines = [
        f"key {result.key}, {result.method}: {len(cloud):,} points of {len(result.frames)} sweeps "
        f"({format_frames(result.frames)}), {_moving(result)}"
    ]
    for name in result.depth:
        measured, filled = (_density(result, name, product) for product in ("measured", "filled"))
        line = f"{name}: depth in {measured} of the pixels, {filled} with filled ones"
        if name in result.full:
            line += f", {_density(result, name, 'full')} with those from the prior"
        lines.append(line)
    ghosts = percent(look_up(result.metrics, "ghosts", "all"))
    if ghosts != NONE:
        baseline = NONE
        if "icp" in result.baselines:
            baseline = percent(look_up(result.baselines["icp"].metrics, "ghosts", "all"))
        beside = "" if baseline == NONE else f" ({baseline} by registration alone)"
        lines.append(f"ghosts: {ghosts} of the accumulated points{beside}")
    lines += [line for name in result.depth if (line := _held_out_line(result, name))]
    return "\n".join(lines)


def _moving(result: Result) -> str:
    if not result.movers:
        return f"{np.count_nonzero(result.cloud.moving):,} on moving objects"
    num_apart = sum(len(mover.cloud) for mover in result.movers.values())
    return f"{num_apart:,} more apart, on {len(result.movers)} moving objects"


def _held_out_line(result: Result, camera: str) -> str:
    """The key from its neighbours alone, against its own returns."""
    said = []
    for part in ("all", "moving"):
        path = ("held_out", camera, "measured", part, "outliers")
        mine = look_up(result.metrics, *path)
        if mine is None:
            continue
        icp = result.baselines.get("icp")
        other = None if icp is None else look_up(icp.metrics, *path)
        beside = "" if other is None else f" ({percent(other)} by registration alone)"
        said.append(f"{percent(mine)} wrong{beside}{'' if part == 'all' else ' where it moves'}")
    return f"{camera}, key held out: {', '.join(said)}" if said else ""


def export_summary(exported: Export) -> str:
    """A line for each camera, the share of its pixels with a depth, before and after, and one for
    the cloud."""
    lines = []
    for camera, products in exported.density.items():
        measured, filled = (
            f"{percent(products[p].before, digits=1)} -> {percent(products[p].after, digits=1)}"
            for p in ("measured", "filled")
        )
        lines.append(f"{camera}: depth in {measured} of the pixels, {filled} with filled ones")
    if exported.num_points is not None:
        lines.append(
            f"cloud: {exported.num_points.after:,} of {exported.num_points.before:,} points"
        )
    return "\n".join(lines)


def key_facts(result: Result) -> dict[str, Any]:
    """The numbers of one method's result, for programs."""
    metrics = result.metrics
    held_out = metrics.get("held_out")
    known = {
        "density": metrics.get("density"),
        "ghosts": look_up(metrics, "ghosts", "all"),
        "held_out": {c: look_up(held_out or {}, c, "measured", "all") for c in result.depth},
        "depth": {c: look_up(metrics, "depth", c, "measured", "all") for c in result.depth},
    }
    facts = {
        "key": result.key,
        "method": result.method,
        "frames": result.frames,
        "num_points": len(result.cloud),
        "num_moving": int(np.count_nonzero(result.cloud.moving)),
        "seconds": sum(cost.seconds for cost in result.costs),
        "error": None,
    }
    return dict(plain({**facts, **known}))


def comparison(results: Mapping[str, Result]) -> str:
    """A table with one column per method.

    Rows: points, image density per camera, ghost rate, and coverage, MAE, RMSE and KITTI outliers
    of the measured depth at all, moving and static pixels, with the key held out (neither needs
    truth) and against truth where there is some.
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
    rates = [look_up(result.metrics, "ghosts", "all") for result in columns]
    rows.append(["ghost rate", *map(percent, rates)])
    for name in columns[0].depth:
        for source, title in (("held_out", "key held out"), ("depth", "truth")):
            if any(look_up(result.metrics, source, name) for result in columns):
                rows += _score_rows(columns, source, name, title)
    return aligned(rows)


def _score_rows(columns: Sequence[Result], source: str, camera: str, title: str) -> list[list[str]]:
    rows: list[list[str]] = [[]]
    for part in _PARTS:
        for key, score, write in _SCORES:
            values = [
                look_up(result.metrics, source, camera, "measured", part, key) for result in columns
            ]
            cells = [NONE if value is None else write(value) for value in values]
            rows.append([f"{camera} {title}, {part}, {score}", *cells])
    return rows


def _density(result: Result, camera: str, product: str) -> str:
    if product == "full":
        image = result.full[camera].depth_m
    else:
        depth = result.depth[camera]
        image = depth.depth_m if product == "measured" else depth.filled_m
    return percent(np.count_nonzero(image) / image.size, digits=1)
