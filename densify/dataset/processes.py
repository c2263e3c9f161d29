# SPDX-License-Identifier: MIT
"""Worker processes of this machine: each has a pipe to this process and nothing else, so nobody
can send it work but the command that started it.

Python's own pools, and those of loky, break as a whole when one of their processes dies: nobody
could tell of which task, and the others would be lost with it.
"""

from __future__ import annotations

import _thread
import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

from densify.config.errors import ComputationError
from densify.dataset.calls import answer, given_up, outcome, packed
from densify.dataset.tasks import Outcome, Task, Workers, words
from densify.pipeline.heap import keep_freed_memory

_log = logging.getLogger("densify")

_TRIES = 3  # workers that may die of one task
_WATCH_S = 0.2  # between looks at the workers' memory
_GRACE_S = 1.0  # for a worker to clear away what it is writing
_READY = b""


@contextmanager
def open_processes(num_workers: int, memory_bytes: int | None) -> Iterator[Workers]:
    """So many processes for the time of the block. memory_bytes: of all of them together; one that
    takes more than its share is ended, as if it had died."""
    workers = _Processes(num_workers, memory_bytes and memory_bytes // num_workers)
    try:
        yield workers
    finally:
        workers.close()


class _Worker:
    """One process, and the task that it is at. ready: it has begun. too_large: it was ended for
    the memory that it took."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, environment), daemon=True)
        self.process.start()
        theirs.close()
        self.ready, self.too_large = False, False
        self.task: Task | None = None

    def resident_bytes(self) -> int:
        """What it has in memory; 0 if it has ended."""
        try:
            pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        except (OSError, IndexError):
            return 0
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def end(self) -> None:
        """Stop it at once, whatever it is at."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class _Processes(Workers):
    """share_bytes: of memory for each, None without a limit."""

    def __init__(self, num_workers: int, share_bytes: int | None) -> None:
        self._share_bytes = share_bytes
        self._environment = share_of_cores(num_workers)
        self._deaths: Counter[tuple[Any, ...]] = Counter()
        self._num_stillborn = 0
        self._workers: list[_Worker] = []
        try:
            for _ in range(num_workers):
                self._add()
        except BaseException:
            self.close()
            raise

    def num_slots(self) -> int:
        return len(self._workers)

    def submit(self, task: Task) -> None:
        work = packed(task)
        worker = next(w for w in self._workers if w.task is None)
        if not worker.process.is_alive():
            worker = self._replaced(worker)
        worker.task = task
        with suppress(OSError):  # it has died since, which its pipe will tell
            worker.connection.send_bytes(work)

    def next_over(self, wait_s: float) -> Outcome | None:
        end_s = time.monotonic() + wait_s
        while True:
            left_s = max(0.0, end_s - time.monotonic())
            busy = {w.connection: (w, w.task) for w in self._workers if w.task is not None}
            for pipe in wait(list(busy), min(left_s, _WATCH_S)):
                over = self._heard(*busy[cast(Connection, pipe)])
                if over is not None:
                    return over
            self._end_too_large()
            if not left_s:
                return None

    def close(self) -> None:
        """End all."""
        for worker in self._workers:
            worker.connection.close()
        end_s = time.monotonic() + _GRACE_S
        for worker in self._workers:
            worker.process.join(max(0.0, end_s - time.monotonic()))
            worker.end()
        self._workers = []

    def _heard(self, worker: _Worker, task: Task) -> Outcome | None:
        """What a worker's pipe tells: that it has begun, an answer, or that it has died."""
        try:
            answered = worker.connection.recv_bytes()
        except (EOFError, OSError):
            self._replaced(worker)
            return self._try_again(worker, task)
        self._num_stillborn = 0
        if answered == _READY:
            worker.ready = True
            return None
        worker.task = None
        return outcome(task, answered)

    def _try_again(self, dead: _Worker, task: Task) -> Outcome | None:
        how = "died (killed, or short of memory?)"
        if dead.too_large and self._share_bytes is not None:
            how = f"took more than its {self._share_bytes / 1e9:.2f} GB of memory"
        _log.debug("%s: a worker process %s", words(task.name), how)
        if dead.ready:
            self._deaths[task.name] += 1
            if self._deaths[task.name] == _TRIES:
                return given_up(task, _TRIES, how)
        else:  # not of the task
            self._num_stillborn += 1
            if self._num_stillborn == _TRIES * len(self._workers):
                raise ComputationError(
                    "worker processes end before they have begun; a script that uses several "
                    "needs `if __name__ == '__main__':` around what it does"
                )
        self.submit(task)
        return None

    def _end_too_large(self) -> None:
        if self._share_bytes is None:
            return
        for worker in list(self._workers):
            if worker.resident_bytes() <= self._share_bytes:
                continue
            worker.too_large = True
            if worker.task is None:
                self._replaced(worker)
            else:  # its pipe will tell
                worker.process.kill()

    def _add(self) -> _Worker:
        with interrupts_held():
            self._workers.append(_Worker(self._environment))
        return self._workers[-1]

    def _replaced(self, worker: _Worker) -> _Worker:
        worker.end()
        self._workers.remove(worker)
        return self._add()


def _serve(connection: Connection, environment: Mapping[str, str]) -> None:
    """All that a worker process does."""
    os.environ.update(environment)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    works: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(connection, works), daemon=True).start()
    with suppress(KeyboardInterrupt, OSError):
        connection.send_bytes(_READY)
        while (work := works.get()) is not None:
            connection.send_bytes(answer(work))
    os._exit(0)


def _receive(connection: Connection, works: queue.SimpleQueue[bytes | None]) -> None:
    """Pass on what comes until the other end is closed, by whatever ended that process; then so
    does this one, which by itself would go on."""
    with suppress(EOFError, OSError):
        while True:
            works.put(connection.recv_bytes())
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the screen is no longer ours
    works.put(None)
    _thread.interrupt_main()
    time.sleep(_GRACE_S)
    os._exit(1)


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
