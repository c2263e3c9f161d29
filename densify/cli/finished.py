# SPDX-License-Identifier: MIT
"""Answer the commands of finished runs, training sets and depth maps."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from densify.bench.depth import evaluate
from densify.cli.terminal import Answer, numbers_table, percent, progress_on_stderr
from densify.dataset.report import write_report
from densify.outputs.finished_run import Thresholds, export_run, facts, finished_runs
from densify.outputs.viewers import show_in_open3d, show_in_rerun
from densify.readers.depth_trees import pair_depth_files

_UNPAIRED = {
    "without_truth": "predicted without truth",
    "without_prediction": "truth without prediction",
    "without_mask": "truth without mask",
}
_MOST_NAMED = 5
_PRODUCTS = ("measured", "filled")


def answer_export(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify export``: write a run in another format, and yield what the limits keep."""
    exported = export_run(
        options.run,
        options.to,
        options.out,
        min_confidence=options.min_confidence,
        max_age_ms=options.max_age_ms,
        cameras=options.camera,
        overwrite=options.overwrite,
    )
    lines = []
    for camera, products in exported.density.items():
        measured, filled = (
            f"{percent(products[p].before, digits=1)} -> {percent(products[p].after, digits=1)}"
            for p in _PRODUCTS
        )
        lines.append(f"{camera}: depth in {measured} of the pixels, {filled} with filled ones")
    points = exported.num_points
    if points is not None:
        lines.append(f"cloud: {points.after:,} of {points.before:,} points")
    yield Answer("\n".join(lines), facts(exported), exported.paths)


def answer_report(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify report``: write the HTML pages of a folder."""
    yield Answer(files=write_report(options.dir, options.overwrite))


def answer_view(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify view``: show finished runs until the user closes the viewer."""
    runs = finished_runs(options.dir, Thresholds(cameras=options.camera))
    viewers = {"rerun": show_in_rerun, "open3d": show_in_open3d}
    viewers[vars(options)["with"]](runs)
    keys = [run.key for run in runs]
    yield Answer(f"shown: key {', '.join(map(str, keys))}", {"keys": keys})


def answer_evaluate(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify evaluate``: yield the scores of depth maps against ground truth."""
    pairs = pair_depth_files(options.predicted, options.truth, options.mask, filled=options.filled)
    with progress_on_stderr() as progress:
        scores = evaluate(pairs, options.focal_px, options.baseline_m, progress)
    num_images, density = scores["num_images"], scores["density"]
    lines = [
        f"{num_images:,} image{'s' * (num_images != 1)}: predicted "
        f"{percent(density['predicted'])} of the pixels, truth {percent(density['truth'])}; "
        f"outliers with fx {scores['focal_px']:g} px, baseline {scores['baseline_m']:g} m"
    ]
    for name, title in _UNPAIRED.items():
        if paths := scores[name]:
            num_more = len(paths) - _MOST_NAMED
            more = f", ... and {num_more:,} more" if num_more > 0 else ""
            lines.append(f"{title}: {len(paths):,}: {', '.join(paths[:_MOST_NAMED])}{more}")
    columns = {part: errors for part, errors in scores["parts"].items() if errors["num_pixels"]}
    yield Answer("\n".join([*lines, numbers_table(columns)]), {"scores": scores})
