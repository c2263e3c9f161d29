# SPDX-License-Identifier: MIT
"""Measure the cost of each stage, report progress, and set how freed memory is reused."""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from resource import RUSAGE_SELF, getrusage
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from densify.geometry.types import Progress, StageCost

T = TypeVar("T")
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # parameters of glibc's mallopt(3)
_KEPT_BYTES = 2**30  # arrays up to this size are on the heap, which keeps as much freed memory
_MOST_OF_OLDER_BYTES = 2**25  # older releases refuse a larger threshold of mmap
_PER_MB = 1024 * 1024 if sys.platform == "darwin" else 1024  # units of getrusage(2) in a MB


class Watch:
    """Measure each stage's wall time, without inner stages and summed over threads, and memory."""

    def __init__(self, progress: Progress | None = None) -> None:
        """Begin to measure. One thread at a time calls ``progress`` (stage, done, total)."""
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._peak_mb: dict[str, float] = {}
        self._begin_s = time.perf_counter()
        self._running: list[str] = []  # stages, the latest last
        self._lock = threading.Lock()
        self._thread = threading.local()

    @contextmanager
    def stage(self, name: str, is_part: bool = False) -> Iterator[None]:
        """Measure the work inside the ``with`` block as the stage of this name.

        Report its begin and its end, and then the stage that still runs in any thread. ``is_part``
        marks a part that `each` counts, and reports nothing.
        """
        if not is_part:
            self._running.append(name)
            self.report(name, 0, 1)
        begin_s = time.perf_counter()
        # Time of the stages that the outer stage has called before; the counter is this stage's now
        siblings_s = getattr(self._thread, "inner_s", 0.0)
        self._thread.inner_s = 0.0
        try:
            yield
        finally:
            total_s = time.perf_counter() - begin_s
            with self._lock:
                own_s = total_s - self._thread.inner_s
                self._seconds[name] = self._seconds.get(name, 0.0) + own_s
                self._peak_mb[name] = getrusage(RUSAGE_SELF).ru_maxrss / _PER_MB
            self._thread.inner_s = siblings_s + total_s
            if not is_part:
                self._running.remove(name)
        if not is_part:
            self.report(name, 1, 1)
            for other in self._running[-1:]:
                self.report(other, 0, 1)

    def each(self, name: str, parts: Collection[T]) -> Iterator[T]:
        """Yield the parts of a stage, and report how many of them are done."""
        for done, part in enumerate(parts, start=1):
            yield part
            self.report(name, done, len(parts))

    def restart(self) -> None:
        """Forget the costs measured until now, before the next key."""
        with self._lock:
            self._begin_s = time.perf_counter()
            self._seconds.clear()
            self._peak_mb.clear()

    def elapsed_s(self) -> float:
        """Return the seconds since the begin, or since `restart`."""
        return time.perf_counter() - self._begin_s

    def costs(self) -> tuple[StageCost, ...]:
        """Return the costs of the stages since the begin or the last `restart`.

        Repeated runs add up. The memory is the process's peak at the end of the stage's last run.
        """
        from densify.geometry.types import StageCost  # the command line starts without numpy

        return tuple(
            StageCost(name, self._seconds[name], peak_mb) for name, peak_mb in self._peak_mb.items()
        )

    def report(self, name: str, done: int, total: int) -> None:
        """Report that ``done`` of the ``total`` parts of a stage are done."""
        if self._progress is not None:
            with self._lock:
                self._progress(name, done, total)


def keep_freed_memory() -> None:
    """Let all threads of this process share one heap that keeps the freed memory of large arrays.

    By default each thread has a heap, and the system clears the pages of every large array. Call
    this before threads are started. Without glibc it does nothing.
    """
    with suppress(OSError, AttributeError, TypeError):  # another library, or none by that name
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_ARENA_MAX, 1)
        if not mallopt(_MMAP_THRESHOLD, _KEPT_BYTES):
            mallopt(_MMAP_THRESHOLD, _MOST_OF_OLDER_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
