# SPDX-License-Identifier: MIT
"""``densify train flow``: a network for scene flow."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import (
    add_overwrite,
    add_recording,
    add_verb,
    natural,
    recordings_of,
    sentence,
)
from densify.cli.progress import progress_on_stderr
from densify.config.errors import InputError


def add(commands: Any) -> None:
    """Add the options of ``train flow``."""
    about = "train a network for scene flow; a trained one is the engine network:MODEL"
    parser = commands.add_parser("train", help=about, description=sentence(about))
    kinds = parser.add_subparsers(title="trainings", metavar="WHAT", required=True)
    flow = add_verb(
        kinds,
        "flow",
        answer,
        "train a network for scene flow, with labels or without",
        "SPEC may also be streets[?sensor=NAME], the default: a new street for every clip of 7 "
        "sweeps. Teachers: objective (the published one, without labels), engine (this package's "
        "engine makes the labels), truth (where the recording has some: streets). Ctrl-C or a kill "
        "loses at most 50 steps: go on with --resume.",
    )
    add_recording(flow, several=True)
    flow.add_argument(
        "--out", metavar="MODEL", type=Path, required=True, help="the model; MODEL.png: its loss"
    )
    add_overwrite(flow)
    teachers, devices = ("objective", "engine", "truth"), ("auto", "cpu", "cuda")
    flow.add_argument("--teacher", choices=teachers, default="objective", help="(objective)")
    steps = "train on N pairs of sweeps"
    flow.add_argument("--steps", type=natural, required=True, metavar="N", help=steps)
    seed = "of the first weights and the choice of sweeps (default: 0)"
    flow.add_argument("--seed", type=natural, default=0, metavar="N", help=seed)
    resume = "go on from MODEL.checkpoint of a stopped training"
    flow.add_argument("--resume", action="store_true", help=resume)
    flow.add_argument("--device", choices=devices, default="auto", help="(default: auto)")


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Train a network for scene flow."""
    from densify.learning.training import Training, train

    if options.out.exists() and not options.overwrite:
        raise InputError(f"{options.out}: there already, kept; give --overwrite to replace it")
    training = Training(
        data=tuple(recordings_of(options, default="streets")),
        teacher=options.teacher,
        seed=options.seed,
        steps=options.steps,
        device=options.device,
    )
    smooth = 0.0
    with progress_on_stderr(lines=True) as show:

        def report(num_steps: int, done: float, loss: float) -> None:
            nonlocal smooth
            smooth = loss if num_steps == 1 or not smooth else 0.95 * smooth + 0.05 * loss
            show("train", min(100, round(100 * done)), 100, f"{num_steps} steps, loss {smooth:.4g}")

        trained = train(training, options.out, options.resume, report)
    text = f"{training.steps:,} steps, loss {trained.loss:.4g}"
    facts = {"num_steps": training.steps, "loss": trained.loss}
    yield Answer(text, facts, trained.files)
