# SPDX-License-Identifier: MIT
"""``densify view``: a finished run live, in rerun's viewer."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_camera, add_verb, natural

_PORT = 9876  # rerun's own


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "view",
        answer,
        "a run, or keys of a drive, in rerun's viewer: cloud, sweeps, images and movers over time",
        "Needs pip install 'densify[rerun]' and a screen. Trails of registration alone are there "
        "too, hidden at first. densify export --to rrd writes the same as a file.",
    )
    parser.add_argument(
        "place",
        metavar="DIR",
        type=Path,
        help="folder of one key, such as densify-out/000120, or of several of a drive",
    )
    parser.add_argument(
        "--port",
        type=natural,
        default=_PORT,
        metavar="N",
        help="of a viewer that is open already; a new one is opened if none listens there "
        f"(default: {_PORT})",
    )
    add_camera(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Show it, and leave the viewer open."""
    from densify.outputs.export.finished_run import finished_runs
    from densify.outputs.export.rrd import show

    runs = finished_runs(options.place, chosen=options.cameras)
    show(runs, options.port)
    keys = [run.key for run in runs]
    yield Answer(f"shown: key {', '.join(map(str, keys))}", {"keys": keys})
