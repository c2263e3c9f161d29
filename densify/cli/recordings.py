# SPDX-License-Identifier: MIT
"""Answer the commands of recordings, the simulator, training sets, finished runs and depth maps."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify.bench.depth import evaluate
from densify.cli.terminal import (
    Answer,
    check_new_file,
    config_of,
    first_of,
    log_warnings,
    numbers_table,
    percent,
    progress_on_stderr,
    raise_failures,
    recording_of,
    recordings_of,
    selected_frames,
)
from densify.config import Config, apply_overrides, find_changes, resolve
from densify.config.errors import ComputationError, InputError
from densify.dataset.make import Summary, damaged, make_dataset, status
from densify.dataset.manifest import describe_pace, describe_rest
from densify.dataset.plan import Gate, Recipe
from densify.dataset.report import write_report, write_set_page
from densify.doctor import Diagnosis, Verdict, examine
from densify.flow.two_clouds import estimate_flow
from densify.geometry.types import Float
from densify.learning.labels import Label, label_sweeps, write_label
from densify.outputs.finished_run import Thresholds, export_run, facts, finished_runs
from densify.outputs.flow_writers import flow_npz, flow_writer
from densify.outputs.folders import check_recording, default_folder, write_file
from densify.outputs.simulated_street import write_street
from densify.outputs.viewers import show_in_open3d, show_in_rerun
from densify.pipeline.run import flow_steps
from densify.readers import align, describe, findings, open_sequence
from densify.readers.depth_trees import pair_depth_files
from densify.readers.point_files import read_table
from densify.readers.street import Street

_WIDTH = 100
_SETTING = re.compile(r"--set ([a-z_]+\.[a-z_]+=[^\s,;)]+)")
_FIRST_OF_SET = {
    "report.html": "the page of the set, for the browser",
    "README.txt": "what the set holds and how to read it",
    "manifest.jsonl": "every key with its files and scores",
    "dataset.json": "how it was made",
}
_SCORES = {"density": "density", "ghost": "ghosts", "outliers": "held-out outliers"}
_STATES = {"done": "done", "aside": "put aside", "failed": "failed", "left": "to make"}
_REASON = ("drive", "key", "status", "reason")
_MOST_REASONS = 20


def answer_info(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify info``: yield what a recording holds."""
    sequence = open_sequence(recording_of(options))
    lines, frames, cameras = findings(sequence), [*sequence.frames], [*sequence.cameras]
    yield Answer(align(lines), {"recording": dict(lines), "frames": frames, "cameras": cameras})


def answer_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify doctor``: yield the findings. Raise InputError if something is wrong."""
    config, spec = config_of(options), recording_of(options)
    sequence = open_sequence(spec)
    if options.write is not None:
        check_new_file(options.write, options.overwrite, ".yaml", "--write")
    diagnosis = examine(sequence, config)
    facts = {
        "recording": sequence.name,
        "worst": str(diagnosis.worst),
        "findings": [{**asdict(f), "verdict": str(f.verdict)} for f in diagnosis.findings],
    }
    files, note = [], ""
    if options.write is not None:
        changes = [text for f in diagnosis.findings for text in _SETTING.findall(f.remedy)]
        settings = find_changes(resolve(config, changes))
        write_file(options.write, yaml.safe_dump(settings, sort_keys=False).encode())
        files = [options.write]
        num_other = sum(
            bool(f.remedy) and not _SETTING.search(f.remedy) for f in diagnosis.findings
        )
        if num_other:
            note = (
                f"\n{num_other} of the remedies above are no settings, and not in {options.write}"
            )
    yield Answer(f"{describe(sequence)}\n\n{_verdicts(diagnosis)}{note}", facts, files)
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{spec}: wrong: {', '.join(wrong)}; the remedies are above")


def _verdicts(diagnosis: Diagnosis) -> str:
    """Return verdict, check and evidence of each finding, its remedy below, and the counts."""
    margin = " " * (2 + max(len(str(v)) for v in Verdict))
    lines = []
    for finding in diagnosis.findings:
        evidence = f"{finding.check}: {finding.evidence}"
        begin = f"{finding.verdict!s:<{len(margin)}}"
        lines += textwrap.wrap(evidence, _WIDTH, initial_indent=begin, subsequent_indent=margin)
        if finding.remedy:
            lines.append(f"{margin}-> {finding.remedy}")
    counts = {v: sum(f.verdict == v for f in diagnosis.findings) for v in Verdict}
    return "\n".join([*lines, "", ", ".join(f"{n} {v}" for v, n in counts.items())])


def answer_simulate(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify simulate``: write the street and yield its path."""
    street = Street.from_spec(recording_of(options))
    frames, chosen = list(street.frames), options.frames
    if chosen is not None and (chosen[0] < frames[0] or chosen[-1] > frames[-1]):
        raise InputError(
            f"--frames {chosen.start}:{chosen.stop}: expected frames within "
            f"{frames[0]}:{frames[-1] + 1}"
        )
    frames = frames if chosen is None else list(chosen)
    wanted = (options.format, street, options.out, frames, options.camera)
    with progress_on_stderr() as progress:
        folder = write_street(*wanted, progress, overwrite=options.overwrite)
    text = f"{len(frames)} frames; open them: densify run {folder}"
    yield Answer(text, {"data": str(folder), "num_frames": len(frames)})


def answer_dataset(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify dataset``: make the set, or yield its progress."""
    yield from _make_set(options) if options.status is None else _check_set(options)


def _check_set(options: argparse.Namespace) -> Iterator[Answer]:
    """Yield the progress of a set. Raise ComputationError if ``--verify`` finds damaged files."""
    summary = status(options.status)
    files = damaged(options.status) if options.verify else []
    lines = [_describe_set(summary), *(f"damaged: {name}" for name in files)]
    yield Answer("\n".join(lines), {**_set_facts(summary), "damaged": files})
    if files:
        raise ComputationError(
            f"--verify: {len(files)} damaged or missing files in {options.status}; run the "
            f"command that made the set again with --verify, which makes them again"
        )


def _recipe(options: argparse.Namespace) -> Recipe:
    """Return the recipe of a set. ``--set`` has its limits, dataset.NAME, and other settings."""
    overrides = options.set or []
    limits = [text for text in overrides if text.strip().startswith("dataset.")]
    gate = {"dataset": asdict(Gate())}
    apply_overrides(gate, limits, {"dataset": Gate})
    return Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.camera is None else tuple(options.camera),
        gate=Gate(**gate["dataset"]),
        config=resolve(options.config, [text for text in overrides if text not in limits]),
    )


def _make_set(options: argparse.Namespace) -> Iterator[Answer]:
    """Make or continue a set with its page, and yield the progress."""
    out = options.out
    if out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    recipe = _recipe(options)
    with progress_on_stderr() as progress:
        summary = make_dataset(
            recordings_of(options),
            out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            verify=options.verify,
            preview=options.preview,
            report=lambda so_far: progress("keys", len(so_far.records), so_far.num_keys),
        )
    whole = status(out)
    to_continue = re.sub(r" --preview[ =]\d+", "", options.command)
    write_set_page(out, "" if options.preview is None else to_continue)
    lines = [_describe_set(summary)]
    if options.preview is not None and whole.num_left:
        rest = describe_rest(whole.records.values(), whole.num_left)
        lines.append(f"{rest or f'{whole.num_left:,} keys are left'}: {to_continue}")
    log_warnings((w, r.drive, r.key) for r in summary.records.values() for w in r.warnings)
    paths = [out / name for name in _FIRST_OF_SET if (out / name).is_file()]
    yield Answer("\n".join(lines), _set_facts(summary), [out], first_of(paths, _FIRST_OF_SET))
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")


def _describe_set(summary: Summary) -> str:
    """Return the numbers of keys by status, mean scores, and the reasons of missing keys."""
    facts = _set_facts(summary)
    numbers = {state: facts[f"num_{state}"] for state in _STATES}
    counts = [f"{n} {_STATES[state]}" for state, n in numbers.items() if n or state == "done"]
    lines = [f"{summary.num_keys} keys: {', '.join(counts)}"]
    if summary.num_made:
        lines[0] += f"; {summary.num_made} now, {describe_pace(summary.records.values())}"
    means = [(title, facts["means"][score]) for score, title in _SCORES.items()]
    known = [f"{title} {percent(mean)}" for title, mean in means if mean is not None]
    lines += [f"on average {', '.join(known)}"] if known else []
    missing = ["{drive} {key} {status}: {reason}".format(**key) for key in facts["missing"]]
    lines += missing[:_MOST_REASONS]
    if len(missing) > _MOST_REASONS:
        lines.append(f"... and {len(missing) - _MOST_REASONS} more, see the manifest")
    return "\n".join(line for line in lines if line)


def _set_facts(summary: Summary) -> dict[str, Any]:
    """Return the progress of a set as numbers, and its keys that are not done."""
    missing = [r for r in summary.records.values() if r.status != "done"]
    return {
        "num_keys": summary.num_keys,
        **{f"num_{status}": summary.count(status) for status in ("done", "aside", "failed")},
        "num_left": summary.num_left,
        "num_made": summary.num_made,
        "seconds": summary.seconds,
        "means": {score: summary.mean(score) for score in _SCORES},
        "missing": [{name: getattr(record, name) for name in _REASON} for record in missing],
    }


def answer_flow(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify flow``: estimate scene flow between two point files, or of a recording."""
    config = config_of(options)
    asks_for_sweeps = options.all or options.keys is not None
    if options.target is None or options.data is not None or asks_for_sweeps:
        yield from _flow_of_recording(options, config)
        return
    if options.format is not None:
        raise InputError(f"--format {options.format}: of recordings, got two point files")
    out = options.out or Path("densify-out/flow.npz")
    check_new_file(out, options.overwrite, ".npz")
    source, target = read_points(Path(options.source)), read_points(options.target)
    field = estimate_flow(source, target, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, flow_npz(field))
    num_moving = int(field.moving.sum())
    facts = {"num_points": len(source), "num_moving": num_moving}
    yield Answer(f"{len(source):,} points, {num_moving:,} moving", facts, [out])


def read_points(path: Path) -> Float:
    """Return the (N,3) float64 points of a file in metres, in the order of the file."""
    columns = read_table(path)
    if missing := [name for name in "xyz" if name not in columns]:
        raise InputError(
            f"{path}: no column {missing[0]}: got {', '.join(columns)}, expected x, y and z"
        )
    points = np.column_stack([columns[name].astype(np.float64) for name in "xyz"])
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of {len(points)} points are not finite, the first in row "
            f"{bad[0]}; remove them"
        )
    return points


def _flow_of_recording(options: argparse.Namespace, config: Config) -> Iterator[Answer]:
    """Write the flow of a recording's sweeps, and yield their number and folders."""
    specs = [spec for spec in (options.source, options.data) if spec is not None]
    if options.target is not None or len(specs) != 1 or options.all == (options.keys is not None):
        raise InputError(
            "densify flow: expected SOURCE and TARGET, two point files, or a recording with either "
            "--all or --keys A:B[:S]; see densify flow --help"
        )
    spec = specs[0]
    sequence = open_sequence(spec)
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec)
    frames = selected_frames(sequence, options.keys)
    folders: dict[Path, None] = {}
    failures: dict[int, Exception] = {}
    num_moving = 0
    with (
        progress_on_stderr() as progress,
        flow_writer(options.format or "npz", sequence, out, frames, options.overwrite) as write,
    ):
        for frame, flow in flow_steps(sequence, frames, config, progress):
            if isinstance(flow, Exception):
                failures[frame] = flow
                continue
            folders[write(frame, flow)] = None
            num_moving += sum(int(field.moving.sum()) for field in flow.steps.values())
    num_done = len(frames) - len(failures)
    facts = {"num_sweeps": num_done, "num_moving": num_moving}
    yield Answer(f"{num_done:,} sweeps, {num_moving:,} points moving", facts, [*folders])
    raise_failures(failures, len(frames), "sweep")


def answer_labels(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify labels``: write the flow of each sweep to the next, if both have boxes."""
    config = resolve(options.config, ["register.source=dataset", *(options.set or [])])
    sequence = open_sequence(recording_of(options))
    frames = selected_frames(sequence, options.keys)
    failures: dict[int, Exception] = {}
    num_done = num_points = num_moving = num_sure = 0
    with progress_on_stderr() as progress:
        for frame, label in label_sweeps(sequence, frames, config, progress):
            if not isinstance(label, Label):
                failures[frame] = label
                continue
            write_label(options.out, label, options.overwrite)
            num_done += 1
            num_points += len(label.sure)
            num_sure += int(label.sure.sum())
            num_moving += int(label.field.moving.sum())
    if not num_done and not failures:
        raise InputError(
            f"--data {recording_of(options)}: none of {len(frames)} sweeps has boxes and is "
            f"followed by one that has; choose others by --keys"
        )
    share = num_sure / max(num_points, 1)
    facts = {"num_sweeps": num_done, "num_moving": num_moving, "share_valid": share}
    text = f"{num_done:,} sweeps, {num_moving:,} points moving, {100 * share:.1f} % valid"
    yield Answer(text, facts, [options.out] if num_done else [])
    raise_failures(failures, len(frames), "sweep")


def answer_train_flow(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify train flow``: train a network and write its model file."""
    from densify.learning.training import Training, train  # loads torch

    check_new_file(options.out, options.overwrite)
    data, steps = tuple(recordings_of(options, default="streets")), options.steps
    training = Training(data, steps, options.teacher, options.seed, options.device)
    with progress_on_stderr() as progress:
        loss = train(training, options.out, progress)
    yield Answer(
        f"{steps:,} steps, loss {loss:.4g}", {"num_steps": steps, "loss": loss}, [options.out]
    )


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
