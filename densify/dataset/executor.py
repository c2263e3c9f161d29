# SPDX-License-Identifier: MIT
"""Calls done in this process, or in several processes of this machine.

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
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from densify.config.errors import ComputationError, InputError
from densify.pipeline.heap import keep_freed_memory

Item = TypeVar("Item")
_DEATH = (
    "a worker process died of it twice (killed, or out of memory?); fewer --workers or a smaller "
    "--window take less memory"
)


def call_all(
    call: Callable[[Item], Any],
    groups: Sequence[Sequence[Item]],
    num_workers: int = 1,
    log: Path | None = None,
) -> Iterator[tuple[Item, Any]]:
    """Call ``call(item)`` for every item and yield each with its outcome as soon as it is over.

    call: a function of a module.
    groups: none empty. The first item of a group is over before the others of the group begin; what
        these have in common is then in the cache. Items are hashable and picklable.
    num_workers: processes; 1 is this one. log: the file to which other processes append their log.

    An item whose process dies is tried once more, alone. Its outcome is a ComputationError if that
    process dies too. InputError and ComputationError of ``call`` are raised; any other error is the
    item's outcome as a ComputationError. Raises ComputationError if the workers cannot begin.
    """
    if num_workers == 1:
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
        for item, outcome in _until_a_death(call, waiting, most, log):
            if isinstance(outcome, BrokenExecutor):
                if not alone:
                    suspects.append(item)
                    continue
                outcome = ComputationError(_DEATH)
            ready.extendleft(reversed(others.pop(item, ())))
            yield item, outcome


def log_to(path: Path) -> logging.Handler:
    """Append what is logged below ``densify`` in this process to a file; return its handler."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log = logging.getLogger("densify")
    log.addHandler(handler)
    log.setLevel(logging.DEBUG)
    return handler


def share_of_cores(num_workers: int) -> dict[str, str]:
    """Return the environment that limits the threads of a worker's libraries to its share."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    return {f"{library}_NUM_THREADS": share for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")} | {
        "OPENCV_FOR_THREADS_NUM": share
    }


def _until_a_death(
    call: Callable[[Item], Any], waiting: deque[Item], num_workers: int, log: Path | None
) -> Iterator[tuple[Item, Any]]:
    """Call what waits until nothing does or a process dies, which costs all that are at work: their
    outcome is a BrokenExecutor."""
    running: dict[Future[Any], Item] = {}
    with _open_pool(num_workers, log) as pool:
        is_broken = False
        while (waiting or running) and not is_broken:
            try:
                while waiting and len(running) < num_workers:
                    running[pool.submit(call, waiting[0])] = waiting[0]
                    waiting.popleft()
            except BrokenExecutor:
                is_broken = True
            done = wait(running, return_when=FIRST_COMPLETED).done
            if is_broken or any(isinstance(f.exception(), BrokenExecutor) for f in done):
                is_broken, done = True, wait(running).done
            for future in done:
                yield running.pop(future), _outcome(future.result)


def _outcome(result: Callable[[], Any]) -> Any:
    """Return a call's value, the BrokenExecutor, or an error that costs this item alone."""
    try:
        return result()
    except BrokenExecutor as error:
        return error
    except (InputError, ComputationError):
        raise
    except Exception as error:
        return ComputationError(f"{type(error).__name__}: {error}")


@contextmanager
def _open_pool(num_workers: int, log: Path | None) -> Iterator[Executor]:
    """Open processes of this machine, which end with the block, whatever they are at."""
    spawn, before = multiprocessing.get_context("spawn"), multiprocessing.active_children()
    given = (share_of_cores(num_workers), log)
    with ProcessPoolExecutor(num_workers, spawn, _begin, given) as pool:
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


def _begin(environment: dict[str, str], log: Path | None) -> None:
    """Begin a worker process."""
    os.environ.update(environment)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the command ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if log is not None:
        log_to(log)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
