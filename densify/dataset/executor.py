# SPDX-License-Identifier: MIT
"""Do calls in this process, in several processes of this machine, or on a Dask scheduler.

This module imports nothing heavy: a worker process loads it before it knows its number of threads.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
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
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from densify.config.errors import ComputationError, InputError, OutputError, how_to_install
from densify.pipeline.heap import keep_freed_memory

Item = TypeVar("Item")
_CONNECT_S = 10
_Workers = AbstractContextManager[tuple[Executor, Callable[[], int]]]
"""An open executor, and the number of calls that it can do at once."""
_DEATH = (
    "a worker process died of it twice (killed, or out of memory?); fewer --workers or a smaller "
    "--window take less memory"
)


def call_all(
    call: Callable[[Item], Any],
    groups: Sequence[Sequence[Item]],
    num_workers: int = 1,
    log: Path | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[Item, Any]]:
    """Call ``call(item)`` for every item, and yield each item with its outcome when it is done.

    An item whose process dies is tried once more, alone. Then its outcome is a ComputationError.
    InputError and ComputationError of ``call`` are raised. Any other error becomes the outcome of
    the item, as a ComputationError.

    Args:
        call: A function of a module.
        groups: None empty, of hashable and picklable items. The first item of a group is done
            before the others begin, which then find shared results in the cache.
        num_workers: Number of processes; 1 is this one.
        log: The file to which other processes append their log.
        scheduler: Address of a Dask scheduler whose workers are used instead.

    Raises:
        ComputationError: The workers cannot begin, or the scheduler is lost.
        InputError: The scheduler is not reached.
    """
    if num_workers == 1 and scheduler is None:
        for group in groups:
            for item in group:
                yield item, _outcome(partial(call, item))
        return
    ready = deque(group[0] for group in groups)
    others = {group[0]: group[1:] for group in groups}
    suspects: deque[Item] = deque()  # at work when a process died
    while ready or suspects:
        alone = bool(suspects)
        waiting, most = (suspects, 1) if alone else (ready, num_workers)
        workers = _open_pool(most) if scheduler is None else _open_dask(scheduler)
        for item, outcome in _until_a_death(partial(_call_logged, call, log), waiting, workers):
            if isinstance(outcome, BrokenExecutor):
                if not alone:
                    suspects.append(item)
                    continue
                outcome = ComputationError(_DEATH)
            ready.extendleft(reversed(others.pop(item, ())))
            yield item, outcome


@contextmanager
def logged_to(path: Path, thread: int | None = None) -> Iterator[None]:
    """Append the log below ``densify`` of this process, or of one thread of it, to a file.

    Raises:
        OutputError: It cannot be written.
    """
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    handler.addFilter(lambda record: thread in (None, record.thread))
    log = logging.getLogger("densify")
    before = log.level
    log.addHandler(handler)
    log.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)
        handler.close()


def share_of_cores(num_workers: int) -> dict[str, str]:
    """Return the environment that limits the threads of a worker's libraries to its share."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    return {f"{library}_NUM_THREADS": share for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")} | {
        "OPENCV_FOR_THREADS_NUM": share
    }


def _call_logged(call: Callable[[Item], Any], log: Path | None, item: Item) -> Any:
    # A Dask worker may have several threads.
    with nullcontext() if log is None else logged_to(log, threading.get_ident()):
        return call(item)


def _until_a_death(
    call: Callable[[Item], Any], waiting: deque[Item], workers: _Workers
) -> Iterator[tuple[Item, Any]]:
    """Call the waiting items until none is left or a process dies.

    A death costs all items at work: their outcome is a BrokenExecutor.
    """
    running: dict[Future[Any], Item] = {}
    with workers as (executor, num_at_once):
        is_broken = False
        while (waiting or running) and not is_broken:
            try:
                while waiting and len(running) < num_at_once():
                    running[executor.submit(call, waiting[0])] = waiting[0]
                    waiting.popleft()
            except BrokenExecutor:
                is_broken = True
            done = wait(running, return_when=FIRST_COMPLETED).done
            if is_broken or any(isinstance(f.exception(), BrokenExecutor) for f in done):
                is_broken, done = True, wait(running).done
            for future in done:
                yield running.pop(future), _outcome(future.result)


def _outcome(result: Callable[[], Any]) -> Any:
    """Return the value of a call, the BrokenExecutor, or an error of this item alone."""
    try:
        return result()
    except BrokenExecutor as error:
        return error
    except (InputError, ComputationError, CancelledError):
        raise  # a Dask client that loses its scheduler cancels all
    except Exception as error:
        return ComputationError(f"{type(error).__name__}: {error}")


@contextmanager
def _open_pool(num_workers: int) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """Open processes of this machine, which end with the block, finished or not."""
    spawn, before = multiprocessing.get_context("spawn"), multiprocessing.active_children()
    environment = share_of_cores(num_workers)
    with ProcessPoolExecutor(num_workers, spawn, _begin, (environment,)) as pool:
        try:
            pool.submit(os.getpid).result()
            yield pool, lambda: num_workers
        except BrokenExecutor:
            raise ComputationError(
                "worker processes end before they have begun; a script that uses several needs "
                "`if __name__ == '__main__':` around what it does"
            ) from None
        except BaseException:
            for child in set(multiprocessing.active_children()) - set(before):
                child.terminate()
            raise


@contextmanager
def _open_dask(scheduler: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """Open a client of the scheduler, whose workers may come and go."""
    try:
        from distributed import Client

        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # of no use to users
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except ImportError as error:
        raise InputError(
            f"--scheduler {scheduler}: needs Dask, which is not installed; "
            f"{how_to_install('cluster')}"
        ) from error
    except Exception as error:  # of many types
        raise InputError(
            f"--scheduler {scheduler}: not reached within {_CONNECT_S} s ({error}), expected the "
            f"address of a running Dask scheduler, such as tcp://host:8786; tls:// needs "
            f"certificates that the scheduler trusts in Dask's configuration"
        ) from error
    with client:
        try:
            # pure: two equal calls would be one.
            yield client.get_executor(pure=False), lambda: max(1, sum(client.nthreads().values()))
        except (OSError, RuntimeError, CancelledError) as error:
            told = "the Dask scheduler was lost; run the same command again to go on"
            raise ComputationError(told) from error


def _begin(environment: dict[str, str]) -> None:
    """Set up a worker process."""
    os.environ.update(environment)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the command ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
