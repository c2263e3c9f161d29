# SPDX-License-Identifier: MIT
"""A progress bar on stderr."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

_LINE_EVERY_S = 30.0
_LAYOUT = (
    "{desc:<10} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
)


class Show(Protocol):
    """Shows that ``done`` of ``total`` parts of a stage are done. text: what else there is."""

    def __call__(self, stage: str, done: int, total: int, text: str = "", /) -> None: ...


@contextmanager
def progress_on_stderr(lines: bool = False) -> Iterator[Show]:
    """Yield a function that moves a bar, which begins anew with each stage.

    lines: log a line every 30 s where stderr is no terminal (else nothing is shown there).
    """
    is_shown = logging.getLogger("densify.progress").isEnabledFor(logging.INFO)
    if not (sys.stderr.isatty() and is_shown):
        yield _log_now_and_then() if lines else _show_nothing
        return
    from tqdm import tqdm

    with tqdm(total=1, file=sys.stderr, leave=False, bar_format=_LAYOUT) as bar:

        def show(stage: str, done: int, total: int, text: str = "", /) -> None:
            if bar.desc.rstrip(": ") != stage:
                bar.reset(total)
                bar.initial = done
                bar.set_description(stage, refresh=False)
            bar.total, bar.n = total, done
            bar.set_postfix_str(text)

        yield show


def _show_nothing(stage: str, done: int, total: int, text: str = "", /) -> None:
    """Show no progress."""


def _log_now_and_then() -> Show:
    shown_s = time.monotonic()

    def show(stage: str, done: int, total: int, text: str = "", /) -> None:
        nonlocal shown_s
        if time.monotonic() > shown_s + _LINE_EVERY_S:
            shown_s = time.monotonic()
            told = f"{stage}: {done} of {total}"
            logging.getLogger("densify").info("%s", f"{told}, {text}" if text else told)

    return show
