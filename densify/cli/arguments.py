# SPDX-License-Identifier: MIT
"""The command line as a whole; each verb has its options (`densify.cli.verbs`). Imports nothing
heavy, so that help answers at once."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from densify import __version__
from densify.cli.bench_arguments import add_bench
from densify.cli.verbs import (
    compare,
    completion,
    dataset,
    doctor,
    evaluate,
    export,
    flow,
    info,
    labels,
    report,
    run,
    simulate,
    train,
    view,
)
from densify.config.errors import brief

_VERBS = (
    run,
    compare,
    dataset,
    flow,
    train,
    labels,
    info,
    doctor,
    simulate,
    export,
    report,
    view,
    evaluate,
    completion,
)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Options of one command; ``options.verb(options)`` runs it, ``options.command_line`` is the
    parser of all of them. Exits with 2 on a bad argument."""
    parser = _command_line()
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "" in given:  # an empty path would be the current folder
        before = " ".join(given[: given.index("")][-1:])
        parser.error(f"got an empty argument after {before!r}; is a shell's variable not set?")
    return parser.parse_args(given)


def _command_line() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="densify",
        description="Dense depth maps from lidar recordings, with the moving objects kept sharp.",
        epilog="Exit codes: 0 done, 1 the computation failed, 2 bad input, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"densify {__version__}")
    commands = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    for verb in _VERBS:
        verb.add(commands)
    add_bench(commands)
    parser.set_defaults(command_line=parser)
    return parser


class _Parser(argparse.ArgumentParser):
    """Complains in one line and takes no abbreviated options, which would break with new ones."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def _print_message(self, message: str, file: Any = None) -> None:
        """As argparse has it, but where it cannot be written that is said."""
        if message:
            print(message, end="", file=file or sys.stderr)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"densify: {brief(message)}; see {self.prog} --help\n")
