# SPDX-License-Identifier: MIT
"""Answer ``densify flow``, ``labels`` and ``train flow``: scene flow by several means."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from densify.cli.options import (
    check_new_file,
    config_of,
    raise_failures,
    recording_of,
    recordings_of,
    selected_frames,
)
from densify.cli.screen import Answer, progress_on_stderr
from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry.types import Float
from densify.learning.labels import Label, label_sweeps, write_label
from densify.outputs.atomic import write_file
from densify.outputs.flow_writers import flow_npz, flow_writer
from densify.outputs.recording_folder import check_recording, default_folder
from densify.pipeline.run import flow_steps
from densify.readers import open_sequence
from densify.readers.point_files import read_table


def answer_flow(options: argparse.Namespace) -> Iterator[Answer]:
    """Estimate scene flow between two point files, or of a recording."""
    config = config_of(options)
    asks_for_sweeps = options.all or options.keys is not None
    if options.target is not None and options.data is None and not asks_for_sweeps:
        if options.format is not None:
            raise InputError(f"--format {options.format}: of recordings, got two point files")
        yield _of_two_files(options, config)
        return
    specs = [spec for spec in (options.source, options.data) if spec is not None]
    if options.target is not None or len(specs) != 1 or options.all == (options.keys is not None):
        raise InputError(
            "densify flow: expected SOURCE and TARGET, two point files, or a recording with either "
            "--all or --keys A:B[:S]; see densify flow --help"
        )
    yield from _of_recording(specs[0], options, config)


def _of_two_files(options: argparse.Namespace, config: Config) -> Answer:
    out = options.out or Path("densify-out/flow.npz")
    check_new_file(out, options.overwrite, ".npz")
    source, target = read_points(Path(options.source)), read_points(options.target)
    field = estimate_flow(source, target, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, flow_npz(field))
    num_moving = int(field.moving.sum())
    facts = {"num_points": len(source), "num_moving": num_moving}
    return Answer(f"{len(source):,} points, {num_moving:,} moving", facts, [out])


def read_points(path: Path) -> Float:
    """Return the (N,3) float64 points of a file in metres, in the order of the file."""
    columns = read_table(path).columns
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


def _of_recording(spec: str, options: argparse.Namespace, config: Config) -> Iterator[Answer]:
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
    """Label every sweep."""
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
    """Train a network for scene flow."""
    from densify.learning.training import Training, train  # loads torch

    check_new_file(options.out, options.overwrite)
    training = Training(
        data=tuple(recordings_of(options, default="streets")),
        teacher=options.teacher,
        seed=options.seed,
        steps=options.steps,
        device=options.device,
    )
    with progress_on_stderr() as progress:
        loss = train(training, options.out, progress)
    text = f"{training.steps:,} steps, loss {loss:.4g}"
    yield Answer(text, {"num_steps": training.steps, "loss": loss}, [options.out])
