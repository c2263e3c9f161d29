# SPDX-License-Identifier: MIT
"""Calls done by a standard executor: in this process, in several processes of this machine, or by
the workers of a Dask scheduler.

This module imports nothing heavy: a worker process loads it before it knows its number of threads.
By ``tcp://`` Dask trusts everybody who reaches the scheduler; ``tls://`` needs a certificate.
"""

from __future__ import annotations

import logging
import logging.handlers
import multiprocessing
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, TypeVar

from densify.config.errors import ComputationError, InputError
from densify.pipeline.heap import keep_freed_memory

Item = TypeVar("Item")
_log = logging.getLogger("densify")
_CONNECT_S = 10
_DEATH = (
    "a worker process died of it twice (killed, or out of memory?); fewer --workers or a smaller "
    "--window take less memory"
)
_LOST = "the Dask scheduler was lost; run the same command again to go on"


def call_all(
    call: Callable[[Item], Any],
    groups: Sequence[Sequence[Item]],
    num_workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[Item, Any]]:
    """Call ``call(item)`` for every item and yield each with its outcome as soon as it is over.

    call: a function of a module. What it logs below ``densify`` is logged in this process.
    groups: none empty. The first item of a group is over before the others of the group begin; what
        these have in common is then in the cache. Items are hashable and picklable.
    num_workers: processes of this machine; 1 is this one. scheduler: address of a Dask scheduler
        whose workers are used instead.

    An item whose process dies is tried once more, alone. Its outcome is a ComputationError if that
    process dies too. InputError and ComputationError of ``call`` are raised; any other error is the
    item's outcome as a ComputationError. Raises InputError for a scheduler that is not reached, and
    ComputationError if the workers cannot begin or the scheduler is lost.
    """
    ready = deque(group[0] for group in groups)
    others = {group[0]: group[1:] for group in groups}
    suspects: deque[Item] = deque()  # at work when a process died
    while ready or suspects:  # a new pool follows a broken one
        with _open_executor(num_workers, scheduler) as (executor, num_slots):
            there = call if executor is _HERE else partial(_call_with_log, call)
            running: dict[Future[Any], Item] = {}
            is_broken = False
            while not is_broken:
                alone = bool(suspects)
                waiting = suspects or ready
                while waiting and len(running) < (1 if alone else num_slots()):
                    try:
                        running[executor.submit(there, waiting[0])] = waiting[0]
                    except BrokenExecutor:
                        is_broken = True
                        break
                    waiting.popleft()
                if not running:
                    break
                done = wait(running, return_when=FIRST_COMPLETED).done
                if is_broken := any(_is_death(_outcome(future)) for future in done):
                    done = wait(running).done
                for future in done:
                    item, outcome = running.pop(future), _outcome(future)
                    if _is_death(outcome) and not alone:
                        suspects.append(item)
                        continue
                    ready.extendleft(reversed(others.pop(item, ())))
                    yield item, ComputationError(_DEATH) if _is_death(outcome) else outcome


def check_scheduler(scheduler: str) -> None:
    """Raise InputError unless a Dask scheduler answers at this address."""
    with _dask(scheduler):
        pass


def share_of_cores(num_workers: int) -> dict[str, str]:
    """Return the environment that limits the threads of a worker's libraries to its share."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    return {f"{library}_NUM_THREADS": share for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")} | {
        "OPENCV_FOR_THREADS_NUM": share
    }


class _Logged(NamedTuple):
    """The value and the log of a call in another process."""

    value: Any
    records: list[logging.LogRecord]


def _call_with_log(call: Callable[[Any], Any], item: Any) -> _Logged:
    thread, records = threading.get_ident(), queue.SimpleQueue[logging.LogRecord]()
    handler = logging.handlers.QueueHandler(records)
    handler.addFilter(lambda record: record.thread == thread)  # a Dask worker may have several
    level = _log.level
    _log.addHandler(handler)
    _log.setLevel(logging.DEBUG)
    try:
        return _Logged(call(item), [records.get() for _ in range(records.qsize())])
    finally:
        _log.removeHandler(handler)
        _log.setLevel(level)


def _outcome(future: Future[Any]) -> Any:
    """Return a call's value, the BrokenExecutor, or an error that costs this item alone."""
    try:
        value = future.result()
    except BrokenExecutor as error:
        return error
    except (InputError, ComputationError, CancelledError):
        raise  # CancelledError: by nobody here; a client that loses its scheduler cancels all
    except Exception as error:
        return ComputationError(f"{type(error).__name__}: {error}")
    if not isinstance(value, _Logged):
        return value
    while value.records:
        record = value.records.pop(0)
        if (log := logging.getLogger(record.name)).isEnabledFor(record.levelno):
            log.handle(record)
    return value.value


def _is_death(outcome: Any) -> bool:
    return isinstance(outcome, BrokenExecutor)


@contextmanager
def _open_executor(
    num_workers: int, scheduler: str | None
) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """Open an executor; the function returns the number of calls that it can do at once."""
    if scheduler is not None:
        with _dask(scheduler) as client:
            executor = client.get_executor(pure=False)  # pure: two equal calls would be one
            try:
                yield executor, lambda: max(1, sum(client.nthreads().values()))
            except (OSError, RuntimeError, CancelledError) as error:
                raise ComputationError(_LOST) from error
    elif num_workers == 1:
        yield _HERE, lambda: 1
    else:
        with _processes(num_workers) as pool:
            yield pool, lambda: num_workers


class _InThisProcess(Executor):
    """Calls at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


_HERE = _InThisProcess()


@contextmanager
def _processes(num_workers: int) -> Iterator[Executor]:
    """Open processes of this machine, which end with the block, whatever they are at."""
    spawn, before = multiprocessing.get_context("spawn"), multiprocessing.active_children()
    environment = share_of_cores(num_workers)
    with ProcessPoolExecutor(num_workers, spawn, _begin, (environment,)) as pool:
        try:
            pool.submit(os.getpid).result()
            yield pool
        except BrokenExecutor:
            raise ComputationError(
                "worker processes end before they have begun; a script that uses several needs "
                "`if __name__ == '__main__':` around what it does"
            ) from None
        except BaseException:
            for child in set(multiprocessing.active_children()) - set(before):
                child.terminate()
            raise


def _begin(environment: dict[str, str]) -> None:
    """Begin a worker process."""
    os.environ.update(environment)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the command ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _dask(scheduler: str) -> Iterator[Any]:
    """Open a client of the scheduler."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            f"scheduler {scheduler}: needs Dask, which is not installed; "
            "pip install 'densify[cluster]'"
        ) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # no help for users
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:  # of many types
        raise InputError(
            f"scheduler {scheduler}: not reached within {_CONNECT_S} s ({error}), expected the "
            f"address of a running Dask scheduler, such as tcp://host:8786; tls:// needs "
            f"certificates that the scheduler trusts in Dask's configuration"
        ) from error
    with client:
        yield client
