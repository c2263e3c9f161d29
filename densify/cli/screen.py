# SPDX-License-Identifier: MIT
"""What goes to stderr: log lines and progress bars that don't run into each other."""

from __future__ import annotations

import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from densify.errors import brief

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from densify.dataset.make import Summary
    from densify.types import Progress

_LINE_EVERY_S = 30.0


class _LineHandler(logging.Handler):
    """One line per record; printed above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        level = "warning: " if record.levelno == logging.WARNING else ""
        line = f"densify: {level}{brief(' '.join(record.getMessage().split()))}"
        bars = sys.modules.get("tqdm")
        with suppress(OSError, ValueError):  # full or closed: there is nobody to tell
            if bars is None:
                print(line, file=sys.stderr, flush=True)
            else:
                bars.tqdm.write(line, file=sys.stderr)


def _log_warning(message: Warning | str, category: type[Warning], *where: Any) -> None:
    """What numpy and others warn of is for who mends this package."""
    logging.getLogger("densify").debug("%s: %s (%s:%s)", category.__name__, message, *where[:2])


@contextmanager
def logging_to_stderr() -> Iterator[logging.Logger]:
    """The package's logger writes to stderr inside the block; what takes long, on a terminal or
    where the level of ``densify.progress`` says so."""
    log, progress = logging.getLogger("densify"), logging.getLogger("densify.progress")
    handler, before = _LineHandler(), (log.level, log.propagate, progress.level)
    handler.setLevel(logging.INFO)
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    if not progress.level:
        progress.setLevel(logging.INFO if sys.stderr.isatty() else logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _log_warning  # type: ignore[assignment]
            yield log
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]
        progress.setLevel(before[2])


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


@contextmanager
def keys_on_stderr() -> Iterator[Callable[[Summary], None]]:
    """Keys done, rate, time left and scores so far: a bar on a terminal, else a line now and
    then."""
    from densify.cli.sets import set_scores

    if sys.stderr.isatty():
        from tqdm import tqdm

        layout = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} keys [{elapsed}, {desc}]"
        with tqdm(file=sys.stderr, bar_format=layout) as bar:

            def show(summary: Summary) -> None:
                bar.total, bar.n = summary.num_keys, len(summary.records)
                bar.set_description_str(f"{_pace(summary)}, {set_scores(summary)}")

            yield show
        return
    shown_s = time.monotonic()

    def tell(summary: Summary) -> None:
        nonlocal shown_s
        if time.monotonic() > shown_s + _LINE_EVERY_S:
            shown_s = time.monotonic()
            count = f"{len(summary.records)} of {summary.num_keys} keys"
            print(f"densify: {count}, {_pace(summary)}, {set_scores(summary)}", file=sys.stderr)

    yield tell


def _pace(summary: Summary) -> str:
    if not summary.num_made:
        return "the first is being made"
    left_s = summary.seconds_left or 0.0
    left = f"{left_s / 60:.0f} min" if left_s < 6000 else f"{left_s / 3600:.1f} h"
    return f"{summary.seconds / max(1, summary.num_made):.2f} s a key, {left} left"


def print_paths(paths: list[Path]) -> None:
    """One to a line, on stdout."""
    for path in paths:
        print(path)


def tell_doubts(doubts: Iterable[tuple[str, str, int]], most: int = 20) -> None:
    """At the end, each once, what holds for most keys first; doubts: (warning, recording or "",
    key)."""
    from densify.readers.files import format_frames

    log = logging.getLogger("densify")
    keys: dict[tuple[str, str], list[int]] = {}
    for warning, recording, key in doubts:
        keys.setdefault((warning, recording), []).append(key)
    ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
    for (warning, recording), found in ordered[:most]:
        log.warning("%s: %s", f"{recording} key {format_frames(found)}".lstrip(), warning)
    if len(ordered) > most:
        log.warning("... and %d more warnings, see run.yaml or the manifest", len(ordered) - most)
