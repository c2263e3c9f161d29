# SPDX-License-Identifier: MIT
"""``densify report``: pages to look at."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_overwrite, add_verb


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "report",
        answer,
        "one self-contained page to look at a run, a comparison or a training set in a browser",
        "Of a key: the image with every map, depth under the pointer, what a least confidence "
        "leaves, the cloud in 3-D, scores and costs, in one HTML file of 12 MB at most that needs "
        "no network. "
        "Files that are missing or damaged are named on it. Of a training set: a table of every "
        "key with its scores, what was put aside and why.",
    )
    parser.add_argument(
        "place",
        metavar="DIR",
        type=Path,
        help="folder of one key, such as densify-out/000120, one of several, or a training set",
    )
    parser.add_argument(
        "--out",
        metavar="FILE.html",
        type=Path,
        help="(default: DIR/report.html, and compare.html of a comparison)",
    )
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """A page of what is in a folder."""
    from densify.dataset.report import write_report

    paths = write_report(options.place, options.out, options.overwrite)
    yield Answer(files=paths)
