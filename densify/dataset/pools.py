# SPDX-License-Identifier: MIT
"""Worker processes of this machine, with nothing but Python's own library."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from densify.dataset.calls import Elsewhere, WorkersDiedError
from densify.dataset.tasks import Task, Workers

TRIES = 3  # workers that may die of one task


@contextmanager
def open_pools(num_workers: int) -> Iterator[Workers]:
    """So many processes for the time of the block, without a limit of memory."""
    lifeline, ours = multiprocessing.get_context("spawn").Pipe(duplex=False)
    pools = _Pools(num_workers, lifeline)
    try:
        yield pools
    finally:
        ours.close()
        pools.close()
        lifeline.close()


class _Pools(Elsewhere):
    """One pool of one process for each worker: a pool breaks as a whole if a process dies, so
    that nobody could tell of which task, and the others would be lost with it."""

    def __init__(self, num_workers: int, lifeline: Connection) -> None:
        super().__init__()
        self._begin = (lifeline, share_of_cores(num_workers))
        self._idle = [self._new() for _ in range(num_workers)]
        self._busy: dict[Future[bytes], ProcessPoolExecutor] = {}
        self._num_workers = num_workers
        self._deaths: Counter[tuple[Any, ...]] = Counter()

    def num_slots(self) -> int:
        return self._num_workers

    def close(self) -> None:
        """To be called when the lifeline is cut."""
        for pool in (*self._idle, *self._busy.values()):
            pool.shutdown(wait=True, cancel_futures=True)

    def _new(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, _begin_worker, self._begin)

    def _start(self, *call: Any) -> Future[bytes]:
        pool = self._idle.pop()
        with interrupts_held():
            try:
                future = pool.submit(*call)
            except BrokenProcessPool:  # the process died while it had nothing to do
                pool = self._new()
                future = pool.submit(*call)
        self._busy[future] = pool
        return future

    def _answer(self, task: Task, future: Future[bytes]) -> bytes | None:
        pool = self._busy.pop(future)
        try:
            answer = future.result()
        except BrokenProcessPool:
            pool.shutdown(wait=False)
            self._idle.append(self._new())
            self._deaths[task.name] += 1
            if self._deaths[task.name] == TRIES:
                raise WorkersDiedError(TRIES) from None
            self.submit(task)
            return None
        self._idle.append(pool)
        return answer


def _begin_worker(lifeline: Connection, environment: Mapping[str, str]) -> None:
    """First thing in a process of a pool, which by itself would outlive its parent."""
    os.environ.update(environment)

    def end_with_parent() -> None:
        with suppress(EOFError, OSError):
            lifeline.recv()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def share_of_cores(num_workers: int) -> dict[str, str]:
    """Environment that tells a worker's libraries their number of threads."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    return {f"{library}_NUM_THREADS": share for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")} | {
        "OPENCV_FOR_THREADS_NUM": share
    }


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C waits for the end of the block; threads and processes started in it never get it."""
    resource_tracker.ensure_running()  # else started with the first child: it lifts the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
