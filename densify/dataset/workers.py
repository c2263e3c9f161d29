# SPDX-License-Identifier: MIT
"""Where tasks are done: in this process, in several of this machine, or wherever a Dask scheduler
has workers.

A task may be called twice: if a worker process dies, what it was at is done again elsewhere. What
a worker logs below ``densify`` comes back with its answer and is logged in this process.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from densify.config.errors import InputError
from densify.dataset.cluster import check_reached, connected
from densify.dataset.processes import open_processes
from densify.dataset.tasks import InThisProcess, Workers


def check_workers(num_workers: int | None, scheduler: str | None) -> None:
    """Raise InputError, before anything is begun, for what `open_workers` would refuse."""
    if scheduler is not None:
        check_reached(scheduler)
    elif num_workers is not None and num_workers < 1:
        raise InputError(f"--workers {num_workers}: expected 1 or more processes")


@contextmanager
def open_workers(
    num_workers: int, scheduler: str | None = None, memory_bytes: int | None = None
) -> Iterator[Workers]:
    """Workers for the time of the block; processes started for it end with it, whatever they do.

    num_workers: 1 works in this process, without any other. More are processes of this machine
        that share its cores.
    scheduler: address of a running Dask scheduler, ``tls://host:8786``; num_workers and
        memory_bytes are then not used.
    memory_bytes: of all workers together; one of several that takes more than its share is ended
        and replaced.
    Raises InputError if num_workers is below 1, or the scheduler is not reached or cannot be used.
    """
    if scheduler is not None:
        with connected(scheduler) as workers:
            yield workers
        return
    check_workers(num_workers, scheduler)
    if num_workers == 1:
        yield InThisProcess()
    else:
        with open_processes(num_workers, memory_bytes) as workers:
            yield workers
