# SPDX-License-Identifier: MIT
"""``densify train flow``: a network for scene flow."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_overwrite, add_verb, natural, sentence
from densify.cli.progress import steps_on_stderr
from densify.config.errors import InputError


def add(commands: Any) -> None:
    """Its options."""
    about = "train a network for scene flow; a trained one is the engine network:MODEL"
    parser = commands.add_parser("train", help=about, description=sentence(about))
    kinds = parser.add_subparsers(title="trainings", metavar="WHAT", required=True)
    flow = add_verb(
        kinds,
        "flow",
        answer,
        "train a network for scene flow, with labels or without",
        "Teachers: objective (the published one, without labels), engine (this package's engine "
        "makes the labels), truth (where the recording has some: streets). Ctrl-C or a kill loses "
        "at most 50 steps: go on with --resume.",
    )
    flow.add_argument(
        "--out", metavar="MODEL", type=Path, required=True, help="the model; MODEL.png: its loss"
    )
    add_overwrite(flow)
    _add_lesson(flow)
    _add_course(flow)


def _add_lesson(flow: argparse.ArgumentParser) -> None:
    lesson = flow.add_argument_group("what is learned")
    lesson.add_argument(
        "--data",
        metavar="SPEC",
        action="append",
        help="a recording as everywhere, may be given several times; streets[?sensor=NAME]: a new "
        "street for every clip of 7 sweeps, never the same twice (default: streets)",
    )
    lesson.add_argument(
        "--teacher",
        choices=("objective", "engine", "truth"),
        default="objective",
        help="where the loss comes from (default: objective)",
    )
    lesson.add_argument(
        "--seed",
        type=natural,
        default=0,
        metavar="N",
        help="first weights, choice of sweeps (default: 0)",
    )


def _add_course(flow: argparse.ArgumentParser) -> None:
    course = flow.add_argument_group("how long, and where")
    course.add_argument(
        "--steps", type=natural, required=True, metavar="N", help="train on N pairs of sweeps"
    )
    course.add_argument(
        "--resume", action="store_true", help="go on from MODEL.checkpoint of a stopped training"
    )
    course.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="(default: auto)"
    )
    course.add_argument(
        "--workers",
        type=natural,
        default=1,
        metavar="N",
        help="processes that make sweeps ready beside the training; 0: none (default: 1)",
    )


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """A network for scene flow."""
    from densify.learning.training import Training, train

    if options.out.exists() and not options.overwrite:
        raise InputError(f"{options.out}: there already, kept; give --overwrite to replace it")
    training = Training(
        data=tuple(options.data or ["streets"]),
        teacher=options.teacher,
        seed=options.seed,
        steps=options.steps,
        device=options.device,
        num_workers=options.workers,
    )
    with steps_on_stderr() as report:
        trained = train(training, options.out, options.resume, report)
    text = f"{training.steps:,} steps, loss {trained.loss:.4g}"
    facts = {"num_steps": training.steps, "loss": trained.loss}
    yield Answer(text, facts, trained.files)
