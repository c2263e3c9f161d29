# SPDX-License-Identifier: MIT
"""What a command shows: answers on stdout; log lines and the one error on stderr."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import warnings
from collections.abc import Iterable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from types import TracebackType
from typing import Any

from densify.cli.answer import Answer
from densify.config.errors import brief

_SCHEMA = 1
"""Version of what ``--json`` prints; grows when a key changes its meaning or goes."""


class Screen:
    """Shows what one command says while it is entered: as text, as one JSON object at the end
    (``--json``), or nothing but errors (``--quiet``)."""

    def __init__(self) -> None:
        self._json = self._quiet = False
        self._facts: dict[str, Any] = {}
        self._lines = _Lines()
        self._left = ExitStack()

    def heed(self, options: argparse.Namespace) -> None:
        """Take ``--json`` and ``--quiet`` of a command that has them."""
        self._json = getattr(options, "json", False)
        self._quiet = getattr(options, "quiet", False)
        if self._quiet:
            self._lines.least_shown = logging.ERROR
            logging.getLogger("densify.progress").setLevel(logging.ERROR)
        self._facts = {"schema": _SCHEMA, "verb": options.name, "files": [], "open_first": []}

    def show(self, answer: Answer) -> None:
        """Print it, or keep it for the end."""
        if self._json:
            files = {"files": answer.files, "open_first": [*answer.first]}
            for name, value in {**answer.facts, **files}.items():
                joined = isinstance(value, list | tuple) and name in self._facts
                self._facts[name] = [*self._facts[name], *value] if joined else value
        elif not self._quiet:
            with _above_bars():
                for line in answer.lines():
                    print(line)
                sys.stdout.flush()

    def end(self, exit_code: int, error: str | None = None) -> int:
        """Say what went wrong, and with ``--json`` all there is to say; gives the code back."""
        if error is not None:
            logging.getLogger("densify").error("%s", error)
        if self._json:
            outcome = {"exit_code": exit_code, "error": error, "warnings": self._lines.warnings}
            self._print_json({**self._facts, **outcome})
        return exit_code

    def _print_json(self, facts: dict[str, Any]) -> None:
        from densify.outputs.plain import plain

        print(json.dumps(plain(facts), indent=1, allow_nan=False, default=str))
        sys.stdout.flush()

    def __enter__(self) -> Screen:
        """The package's logger writes to stderr; what takes long, on a terminal or where the level
        of ``densify.progress`` says so."""
        log, progress = logging.getLogger("densify"), logging.getLogger("densify.progress")
        before = log.level, log.propagate, progress.level
        log.addHandler(self._lines)
        log.setLevel(logging.INFO)
        log.propagate = False
        if not progress.level:
            progress.setLevel(logging.INFO if sys.stderr.isatty() else logging.WARNING)

        def undo() -> None:
            log.removeHandler(self._lines)
            log.setLevel(before[0])
            log.propagate = before[1]
            progress.setLevel(before[2])

        self._left.callback(undo)
        self._left.enter_context(warnings.catch_warnings())
        warnings.showwarning = _log_warning  # type: ignore[assignment]
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._left.close()


class _Lines(logging.Handler):
    """One line per record, printed above a progress bar if there is one; keeps the warnings."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.least_shown = logging.INFO
        self.warnings: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = brief(" ".join(record.getMessage().split()))
        if record.levelno == logging.WARNING:
            self.warnings.append(text)
        if record.levelno < self.least_shown:
            return
        line = f"densify: {'warning: ' if record.levelno == logging.WARNING else ''}{text}"
        with suppress(OSError, ValueError), _above_bars():  # full or closed: nobody to tell
            print(line, file=sys.stderr, flush=True)


def _above_bars() -> AbstractContextManager[None]:
    """Progress bars go away within the block."""
    bars = sys.modules.get("tqdm")
    return nullcontext() if bars is None else bars.tqdm.external_write_mode(sys.stderr)


def _log_warning(message: Warning | str, category: type[Warning], *where: Any) -> None:
    """What numpy and others warn of is for who mends this package."""
    logging.getLogger("densify").debug("%s: %s (%s:%s)", category.__name__, message, *where[:2])


def tell_doubts(doubts: Iterable[tuple[str, str, int]], most: int = 20) -> None:
    """Say each doubt once, at the end, what holds for most keys first.

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
