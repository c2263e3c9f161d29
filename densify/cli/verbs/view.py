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
    """Add its options."""
    parser = add_verb(
        commands,
        "view",
        answer,
        "a run, or keys of a drive, live: cloud, sweeps, images, depth and objects over time",
        "Needs a screen, and pip install 'densify[rerun]'. densify export --to rrd writes the same "
        "as a file; densify report needs nothing but a browser.",
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
        help="of a rerun viewer that is open already; a new one is opened if none listens there "
        f"(default: {_PORT})",
    )
    add_camera(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Show it. rerun's viewer stays open."""
    from densify.outputs.export import rrd
    from densify.outputs.export.finished_run import finished_runs

    runs = finished_runs(options.place, cameras=options.cameras)
    rrd.show(runs, options.port)
    keys = [run.key for run in runs]
    yield Answer(f"shown: key {', '.join(map(str, keys))}", {"keys": keys})
