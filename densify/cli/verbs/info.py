# SPDX-License-Identifier: MIT
"""``densify info``: what a recording holds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import DATA_HELP, add_verb


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands, "info", answer, "what a recording holds: frames, rate, cameras, stamps, poses"
    )
    parser.add_argument("--data", metavar="SPEC", default="street", help=DATA_HELP)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """What a recording holds."""
    from densify.readers import open_sequence
    from densify.readers.describe import findings, in_lines

    sequence = open_sequence(options.data)
    lines, frames, cameras = findings(sequence), [*sequence.frames], [*sequence.cameras]
    yield Answer(in_lines(lines), {"recording": dict(lines), "frames": frames, "cameras": cameras})
