# SPDX-License-Identifier: MIT
"""``densify labels``: scene flow from tracked boxes."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import (
    add_config_options,
    add_overwrite,
    add_verb,
    key_slice,
    positive,
    sliced,
)
from densify.cli.progress import progress_on_stderr
from densify.config import resolve
from densify.config.errors import ComputationError, InputError


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "labels",
        answer,
        "scene flow of every sweep to the next from tracked boxes and poses",
        "Flow files as --flow npz:DIR and bench flow --truth read them, with 'valid' (N,) bool: "
        "False in two boxes, just outside one, at the foot of one that moves, in a box that the "
        "next sweep lacks, and where nobody drew boxes. Poses are the recording's own (--set "
        "register.source=kiss-icp: estimated).",
    )
    parser.add_argument("--data", metavar="SPEC", required=True, help="a recording with boxes")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="for the flow files")
    parser.add_argument(
        "--keys", type=key_slice, metavar="A:B[:S]", help="sweeps A to B-1 (default: all)"
    )
    parser.add_argument(
        "--grown",
        type=positive,
        default=0.1,
        metavar="M",
        help="metres by which boxes grow on each side (default: 0.1)",
    )
    parser.add_argument(
        "--without-ground", action="store_true", help="points of the ground are not valid"
    )
    add_config_options(parser)
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Label every sweep."""
    given = ["register.source=dataset", *options.overrides]
    config = resolve(options.config, given)
    from densify.flow.boxes import BoxMargins
    from densify.learning.labels import Label, label_sweeps, write_label
    from densify.readers import open_sequence

    sequence = open_sequence(options.data)
    frames = list(sequence.frames)
    if options.keys is not None:
        frames = sliced(sequence, options.keys)
    failed: dict[int, Exception] = {}
    num_made = num_points = num_moving = num_sure = 0
    with progress_on_stderr() as progress:
        margins = BoxMargins(grown_m=options.grown)
        labels = label_sweeps(sequence, frames, config, margins, options.without_ground, progress)
        for frame, label in labels:
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
            f"--data {options.data}: none of {len(frames)} sweeps has boxes and is followed by one "
            f"that has; choose others by --keys"
        )
    share = num_sure / max(num_points, 1)
    facts: dict[str, Any] = {"num_sweeps": num_made, "num_moving": num_moving, "share_valid": share}
    sweeps = "sweep" if num_made == 1 else "sweeps"
    text = f"{num_made:,} {sweeps}, {num_moving:,} points moving, {100 * share:.1f} % valid"
    yield Answer(text, facts, [options.out] if num_made else [])
    if failed:
        told = "; ".join(f"sweep {frame}: {error}" for frame, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(frames)} sweeps not labelled: {told}")
