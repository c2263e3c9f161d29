# SPDX-License-Identifier: MIT
"""Answer ``densify train flow``: a network for scene flow."""

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
    about = "train a network for scene flow"
    parser = add_verb(commands, "train", None, about)
    flow = add_verb(
        parser.add_subparsers(title="trainings", metavar="WHAT", required=True),
        "flow",
        answer,
        "train a network for scene flow, with or without labels",
        "densify run --flow network:MODEL uses the trained network. SPEC may also be "
        "streets[?sensor=NAME], the default: a new simulated street for every clip of 7 sweeps.",
    )
    add_recording(flow, several=True)
    option(flow, "--out MODEL", "file of the model", type=Path, required=True)
    add_common(flow, "overwrite")
    teachers, devices = ("objective", "engine", "truth"), ("auto", "cpu", "cuda")
    about = (
        "objective: the published loss (default); engine: this package's flow; truth: exact flow"
    )
    flow.add_argument("--teacher", choices=teachers, default="objective", help=about)
    option(flow, "--steps N", "number of pairs of sweeps to train on", type=natural, required=True)
    seed = "seed of the first weights and of the choice of sweeps (default: 0)"
    option(flow, "--seed N", seed, type=natural, default=0)
    flow.add_argument(
        "--device", choices=devices, default="auto", help="device to train on (default: auto)"
    )


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
