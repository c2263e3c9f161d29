# SPDX-License-Identifier: MIT
"""Measure the cost of each stage of the pipeline, and report progress."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from resource import RUSAGE_SELF, getrusage

from densify.geometry.types import Progress, StageCost

_PER_MB = 1024 * 1024 if sys.platform == "darwin" else 1024  # of getrusage(2)


class Watch:
    """Measure the wall time and memory of stages, which may run in several threads.

    Times of all threads are added up. While a stage calls an inner stage, only the inner stage's
    time counts.
    """

    def __init__(self, progress: Progress | None = None) -> None:
        """Begin to measure; ``progress`` is called by one thread at a time."""
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._peak_mb: dict[str, float] = {}
        self._lock = threading.Lock()
        self._thread = threading.local()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the work inside the ``with`` block as the stage of this name."""
        self._report(name, 0)
        begin_s, inner_s = time.perf_counter(), getattr(self._thread, "inner_s", 0.0)
        self._thread.inner_s = 0.0
        try:
            yield
        finally:
            total_s = time.perf_counter() - begin_s
            with self._lock:
                own_s = total_s - self._thread.inner_s
                self._seconds[name] = self._seconds.get(name, 0.0) + own_s
                self._peak_mb[name] = getrusage(RUSAGE_SELF).ru_maxrss / _PER_MB
            self._thread.inner_s = inner_s + total_s
        self._report(name, 1)

    def restart(self) -> None:
        """Forget the costs measured until now, before the next key."""
        with self._lock:
            self._seconds.clear()
            self._peak_mb.clear()

    def costs(self) -> tuple[StageCost, ...]:
        """Return the cost of each stage measured until now, repeated runs of a stage added up."""
        return tuple(StageCost(n, self._seconds[n], peak) for n, peak in self._peak_mb.items())

    def _report(self, name: str, done: int) -> None:
        if self._progress is not None:
            with self._lock:
                self._progress(name, done, 1)
