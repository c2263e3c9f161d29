# SPDX-License-Identifier: MIT
"""Summaries of results, comparisons and exports, for people and (``*_facts``) for programs.

Read from `Result.metrics`: ``ghosts``, ``held_out`` by camera (scores of the map made without the
key sweep against its returns) and ``depth`` by camera (scores against exact truth).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from densify.cli.answer import aligned, look_up, percent, written
from densify.geometry.types import Result
from densify.outputs import Export
from densify.outputs.plain import plain
from densify.readers.timeline import format_frames

FIRST_OF_RUN = {
    "report.html": "all of it, in a browser",
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
_SCORES = (
    ("coverage", "coverage", ".1%"),
    ("mae_m", "MAE", ".3f m"),
    ("rmse_m", "RMSE", ".3f m"),
    ("outliers", "outliers", ".2%"),
)


def summary(result: Result) -> str:
    """Return a few lines about one densified key."""
    cloud = result.cloud
    moving = f"{np.count_nonzero(cloud.moving):,} on moving objects"
    if result.movers:
        num_apart = sum(len(mover.cloud) for mover in result.movers.values())
        moving = f"{num_apart:,} more apart, on {len(result.movers)} moving objects"
    lines = [
        f"key {result.key}, {result.method}: {len(cloud):,} points of {len(result.frames)} sweeps "
        f"({format_frames(result.frames)}), {moving}"
    ]
    for name in result.depth:
        measured, filled = (_density(result, name, product) for product in ("measured", "filled"))
        line = f"{name}: depth in {measured} of the pixels, {filled} with filled ones"
        if name in result.full:
            line += f", {_density(result, name, 'full')} with those from the prior"
        lines.append(line)
    ghosts = _beside_icp(result, "ghosts", "all")
    if ghosts:
        ghost_rate, beside = ghosts
        lines.append(f"ghosts: {ghost_rate} of the accumulated points{beside}")
    for name in result.depth:
        said = []
        for part, where in (("all", ""), ("moving", " on moving objects")):
            outliers = _beside_icp(result, "held_out", name, "measured", part, "outliers")
            if outliers:
                said.append(f"{outliers[0]} outliers{outliers[1]}{where}")
        if said:
            lines.append(f"{name}, key held out: {', '.join(said)}")
    return "\n".join(lines)


def _beside_icp(result: Result, *path: str) -> tuple[str, str] | None:
    """Return a share as text, and in brackets that of rigid accumulation where it was made."""
    share = look_up(result.metrics, *path)
    if share is None:
        return None
    rigid = None
    if "icp" in result.baselines:
        rigid = look_up(result.baselines["icp"].metrics, *path)
    return percent(share), "" if rigid is None else f" ({percent(rigid)} by registration alone)"


def key_facts(result: Result) -> dict[str, Any]:
    """Return the numbers of one method's result."""
    metrics = result.metrics
    held_out = metrics.get("held_out") or {}
    facts = {
        "key": result.key,
        "method": result.method,
        "frames": result.frames,
        "num_points": len(result.cloud),
        "num_moving": int(np.count_nonzero(result.cloud.moving)),
        "seconds": sum(cost.seconds for cost in result.costs),
        "error": None,
        "density": metrics.get("density"),
        "ghosts": look_up(metrics, "ghosts", "all"),
        "held_out": {c: look_up(held_out, c, "measured", "all") for c in result.depth},
        "depth": {c: look_up(metrics, "depth", c, "measured", "all") for c in result.depth},
    }
    return dict(plain(facts))


def comparison(results: Mapping[str, Result]) -> str:
    """Return a table with one column per method.

    Rows: points, image density per camera, ghost rate, and coverage, MAE, RMSE and outliers of the
    measured depth at all, moving and static pixels, with the key held out and against exact truth.
    """
    columns = list(results.values())
    rows = [["", *results], ["points", *(f"{len(result.cloud):,}" for result in columns)]]
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
    for part in ("all", "moving", "static"):
        for key, score, form in _SCORES:
            path = (source, camera, "measured", part, key)
            cells = [written(look_up(result.metrics, *path), form) for result in columns]
            rows.append([f"{camera} {title}, {part}, {score}", *cells])
    return rows


def _density(result: Result, camera: str, product: str) -> str:
    """Return the share of the pixels with a depth."""
    if product == "full":
        image = result.full[camera].depth_m
    else:
        depth = result.depth[camera]
        image = depth.depth_m if product == "measured" else depth.filled_m
    return percent(np.count_nonzero(image) / image.size, digits=1)


def export_summary(exported: Export) -> str:
    """Return a line for each camera, its density before and after, and one for the cloud."""
    lines = []
    for camera, products in exported.density.items():
        measured, filled = (
            f"{percent(products[p].before, digits=1)} -> {percent(products[p].after, digits=1)}"
            for p in ("measured", "filled")
        )
        lines.append(f"{camera}: depth in {measured} of the pixels, {filled} with filled ones")
    points = exported.num_points
    if points is not None:
        lines.append(f"cloud: {points.after:,} of {points.before:,} points")
    return "\n".join(lines)
