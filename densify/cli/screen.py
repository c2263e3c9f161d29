# SPDX-License-Identifier: MIT
"""Answers on stdout, log lines and the one error on stderr."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

from densify.cli.answer import Answer
from densify.config.errors import brief

_SCHEMA = 1
"""Version of what ``--json`` prints; grows when a key changes its meaning or goes."""


class Screen(logging.Handler):
    """Shows what one command says: text, or one JSON object at the end. As a handler of the log it
    prints one line per record, above a progress bar if there is one."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._json = False
        self._facts: dict[str, Any] = {}
        self._warnings: list[str] = []

    def heed(self, options: argparse.Namespace) -> None:
        """Take ``--json`` of a command."""
        self._json = options.json
        self._facts = {"schema": _SCHEMA, "verb": options.name, "files": [], "open_first": []}

    def show(self, answer: Answer) -> None:
        """Print the answer, or keep it for the end."""
        if self._json:
            files = {"files": answer.files, "open_first": [*answer.first]}
            for name, value in {**answer.facts, **files}.items():
                joined = isinstance(value, list | tuple) and name in self._facts
                self._facts[name] = [*self._facts[name], *value] if joined else value
            return
        with _above_bars():
            for line in answer.lines():
                print(line)
            sys.stdout.flush()

    def end(self, exit_code: int, error: str | None = None) -> int:
        """Say what went wrong, print the JSON object if asked for, and return the exit code."""
        if error is not None:
            logging.getLogger("densify").error("%s", error)
        if self._json:
            from densify.outputs.plain import plain

            outcome = {"exit_code": exit_code, "error": error, "warnings": self._warnings}
            facts = plain({**self._facts, **outcome})
            print(json.dumps(facts, indent=1, allow_nan=False, default=str), flush=True)
        return exit_code

    def emit(self, record: logging.LogRecord) -> None:
        """Print a line, and keep it if it is a warning."""
        text = brief(" ".join(record.getMessage().split()))
        is_warning = record.levelno == logging.WARNING
        if is_warning:
            self._warnings.append(text)
        with suppress(OSError, ValueError), _above_bars():  # stderr may be closed or full
            print(f"densify: {'warning: ' * is_warning}{text}", file=sys.stderr, flush=True)


@contextmanager
def screen() -> Iterator[Screen]:
    """Send the package's log to a new screen; that of ``densify.progress`` only on a terminal,
    unless its level is set. Warnings of numpy and others, for developers, are debug messages."""
    log, progress = logging.getLogger("densify"), logging.getLogger("densify.progress")
    before, shown = (log.level, log.propagate, progress.level), Screen()
    log.addHandler(shown)
    log.setLevel(logging.INFO)
    log.propagate = False
    if not progress.level:
        progress.setLevel(logging.INFO if sys.stderr.isatty() else logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: log.debug("%s", message)  # type: ignore
            yield shown
    finally:
        log.removeHandler(shown)
        log.setLevel(before[0])
        log.propagate = before[1]
        progress.setLevel(before[2])


def _above_bars() -> AbstractContextManager[None]:
    """Hide progress bars within the block."""
    bars = sys.modules.get("tqdm")
    return nullcontext() if bars is None else bars.tqdm.external_write_mode(sys.stderr)


def tell_doubts(doubts: Iterable[tuple[str, str, int]], most: int = 20) -> None:
    """Log each warning once with its keys, the most frequent first.

    doubts: (warning, recording or "", key).
    """
    from densify.readers.timeline import format_frames

    log = logging.getLogger("densify")
    keys: dict[tuple[str, str], list[int]] = {}
    for warning, recording, key in doubts:
        keys.setdefault((warning, recording), []).append(key)
    ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
    for (warning, recording), found in ordered[:most]:
        log.warning("%s: %s", f"{recording} key {format_frames(found)}".lstrip(), warning)
    if len(ordered) > most:
        log.warning("... and %d more warnings, see run.yaml or the manifest", len(ordered) - most)
