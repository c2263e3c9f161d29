# SPDX-License-Identifier: MIT
"""How a call gets to another process and back."""

from __future__ import annotations

import logging
import logging.handlers
import pickle
import queue
import threading
from abc import abstractmethod
from concurrent.futures import Future
from typing import Any

from densify.dataset.tasks import Outcome, Task, Workers, called, outcome_of, words
from densify.errors import ComputationError

_log = logging.getLogger("densify")


class WorkersDiedError(Exception):
    """The outcome of a task that cannot be tried once more."""

    def __init__(self, times: int) -> None:
        super().__init__(
            f"each of the {times} worker processes that tried this died (killed, or short of "
            "memory?); fewer workers leave more for each"
        )


class Elsewhere(Workers):
    """Workers in other processes, that give a future for a call."""

    def __init__(self) -> None:
        self._tasks: dict[Future[bytes], Task] = {}
        self._over: queue.SimpleQueue[Future[bytes]] = queue.SimpleQueue()

    @abstractmethod
    def _start(self, *call: Any) -> Future[bytes]:
        """Have ``call[0](*call[1:])`` called."""

    @abstractmethod
    def _answer(self, task: Task, future: Future[bytes]) -> bytes | None:
        """What came of it, None if the task was submitted again; raises WorkersDiedError."""

    def submit(self, task: Task) -> None:
        # Pickled here and not on the way, where each kind of workers fails in its own manner.
        work = pickle.dumps((task.call, task.arguments))
        future = self._start(_call_pickled, work, _log.getEffectiveLevel())
        self._tasks[future] = task
        future.add_done_callback(self._over.put)

    def next_over(self, wait_s: float) -> Outcome | None:
        try:
            future = self._over.get(timeout=wait_s)
        except queue.Empty:
            return None
        task = self._tasks.pop(future)
        try:
            answer = self._answer(task, future)
        except WorkersDiedError as died:
            return Outcome(task.name, None, ComputationError(f"{words(task.name)}: {died}"))
        if answer is None:
            return None
        value, error, trace, records = pickle.loads(answer)
        for record in records:
            logging.getLogger(record.name).handle(record)
        return outcome_of(task, None if value is None else pickle.loads(value), error, trace)


def _call_pickled(work: bytes, level: int) -> bytes:
    """In the worker: call what is pickled; value or error, traceback, log records, pickled."""
    kept = _Kept()
    _log.addHandler(kept)
    _log.setLevel(level)
    try:
        value, error, trace = called(_unpacked, work)
    finally:
        _log.removeHandler(kept)
    return pickle.dumps((value, None if error is None else _portable(error), trace, kept.records))


def _unpacked(work: bytes) -> bytes:
    call, arguments = pickle.loads(work)
    return pickle.dumps(call(*arguments))


def _portable(error: Exception) -> Exception:
    """The error, or one that says the same if it does not come out of a pickle as it was."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return ComputationError(f"{type(error).__name__}: {error}")
    return error


class _Kept(logging.handlers.QueueHandler):
    """Keeps what the thread logs that made it, ready to be pickled."""

    def __init__(self) -> None:
        super().__init__(queue.SimpleQueue())
        self.records: list[logging.LogRecord] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:  # a Dask worker may be at several tasks
            super().emit(record)

    def enqueue(self, record: logging.LogRecord) -> None:
        self.records.append(record)
