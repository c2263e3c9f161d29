# SPDX-License-Identifier: MIT
"""Answer ``densify run`` and ``compare``."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from densify.cli.terminal import (
    Answer,
    aligned,
    config_of,
    first_of,
    log_warnings,
    look_up,
    percent,
    progress_on_stderr,
    raise_failures,
    recording_of,
    selected_frames,
    written,
)
from densify.config import as_mapping
from densify.config.errors import ComputationError, InputError
from densify.geometry.types import METHOD_NAMES, LidarSequence, Result
from densify.outputs.folders import check_recording, default_folder, plain
from densify.outputs.key_outputs import check_writable, write_comparison, write_result
from densify.outputs.plots import order_front_first
from densify.outputs.report_page import write_key_page
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import USUAL
from densify.readers import Spec, open_sequence
from densify.readers.timeline import format_frames
from densify.scores.metrics import LEAST_PIXELS, shown_score

_FIRST_OF_RUN = {
    "report.html": "all of it, in a browser",
    "figure.png": "the measured depth over the image",
    "depth_filled/*.png": "a depth map: 256 x metres",
    "depth_filled/*/*.png": "a depth map: 256 x metres",
    "cloud.laz": "the accumulated cloud",
    "metrics.json": "the scores",
    "run.yaml": "how it was made",
}
_FIRST_OF_COMPARISON = {
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
_PRODUCTS = ("measured", "filled")
_FEW_PIXELS = f"fewer than {LEAST_PIXELS} pixels to judge"


def answer_run(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify run``: densify the keys and yield an answer for each."""
    config, spec = config_of(options), Spec.parse(recording_of(options)).absolute()
    sequence = open_sequence(spec)
    asked = [*(options.key or [])]
    if options.keys is not None:
        asked += selected_frames(sequence, options.keys)
    keys = _keys_of(sequence, asked)
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec, keys)
    for key in keys:
        check_writable(out, key, options.overwrite)
    failures: dict[int, Exception] = {}
    warnings: list[tuple[str, str, int]] = []
    wanted = (keys, options.window, options.method, options.camera, config)
    with progress_on_stderr() as progress:
        results = pipeline.run_keys(sequence, *wanted, progress, prior=options.prior)
        for key, result in results:
            if isinstance(result, Exception):
                failures[key] = result
                yield Answer(facts={"keys": [{"key": key, "error": str(result)}]})
                continue
            paths = write_result(
                result, out, config=as_mapping(config), data=spec, overwrite=options.overwrite
            )
            first = first_of(_front_first(paths, result), _FIRST_OF_RUN)
            yield Answer(_summary(result), {"keys": [_key_facts(result)]}, paths, first)
            warnings += [(warning, "", key) for warning in result.warnings]
            if result.depth and not any(maps.filled_m.any() for maps in result.depth.values()):
                failures[key] = ComputationError(
                    "every depth map is empty; are calibration and stamps right? densify doctor "
                    "looks into both"
                )
    log_warnings(warnings)
    if len(keys) == 1 and failures:
        raise failures[keys[0]]
    raise_failures(failures, len(keys), "key")


def _keys_of(sequence: LidarSequence, asked: Sequence[int]) -> list[int]:
    """Return the keys that are asked for, ascending, by default the recording's middle frame."""
    keys, frames = {*asked}, format_frames(sequence.frames)
    for key in sorted(keys - {*sequence.frames}):
        raise InputError(f"--key {key}: no such frame in {sequence.name}; it has {frames}")
    if not keys:
        keys = {sequence.frames[len(sequence.frames) // 2]}
        logging.getLogger("densify").info(
            "no --key given: taking the middle frame, %d, of %s", *keys, frames
        )
    return sorted(keys)


def _front_first(paths: Sequence[Path], result: Result) -> list[Path]:
    """Return the files of a run, beginning with those of the camera that looks ahead."""
    names = order_front_first([*result.depth], result.views, result.T_key_lidar)
    front = [
        path for path in paths if names and path.with_suffix("").as_posix().endswith(f"/{names[0]}")
    ]
    return [*front, *(path for path in paths if path not in front)]


def answer_compare(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify compare``: densify one key by several methods and yield their scores."""
    config, spec = config_of(options), Spec.parse(recording_of(options)).absolute()
    sequence = open_sequence(spec)
    (key,) = _keys_of(sequence, [] if options.key is None else [options.key])
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec, [key])
    check_writable(out, key, options.overwrite, "compare")
    wanted = (key, options.window, options.camera, config)
    with progress_on_stderr() as progress:
        results = pipeline.compare(sequence, *wanted, progress, options.methods or USUAL)
    paths = write_comparison(
        results, out, config=as_mapping(config), data=spec, overwrite=options.overwrite
    )
    if config.output.report:
        paths.append(write_key_page(paths[0].parent, "compare.json"))
    scores = {"key": key, "methods": {n: _key_facts(r) for n, r in results.items()}}
    yield Answer(_comparison(results), scores, paths, first_of(paths, _FIRST_OF_COMPARISON))
    distinct = dict.fromkeys(w for result in results.values() for w in result.warnings)
    log_warnings((warning, "", key) for warning in distinct)


def _summary(result: Result) -> str:
    """Return a few lines of text about one densified key."""
    cloud = result.cloud
    moving = f"{np.count_nonzero(cloud.moving):,} on moving objects"
    if result.movers:
        num_apart = sum(len(mover.cloud) for mover in result.movers.values())
        moving = f"{num_apart:,} more apart, on {len(result.movers)} moving objects"
    method, is_few = METHOD_NAMES.get(result.method, result.method), False
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
            lines.append(f"{name}, outliers expected by confidence: {_of_pixels(**expected)}")
        truth = {p: look_up(result.metrics, "depth", name, p, "all") or {} for p in _PRODUCTS}
        if all(scores.get("num_compared") for scores in truth.values()):
            exact = {p: shown_score(scores, "outliers") for p, scores in truth.items()}
            lines.append(f"{name}, outliers against exact truth: {_of_pixels(**exact)}")
            is_few |= None in exact.values()
    if ghosts := _beside_icp(result, "ghosts", "all"):
        lines.append(f"ghosts of the accumulated points: {ghosts}")
    for name in result.depth:
        for pixels, where in (("all", ""), ("moving", ", on moving objects")):
            scored = ("held_out", name, "measured", pixels)
            if look_up(result.metrics, *scored, "num_compared"):
                outliers = _beside_icp(result, *scored, "outliers")
                lines.append(f"{name}, key held out: outliers{where}: {outliers or '-'}")
                is_few |= not outliers
        if unjudged := look_up(result.metrics, "held_out", name, "unjudged"):
            lines.append(
                f"{name}, not judged, because the key sweep has no return there: "
                f"{percent(unjudged['static'])} of static, {percent(unjudged['moving'])} of moving "
                "pixels"
            )
    return "\n".join([*lines, *([f"-: {_FEW_PIXELS}"] if is_few else [])])


def _of_pixels(measured: float | None, filled: float | None) -> str:
    return f"{percent(measured)} of the measured pixels, {percent(filled)} with filled ones"


def _beside_icp(result: Result, *path: str) -> str:
    """Return a share as text, with that of rigid accumulation in brackets, or "" for no share."""
    share = _shown(result, *path)
    rigid = result.baselines.get("icp")
    by_icp = _shown(rigid, *path) if rigid is not None else None
    beside = "" if by_icp is None else f" ({percent(by_icp)} with rigid accumulation)"
    return "" if share is None else percent(share) + beside


def _shown(result: Result, *path: str) -> float | None:
    """Return ``metrics[a][b]...``, None if a key is missing or the score is of too few pixels."""
    scores = look_up(result.metrics, *path[:-1])
    if isinstance(scores, Mapping) and "num_compared" in scores:
        return shown_score(scores, path[-1])
    return look_up(result.metrics, *path)


def _key_facts(result: Result) -> dict[str, Any]:
    """Return the scores of one method's result, as numbers."""
    metrics = result.metrics
    return plain(
        {
            "key": result.key,
            "method": result.method,
            "frames": result.frames,
            "num_points": len(result.cloud),
            "num_moving": int(np.count_nonzero(result.cloud.moving)),
            "seconds": sum(cost.seconds for cost in result.costs),
            "elapsed_s": round(result.elapsed_s, 3),
            "error": None,
            "density": metrics.get("density"),
            "ghosts": look_up(metrics, "ghosts", "all"),
            **{
                truth: {c: look_up(metrics, truth, c, "measured", "all") for c in result.depth}
                for truth in ("held_out", "depth")
            },
        }
    )


def _comparison(results: Mapping[str, Result]) -> str:
    """Return a table with one column per method: points, density, ghost rate, scores of depth."""
    cameras = list(next(iter(results.values())).depth)
    rows: list[tuple[str, tuple[str, ...], str]] = [("points", ("num_points",), ",d")]
    for camera in cameras:
        for product in _PRODUCTS:
            rows.append((f"{camera} density, {product}", ("density", camera, product), ".1%"))
    rows.append(("ghost rate", ("ghosts", "all"), ".2%"))
    for camera in cameras:
        for truth, title in (("held_out", "key held out"), ("depth", "truth")):
            for pixels in ("all", "moving", "static"):
                for score, key, form in _SCORES:
                    score_path = (truth, camera, "measured", pixels, key)
                    rows.append((f"{camera} {title}, {pixels}, {score}", score_path, form))
    lines = [["", *(METHOD_NAMES.get(name, name) for name in results)]]
    is_few = False
    for title, path, form in rows:
        known = [look_up(result.metrics, *path) for result in results.values()]
        numbers = [_shown(result, *path) for result in results.values()]
        is_few |= known != numbers
        if any(number is not None for number in known):
            lines.append([title, *(written(number, form) for number in numbers)])
    return aligned(lines) + (f"\n-: no score, or {_FEW_PIXELS}" if is_few else "")
