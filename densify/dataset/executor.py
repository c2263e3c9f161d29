# SPDX-License-Identifier: MIT
"""Run calls in this process, in several processes of this machine, or on a Dask scheduler."""

from __future__ import annotations

# No heavy package here: a worker imports this module before its number of threads is set.
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
from densify.pipeline.process import keep_freed_memory

Item = TypeVar("Item")
_CONNECT_S = 10
_Workers = AbstractContextManager[tuple[Executor, Callable[[], int]]]
"""An open executor, and a function that returns how many calls it can run at once."""
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
    """Call ``call(item)`` for every item, and yield pairs (item, outcome) as calls finish.

    An item whose process dies is tried a second time, alone. A second death or an unexpected error
    gives a ComputationError as outcome. InputError and ComputationError of ``call`` are raised.

    Args:
        call: Function of one item, defined in a module so that processes can import it.
        groups: Non-empty groups of hashable, picklable items. A group's first item is finished
            before the others begin, so they find shared results in the cache.
        num_workers: Number of processes. 1 uses this process.
        log: File to which worker processes append their log, None for no log.
        scheduler: Address of a Dask scheduler whose workers replace local processes, or None.
    """
    if num_workers == 1 and scheduler is None:
        for group in groups:
            for item in group:
                yield item, _outcome(partial(call, item))
        return
    ready = deque(group[0] for group in groups)
    followers = {group[0]: group[1:] for group in groups}
    suspects: deque[Item] = deque()  # items that were running when a process died
    while ready or suspects:
        is_retry = bool(suspects)
        # One suspect at a time, so that a second death has a single culprit.
        waiting, num_processes = (suspects, 1) if is_retry else (ready, num_workers)
        workers = _open_pool(num_processes) if scheduler is None else _open_dask(scheduler)
        for item, outcome in _until_a_death(partial(_call_logged, call, log), waiting, workers):
            if isinstance(outcome, BrokenExecutor) and not is_retry:
                suspects.append(item)
                continue
            ready.extendleft(reversed(followers.pop(item, ())))
            yield item, ComputationError(_DEATH) if isinstance(outcome, BrokenExecutor) else outcome


@contextmanager
def logged_to(path: Path, thread: int | None = None) -> Iterator[None]:
    """Append the log messages of ``densify`` to a file within the ``with`` block.

    ``thread`` is the identifier of the only thread whose messages are kept, None for all threads.
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
    """Return environment variables that give each of ``num_workers`` an equal share of cores."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    names = [f"{library}_NUM_THREADS" for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")]
    return dict.fromkeys([*names, "OPENCV_FOR_THREADS_NUM"], share)


def _call_logged(call: Callable[[Item], Any], log: Path | None, item: Item) -> Any:
    # A Dask worker may have several threads.
    with nullcontext() if log is None else logged_to(log, threading.get_ident()):
        return call(item)


def _until_a_death(
    call: Callable[[Item], Any], waiting: deque[Item], workers: _Workers
) -> Iterator[tuple[Item, Any]]:
    """Yield (item, outcome), and drop from ``waiting`` what starts, until a process dies."""
    # A death stops all running calls, whose outcome is then a BrokenExecutor.
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
            if is_broken or any(isinstance(future.exception(), BrokenExecutor) for future in done):
                is_broken, done = True, wait(running).done
            for future in done:
                yield running.pop(future), _outcome(future.result)


def _outcome(result: Callable[[], Any]) -> Any:
    """Return the value of a call, the BrokenExecutor, or an error that concerns this item only."""
    try:
        return result()
    except BrokenExecutor as error:
        return error
    except (InputError, ComputationError, CancelledError):
        raise  # CancelledError: a Dask client that loses its scheduler cancels all calls
    except Exception as error:
        return ComputationError(f"{type(error).__name__}: {error}")


@contextmanager
def _open_pool(num_workers: int) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """Open a pool of processes. They end with the block, even with unfinished calls."""
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
    """Open a client of a Dask scheduler. Its workers may join and leave."""
    try:
        from distributed import Client

        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # no help to users
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except ImportError as error:
        raise InputError(
            f"--scheduler {scheduler}: needs Dask, which is not installed; "
            f"{how_to_install('cluster')}"
        ) from error
    except Exception as error:  # the client raises many types
        raise InputError(
            f"--scheduler {scheduler}: not reached within {_CONNECT_S} s ({error}), expected the "
            f"address of a running Dask scheduler, such as tcp://host:8786; tls:// needs "
            f"certificates that the scheduler trusts in Dask's configuration"
        ) from error
    with client:
        try:
            # With pure=True, Dask would run two equal calls only once.
            yield client.get_executor(pure=False), lambda: max(1, sum(client.nthreads().values()))
        except (OSError, RuntimeError, CancelledError) as error:
            raise ComputationError(
                "the Dask scheduler was lost; run the same command again to go on"
            ) from error


def _begin(environment: dict[str, str]) -> None:
    """Prepare a worker process, which ends with its parent."""
    os.environ.update(environment)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the command ends its workers itself
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
