# SPDX-License-Identifier: MIT
"""``densify completion``: what a shell needs to complete commands of densify."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_verb

_SHELLS = ("bash", "zsh", "fish", "tcsh")


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "completion",
        answer,
        "the shell's completion of verbs, options and files",
        'bash: add  eval "$(densify completion bash)"  to ~/.bashrc; zsh: densify completion zsh > '
        "_densify in a folder of $fpath; fish: densify completion fish > "
        "~/.config/fish/completions/densify.fish",
    )
    parser.add_argument("shell", choices=_SHELLS, help="whose completion")


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """The script, for all verbs and options there are."""
    import shtab

    _complete_paths(options.command_line, shtab.FILE)
    script = shtab.complete(options.command_line, shell=options.shell)
    yield Answer(script, {"script": script})


def _complete_paths(parser: argparse.ArgumentParser, files: Any) -> None:
    """Tell where files and folders are expected."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                _complete_paths(verb, files)
        elif action.type is Path or action.dest == "data":
            action.complete = files  # type: ignore[attr-defined]
