# SPDX-License-Identifier: MIT
"""A progress bar on stderr, or a line now and then where stderr is no terminal."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from densify.geometry.types import Progress

_LINE_EVERY_S = 60.0
_LAYOUT = "{desc:<10} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"


@contextmanager
def progress_on_stderr() -> Iterator[Progress]:
    """Yield a function that shows that ``done`` of ``total`` parts of a stage are done."""
    if not sys.stderr.isatty():
        yield _log_now_and_then()
        return
    from tqdm import tqdm

    with tqdm(total=1, file=sys.stderr, leave=False, bar_format=_LAYOUT) as bar:

        def show(stage: str, done: int, total: int) -> None:
            if done < bar.n or total != bar.total:  # another stage
                bar.reset(total)
                bar.initial = done
            bar.n = done
            bar.set_description(stage)

        yield show


def _log_now_and_then() -> Progress:
    shown_s = time.monotonic()

    def show(stage: str, done: int, total: int) -> None:
        nonlocal shown_s
        if time.monotonic() > shown_s + _LINE_EVERY_S:
            shown_s = time.monotonic()
            logging.getLogger("densify").info("%s: %d of %d", stage, done, total)

    return show
