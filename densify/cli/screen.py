# SPDX-License-Identifier: MIT
"""What goes to stderr: log lines and progress bars that don't run into each other."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from densify.types import Progress


class _LineHandler(logging.Handler):
    """One line per record; printed above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        level = "warning: " if record.levelno == logging.WARNING else ""
        line = f"densify: {level}{' '.join(record.getMessage().split())}"
        bars = sys.modules.get("tqdm")
        if bars is None:
            print(line, file=sys.stderr, flush=True)
        else:
            bars.tqdm.write(line, file=sys.stderr)


@contextmanager
def logging_to_stderr() -> Iterator[logging.Logger]:
    """The package's logger writes to stderr inside the block."""
    log = logging.getLogger("densify")
    handler, before = _LineHandler(), (log.level, log.propagate)
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield log
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]


@contextmanager
def progress_on_stderr() -> Iterator[Progress | None]:
    """One bar, renamed as the stages go by; None where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    layout = "{desc:<12} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}]"
    with tqdm(total=1, file=sys.stderr, leave=False, bar_format=layout) as bar:

        def show(stage: str, done: int, total: int) -> None:
            if bar.desc.rstrip(": ") != stage:
                bar.reset(total)
                bar.set_description(stage, refresh=False)
            bar.total, bar.n = total, done
            bar.refresh()

        yield show
