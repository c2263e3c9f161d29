# SPDX-License-Identifier: MIT
"""Bars on stderr: how far a command is, and the time that is left."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from densify.dataset.make import Summary
    from densify.geometry.types import Progress

_LINE_EVERY_S = 30.0
_TICK_S = 0.5

# What a key usually takes, stage by stage in their order, in seconds on two cores: a KITTI drive.
# Only their ratios matter. "maps" are what is made without flow, beside it, and the others; "held
# out" is what then follows for each method.
_FIRST_KEY_S = {
    "register": 3.8,
    "ground": 0.4,
    "flow": 9.2,
    "maps": 5.5,
    "held out": 2.0,
    "write": 2.3,
}
_NEXT_KEY_S = {
    "register": 0.0,
    "ground": 0.0,
    "flow": 2.0,
    "maps": 2.5,
    "held out": 2.0,
    "write": 2.3,
}
_PAPER_S = 40.0
_PART_OF = {"read": "register", "far": "flow", "project": "maps", "prior": "held out"}
_READING = 0.2
"""The share of registration that is reading."""
_SURE_AFTER_S = 4.0
"""So much of the usual work counts as done at the usual pace before there is anything to go by."""
_WAITS_AT = 0.95
"""The share of a stage at which the bar stays until the next one begins."""


class Course:
    """How far a command is that makes keys, from the stages it reports."""

    def __init__(
        self,
        engines: Sequence[str],
        num_keys: int = 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """engines: of scene flow, of each method, "" for those without. clock: seconds."""
        self._keys = [_usual_s(_FIRST_KEY_S, engines)]
        self._keys += [_usual_s(_NEXT_KEY_S, engines)] * (num_keys - 1)
        self._clock = clock
        self._start_s = self._since_s = clock()
        self._key = 0
        self._behind = 0.0  # of the key, in usual seconds
        self._until = self._keys[0]["register"]  # where the stage at work ends
        self._shown = 0.0
        self.stage = ""

    def step(self, stage: str, done: int, total: int) -> None:
        """What the pipeline reports. That a stage has ended counts when the next one begins, for
        some begin several times."""
        self.stage = stage
        key = self._keys[min(self._key, len(self._keys) - 1)]
        place = _PART_OF.get(stage, stage)
        if place not in key:
            return
        names = [*key]
        reached = sum(key[name] for name in names[: names.index(place)])
        until = reached + key[place]
        if stage == "read":
            reached += _READING * key[place] * done / max(total, 1)
        if reached > self._behind or until > self._until:
            self._behind, self._until = max(reached, self._behind), max(until, self._until)
            self._since_s = self._clock()

    def key_done(self) -> None:
        """The next key begins."""
        self._key += 1
        self._behind, self._since_s = 0.0, self._clock()
        self._until = 0.0 if self._key >= len(self._keys) else self._keys[self._key]["register"]

    def at(self) -> tuple[float, float]:
        """Now: the share that is done, which never falls, and the seconds that are left."""
        now_s = self._clock()
        totals = [sum(key.values()) for key in self._keys]
        behind = sum(totals[: self._key]) + self._behind
        pace = (self._since_s - self._start_s + _SURE_AFTER_S) / (behind + _SURE_AFTER_S)
        room = _WAITS_AT * max(self._until - self._behind, 0.0)
        behind += min((now_s - self._since_s) / pace, room)
        self._shown = max(self._shown, min(behind / sum(totals), 1.0))
        return self._shown, (1 - self._shown) * sum(totals) * pace


def _usual_s(stages: Mapping[str, float], engines: Sequence[str]) -> dict[str, float]:
    flow = stages["flow"] + _PAPER_S * engines.count("paper")
    return {**stages, "flow": flow, "held out": stages["held out"] * len(engines)}


@contextmanager
def course_on_stderr(course: Course) -> Iterator[None]:
    """One bar over all stages of all keys, on a terminal."""
    if not _shows():
        yield
        return
    from tqdm import tqdm

    layout = "{percentage:3.0f}%|{bar}| {elapsed}, {desc}"
    bar, ended = tqdm(total=1.0, file=sys.stderr, leave=False, bar_format=layout), threading.Event()

    def show() -> None:
        while not ended.wait(_TICK_S):
            bar.n, left_s = course.at()
            bar.set_description_str(f"{_time_left(left_s)} left, {course.stage}")

    ticker = threading.Thread(target=show, daemon=True)
    ticker.start()
    try:
        yield
    finally:
        ended.set()
        ticker.join()
        bar.close()


@contextmanager
def progress_on_stderr() -> Iterator[Progress | None]:
    """A bar for what is counted, begun anew as stages go by; None where stderr is no terminal."""
    if not _shows():
        yield None
        return
    from tqdm import tqdm

    layout = "{desc:<12} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"
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

    if _shows():
        from tqdm import tqdm

        layout = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} keys [{elapsed}, {desc}]"
        with tqdm(file=sys.stderr, bar_format=layout) as bar:

            def show(summary: Summary) -> None:
                bar.total, bar.n = summary.num_keys, len(summary.records)
                bar.set_description_str(f"{_pace(summary)}, {set_scores(summary)}")

            yield show
        return
    shown_s, log = time.monotonic(), logging.getLogger("densify")

    def tell(summary: Summary) -> None:
        nonlocal shown_s
        if time.monotonic() > shown_s + _LINE_EVERY_S:
            shown_s = time.monotonic()
            count = f"{len(summary.records)} of {summary.num_keys} keys"
            log.info("%s, %s, %s", count, _pace(summary), set_scores(summary))

    yield tell


def _shows() -> bool:
    return sys.stderr.isatty() and logging.getLogger("densify.progress").isEnabledFor(logging.INFO)


@contextmanager
def steps_on_stderr() -> Iterator[Callable[[int, float, float], None]]:
    """Steps of a training, how much of it is done, and its loss, smoothed: a bar on a terminal,
    else a line now and then."""
    smooth = shown_s = 0.0
    bar = None
    if _shows():
        from tqdm import tqdm

        layout = "{percentage:3.0f}%|{bar}| [{elapsed}<{remaining}], {desc}"
        bar = tqdm(total=1.0, file=sys.stderr, leave=False, bar_format=layout)

    def tell(steps: int, done: float, loss: float) -> None:
        nonlocal smooth, shown_s
        smooth = loss if steps == 1 or not smooth else 0.95 * smooth + 0.05 * loss
        told = f"{steps} steps, loss {smooth:.4g}"
        if bar is not None:
            bar.n = min(1.0, done)
            bar.set_description_str(told)
        elif time.monotonic() > shown_s + _LINE_EVERY_S:
            shown_s = time.monotonic()
            logging.getLogger("densify").info("%.0f %%, %s", 100 * done, told)

    try:
        yield tell
    finally:
        if bar is not None:
            bar.close()


def _pace(summary: Summary) -> str:
    if not summary.num_made:
        return "the first is being made"
    left = _time_left(summary.seconds_left or 0.0)
    return f"{summary.seconds / max(1, summary.num_made):.2f} s a key, {left} left"


def _time_left(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
