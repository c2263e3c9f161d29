# SPDX-License-Identifier: MIT
"""Summarise results, comparisons and exports, as text and (``*_facts``) as numbers for programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from densify.cli.screen import aligned, look_up, percent, written
from densify.geometry.types import METHOD_NAMES, Result
from densify.outputs.atomic import plain
from densify.outputs.export import Export
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
    ("MAE", "mae_m", ".3f m"),
    ("RMSE", "rmse_m", ".3f m"),
    ("outliers", "outliers", ".2%"),
)


def summary(result: Result) -> str:
    """Return a few lines of text about one densified key."""
    cloud = result.cloud
    moving = f"{np.count_nonzero(cloud.moving):,} on moving objects"
    if result.movers:
        num_apart = sum(len(mover.cloud) for mover in result.movers.values())
        moving = f"{num_apart:,} more apart, on {len(result.movers)} moving objects"
    method = METHOD_NAMES.get(result.method, result.method)
    lines = [
        f"key {result.key}, {method}: {len(cloud):,} points of {len(result.frames)} sweeps "
        f"({format_frames(result.frames)}), {moving}"
    ]
    for name in result.depth:
        share = {p: percent(s, 1) for p, s in result.metrics["density"][name].items()}
        line = f"{name}: depth in {share['measured']} of the pixels, {share['filled']} with filled"
        line += f" ones, {share['full']} with those from the prior" if "full" in share else " ones"
        lines.append(line)
        if expected := look_up(result.metrics, "expected_outliers", name):
            share = {product: percent(of_all) for product, of_all in expected.items()}
            lines.append(
                f"{name}, expected outliers by confidence: {share['measured']} of the measured, "
                f"{share['filled']} of all pixels with a depth"
            )
    if ghosts := _beside_icp(result, "ghosts", "all"):
        lines.append(f"ghosts of the accumulated points: {ghosts}")
    for name in result.depth:
        for part, where in (("all", ""), ("moving", ", on moving objects")):
            if outliers := _beside_icp(result, "held_out", name, "measured", part, "outliers"):
                lines.append(f"{name}, key held out: outliers{where}: {outliers}")
        if unjudged := look_up(result.metrics, "held_out", name, "unjudged"):
            lines.append(
                f"{name}, not judged, because the key sweep has no return there: "
                f"{percent(unjudged['static'])} of static, {percent(unjudged['moving'])} of moving "
                "pixels"
            )
    return "\n".join(lines)


def _beside_icp(result: Result, *path: str) -> str:
    """Return a share as text, with the share of rigid accumulation in brackets; "" for none."""
    share = look_up(result.metrics, *path)
    rigid = result.baselines.get("icp")
    by_icp = look_up(rigid.metrics, *path) if rigid is not None else None
    beside = "" if by_icp is None else f" ({percent(by_icp)} with rigid accumulation)"
    return "" if share is None else percent(share) + beside


def key_facts(result: Result) -> dict[str, Any]:
    """Return the scores of one method's result, as numbers."""
    metrics = result.metrics
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
        "held_out": {c: look_up(metrics, "held_out", c, "measured", "all") for c in result.depth},
        "depth": {c: look_up(metrics, "depth", c, "measured", "all") for c in result.depth},
    }
    return dict(plain(facts))


def comparison(results: Mapping[str, Result]) -> str:
    """Return a table with one column per method: points, density, ghost rate, scores of depth."""
    cameras = list(next(iter(results.values())).depth)
    rows: list[tuple[str, tuple[str, ...], str]] = [("points", ("num_points",), ",d")]
    for camera in cameras:
        for product in ("measured", "filled"):
            rows.append((f"{camera} density, {product}", ("density", camera, product), ".1%"))
    rows.append(("ghost rate", ("ghosts", "all"), ".2%"))
    for camera in cameras:
        for source, said in (("held_out", "key held out"), ("depth", "truth")):
            for part in ("all", "moving", "static"):
                for score, key, form in _SCORES:
                    path = (source, camera, "measured", part, key)
                    rows.append((f"{camera} {said}, {part}, {score}", path, form))
    lines = [["", *(METHOD_NAMES.get(name, name) for name in results)]]
    for title, places, form in rows:
        numbers = [look_up(result.metrics, *places) for result in results.values()]
        if any(number is not None for number in numbers):
            lines.append([title, *(written(number, form) for number in numbers)])
    return aligned(lines)


def export_summary(exported: Export) -> str:
    """Return a line per camera with its density before and after, and one line for the cloud."""
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
