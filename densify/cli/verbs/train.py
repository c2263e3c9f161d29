# SPDX-License-Identifier: MIT
"""``densify train flow``: a network for scene flow."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    check_new_file,
    natural,
    option,
    recordings_of,
)
from densify.cli.screen import Answer, progress_on_stderr


def add(commands: Any) -> None:
    """Add the options of ``train flow``."""
    about = "train a network for scene flow; a trained one is the engine network:MODEL"
    parser = add_verb(commands, "train", None, about)
    flow = add_verb(
        parser.add_subparsers(title="trainings", metavar="WHAT", required=True),
        "flow",
        answer,
        "train a network for scene flow, with labels or without",
        "SPEC may also be streets[?sensor=NAME], the default: a new street for every clip of 7 "
        "sweeps. Teachers: objective (the published one, without labels), engine (this package's "
        "engine makes the labels), truth (where the recording has some: streets).",
    )
    add_recording(flow, several=True)
    option(flow, "--out MODEL", "the model", type=Path, required=True)
    add_common(flow, "overwrite")
    teachers, devices = ("objective", "engine", "truth"), ("auto", "cpu", "cuda")
    flow.add_argument("--teacher", choices=teachers, default="objective", help="(objective)")
    option(flow, "--steps N", "train on N pairs of sweeps", type=natural, required=True)
    seed = "of the first weights and the choice of sweeps (default: 0)"
    option(flow, "--seed N", seed, type=natural, default=0)
    flow.add_argument("--device", choices=devices, default="auto", help="(default: auto)")


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Train a network for scene flow."""
    from densify.learning.training import Training, train

    check_new_file(options.out, options.overwrite)
    training = Training(
        data=tuple(recordings_of(options, default="streets")),
        teacher=options.teacher,
        seed=options.seed,
        steps=options.steps,
        device=options.device,
    )
    with progress_on_stderr() as show:
        loss = train(training, options.out, show)
    text = f"{training.steps:,} steps, loss {loss:.4g}"
    facts = {"num_steps": training.steps, "loss": loss}
    yield Answer(text, facts, [options.out])
