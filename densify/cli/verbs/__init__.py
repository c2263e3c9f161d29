# SPDX-License-Identifier: MIT
"""Collect the verbs, and parse the command line.

A verb's module has ``add``, which adds its options, and ``answer``, which yields answers. It
imports heavy packages only when it runs, and help answers at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from densify.cli.verbs import bench, dataset, evaluate, finished, flow, recordings, run, train
from densify.config.errors import brief, did_you_mean
from densify.version import __version__

_USUAL = (
    *(recordings.add_info, recordings.add_doctor, run.add_run, run.add_compare, dataset.add),
    *(finished.add_report, finished.add_export),
)
_MORE = (
    *(finished.add_view, flow.add_flow, evaluate.add, recordings.add_simulate, flow.add_labels),
    *(train.add, bench.add),
)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options of one command, which ``options.verb(options)`` runs; or exit with 2."""
    parser = _command_line()
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "" in given:  # an empty path would be the current folder
        before = " ".join(given[: given.index("")][-1:])
        parser.error(f"got an empty argument after {before!r}; is a shell's variable not set?")
    return parser.parse_args(given)


def _command_line() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="densify",
        usage="densify VERB [SPEC] [options]",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"densify {__version__}")
    commands = parser.add_subparsers(
        prog="densify", metavar="VERB", required=True, help=argparse.SUPPRESS
    )
    for add in (*_USUAL, *_MORE):
        add(commands)
    abouts = [f"  {name:<10}{verb.description}" for name, verb in commands.choices.items()]
    usual, more = "\n".join(abouts[: len(_USUAL)]), "\n".join(abouts[len(_USUAL) :])
    parser.description = (
        "Dense depth maps from lidar recordings, with the moving objects kept sharp.\n\n"
        f"verbs:\n{usual}\n\nmore:\n{more}"
    )
    parser.epilog = (
        "densify VERB --help explains a verb. A first try: densify run --key 120\n"
        "Exit codes: 0 done, 1 the computation failed, 2 bad input, 130 interrupted."
    )
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser with one-line errors and suggested words, which refuses abbreviated options."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the arguments. Refuse an unknown option here, where the verb is known."""
        found, others = super().parse_known_args(args, namespace)
        unknown = next((text for text in others if text.startswith("--")), None)
        if unknown is not None:
            name = unknown.partition("=")[0]
            hint = did_you_mean(name, self._option_string_actions)
            self.error(f"unknown option {name}; {hint}".rstrip("; "))
        return found, others

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a word that is not among the choices, and suggest one."""
        if action.choices is not None and value not in action.choices:
            expected = f"expected one of {', '.join(map(str, action.choices))}"
            hint = did_you_mean(str(value), action.choices)
            raise argparse.ArgumentError(action, f"got {value!r}; {hint}{expected}")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print the message, and let errors of writing through."""
        if message:
            print(message, end="", file=file or sys.stderr)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"densify: {brief(message)}; see {self.prog} --help\n")
