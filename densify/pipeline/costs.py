# SPDX-License-Identifier: MIT
"""What each stage of the pipeline costs, and which one is at work."""

from __future__ import annotations

import re
import resource
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from densify.geometry.types import Progress, StageCost

_STATUS = Path("/proc/self/status")


class Watch:
    """Measures stages and reports progress. A stage that asks for another one waits meanwhile: the
    seconds of the inner stage count for the inner one only. Stages may be at work in several
    threads; their seconds are added up."""

    def __init__(self, progress: Progress | None = None) -> None:
        """progress: called as (stage, done, total), by one thread at a time."""
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._peak_mb: dict[str, float] = {}
        self._lock = threading.Lock()
        self._thread = _Running()

    def step(self, name: str, done: int, total: int) -> None:
        """Report how far a stage is."""
        if self._progress is not None:
            with self._lock:
                self._progress(name, done, total)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure what happens inside the block as the stage of this name."""
        self.step(name, 0, 1)
        self._count()
        self._thread.stages.append(name)
        try:
            yield
        finally:
            self._count()
            self._thread.stages.pop()
            with self._lock:
                self._peak_mb[name] = peak_memory_mb()
        self.step(name, 1, 1)

    def costs(self) -> tuple[StageCost, ...]:
        """Costs so far; a stage that worked several times is counted once, in sum."""
        return tuple(StageCost(n, self._seconds[n], peak) for n, peak in self._peak_mb.items())

    def _count(self) -> None:
        """Add the time since this thread's last change to the stage that was at work in it."""
        now_s, thread = time.perf_counter(), self._thread
        if thread.stages:
            name = thread.stages[-1]
            with self._lock:
                self._seconds[name] = self._seconds.get(name, 0.0) + now_s - thread.since_s
        thread.since_s = now_s


class _Running(threading.local):
    """The stages at work in a thread, the innermost last, and when that changed last."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.since_s = 0.0


def peak_memory_mb() -> float:
    """The most memory that this process had at once, without what the process that started it had:
    Linux's getrusage goes on from there."""
    own_mb = status_mb("VmHWM")
    if own_mb is not None:
        return own_mb
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def status_mb(name: str) -> float | None:
    """A row of Linux's table of this process, proc(5); None where there is none."""
    with suppress(OSError):
        found = re.search(rf"^{name}:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
        return int(found[1]) / 1024 if found else None
    return None
