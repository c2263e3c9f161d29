# SPDX-License-Identifier: MIT
"""How a task gets to another process, and its outcome back: as bytes."""

from __future__ import annotations

import logging
import logging.handlers
import pickle
import queue
import threading

from densify.config.errors import ComputationError
from densify.dataset.tasks import Outcome, Task, called, outcome_of, words

_log = logging.getLogger("densify")


def packed(task: Task) -> bytes:
    """What `answer` needs."""
    return pickle.dumps((task.call, task.arguments, _log.getEffectiveLevel()))


def answer(work: bytes) -> bytes:
    """Do what is packed, in the worker; value or error, traceback and log records, packed."""
    call, arguments, level = pickle.loads(work)
    kept = _Kept()
    _log.addHandler(kept)
    _log.setLevel(level)
    try:
        value, error, trace = called(lambda: pickle.dumps(call(*arguments)))
    finally:
        _log.removeHandler(kept)
    return pickle.dumps((value, None if error is None else _portable(error), trace, kept.records))


def outcome(task: Task, answered: bytes) -> Outcome:
    """What an answer says of its task; what the worker logged is logged in this process."""
    value, error, trace, records = pickle.loads(answered)
    for record in records:
        logging.getLogger(record.name).handle(record)
    return outcome_of(task, None if value is None else pickle.loads(value), error, trace)


def given_up(task: Task, num_workers: int, how: str) -> Outcome:
    """The outcome of a task that is not tried once more. how: the workers ended."""
    told = f"each of the {num_workers} worker processes that tried this {how}"
    advice = "fewer workers leave more memory for each"
    return Outcome(task.name, None, ComputationError(f"{words(task.name)}: {told}; {advice}"))


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
