# SPDX-License-Identifier: MIT
"""Answer ``densify flow`` and ``densify labels``: scene flow by estimation or tracked boxes."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import densify
from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    check_new_file,
    config_of,
    key_range,
    option,
    recording_of,
    sliced,
)
from densify.cli.screen import Answer, progress_on_stderr
from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError

if TYPE_CHECKING:
    from densify.geometry.types import Float


def add_flow(commands: Any) -> None:
    """Add the options of ``flow``."""
    parser = add_verb(
        commands,
        "flow",
        answer_flow,
        "estimate scene flow of a recording or between two point files",
        "Two point files in one coordinate frame (.npy, .npz, .txt, .csv, .bin, .pcd, .ply, .las, "
        ".laz) give one .npz, with a row for each row of SOURCE: 'residual_flow' (N,3) metres, "
        "'moving' (N,) bool, 'instance' (N,) int32 (-1 none), 'lost' (N,) bool. A recording, with "
        "--all or --keys, gives the flow of each sweep to the next one. npz writes "
        "DIR/FRAME_NEXT.npz for --flow npz:DIR. av2 writes DIR/NAME/STAMP.feather of the Argoverse "
        "2 scene flow challenge. opensceneflow writes DIR/NAME.h5. semantickitti writes "
        "DIR/sequences/NAME/predictions/FRAME.label, 251 moving and 9 static. doc-depth writes "
        "DIR/NAME, the poses and classes that DOC-Depth renders.",
    )
    parser.add_argument(
        "source", metavar="SOURCE|SPEC", nargs="?", help="earlier points, or a recording"
    )
    parser.add_argument("target", metavar="TARGET", type=Path, nargs="?", help="later points")
    option(parser, "--data SPEC", "the recording, as an option")
    option(parser, "--all", "take every sweep of the recording")
    option(parser, "--keys A:B[:S]", "take sweeps A to B-1, every S-th", type=key_range)
    formats = ("npz", "av2", "opensceneflow", "semantickitti", "doc-depth")
    parser.add_argument(
        "--format", choices=formats, help="form of a recording's flow (default: npz)"
    )
    option(
        parser,
        "--out F.npz|DIR",
        "file or folder (default: densify-out/flow.npz, densify-out/RECORDING)",
        type=Path,
    )
    add_common(parser, "config", "overwrite")


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
    from densify.outputs.atomic import write_file
    from densify.outputs.flow_writers import flow_npz

    out = options.out or Path("densify-out/flow.npz")
    check_new_file(out, options.overwrite, ".npz")
    source, target = read_points(Path(options.source)), read_points(options.target)
    field = densify.estimate_flow(source, target, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, flow_npz(field))
    num_moving = int(field.moving.sum())
    facts = {"num_points": len(source), "num_moving": num_moving}
    return Answer(f"{len(source):,} points, {num_moving:,} moving", facts, [out])


def read_points(path: Path) -> Float:
    """Return the (N,3) float64 points of a file in metres, in the order of the file."""
    import numpy as np

    from densify.readers.point_files import read_table

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
    from densify.outputs.flow_writers import flow_writer
    from densify.outputs.recording_folder import check_recording, default_folder
    from densify.pipeline.run import flow_steps
    from densify.readers import open_sequence

    sequence = open_sequence(spec)
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec)
    frames = sliced(sequence, options.keys)
    folders: dict[Path, None] = {}
    failed: dict[int, Exception] = {}
    num_moving = 0
    with (
        progress_on_stderr() as progress,
        flow_writer(options.format or "npz", sequence, out, frames, options.overwrite) as write,
    ):
        for frame, flow in flow_steps(sequence, frames, config, progress):
            if isinstance(flow, Exception):
                failed[frame] = flow
                continue
            folders[write(frame, flow)] = None
            num_moving += sum(int(field.moving.sum()) for field in flow.steps.values())
    num_made = len(frames) - len(failed)
    facts = {"num_sweeps": num_made, "num_moving": num_moving}
    yield Answer(f"{num_made:,} sweeps, {num_moving:,} points moving", facts, [*folders])
    _raise_failed(failed, len(frames))


def _raise_failed(failed: Mapping[int, Exception], num: int) -> None:
    if failed:
        told = "; ".join(f"sweep {frame}: {error}" for frame, error in failed.items())
        raise ComputationError(f"{len(failed)} of {num} sweeps not made: {told}")


def add_labels(commands: Any) -> None:
    """Add the options of ``labels``."""
    parser = add_verb(
        commands,
        "labels",
        answer_labels,
        "make scene flow labels from tracked boxes and poses",
        "Writes a flow file for each sweep to the next one. Its array 'valid' (N,) bool is False "
        "for points in two boxes, just outside a box, at the bottom of a moving box, in a box that "
        "the next sweep lacks, and where nobody drew boxes. Poses are those of the recording; "
        "--set register.source=kiss-icp estimates them.",
    )
    add_recording(parser)
    option(parser, "--out DIR", "folder for the flow files", type=Path, required=True)
    option(
        parser, "--keys A:B[:S]", "take sweeps A to B-1, every S-th (default: all)", type=key_range
    )
    add_common(parser, "config", "overwrite")


def answer_labels(options: argparse.Namespace) -> Iterator[Answer]:
    """Label every sweep."""
    config = resolve(options.config, ["register.source=dataset", *options.overrides])
    from densify.learning.labels import Label, label_sweeps, write_label
    from densify.readers import open_sequence

    sequence = open_sequence(recording_of(options))
    frames = sliced(sequence, options.keys)
    failed: dict[int, Exception] = {}
    num_made = num_points = num_moving = num_sure = 0
    with progress_on_stderr() as progress:
        for frame, label in label_sweeps(sequence, frames, config, progress):
            if not isinstance(label, Label):
                failed[frame] = label
                continue
            write_label(options.out, label, options.overwrite)
            num_made += 1
            num_points += len(label.sure)
            num_sure += int(label.sure.sum())
            num_moving += int(label.field.moving.sum())
    if not num_made and not failed:
        raise InputError(
            f"--data {recording_of(options)}: none of {len(frames)} sweeps has boxes and is "
            f"followed by one that has; choose others by --keys"
        )
    share = num_sure / max(num_points, 1)
    facts: dict[str, Any] = {"num_sweeps": num_made, "num_moving": num_moving, "share_valid": share}
    text = f"{num_made:,} sweeps, {num_moving:,} points moving, {100 * share:.1f} % valid"
    yield Answer(text, facts, [options.out] if num_made else [])
    _raise_failed(failed, len(frames))
