# SPDX-License-Identifier: MIT
"""Where tasks are done: in this process, in several of this machine, or wherever a Dask scheduler
has workers.

A task may be called twice: if a worker process dies, what it was at is done again elsewhere. What
a worker logs below ``densify`` comes back with its answer and is logged in this process.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack, contextmanager
from typing import Any

from densify.dataset.calls import Elsewhere, WorkersDiedError
from densify.dataset.pools import TRIES, interrupts_held, open_pools, share_of_cores
from densify.dataset.tasks import InThisProcess, Task, Workers
from densify.errors import ComputationError, InputError

_log = logging.getLogger("densify")

_CONNECT_S = 10
_GONE_S = 60.0  # a local worker is back within seconds
_CLOSE_S = 1.0  # what a Dask worker may take to end in peace


@contextmanager
def open_workers(
    num_workers: int, scheduler: str | None = None, memory_bytes: int | None = None
) -> Iterator[Workers]:
    """Workers for the time of the block; processes started for it end with it, whatever they do.

    num_workers: 1 works in this process, without any other. More are processes of this machine
        that share its cores: a local Dask cluster, or plain processes without `distributed`.
    scheduler: address of a running Dask scheduler, ``tcp://host:8786``; num_workers and
        memory_bytes are then not used.
    memory_bytes: of all workers together; Dask ends and replaces a worker above its share.
        Plain processes have no limit.
    Raises InputError if num_workers is below 1, or the scheduler is not reached or cannot be used.
    """
    if scheduler is not None:
        opened = _connected(scheduler)
    elif num_workers < 1:
        raise InputError(f"workers: got {num_workers}, expected 1 or more")
    elif num_workers == 1:
        yield InThisProcess()
        return
    elif _has_distributed():
        opened = _local_cluster(num_workers, memory_bytes)
    else:
        opened = open_pools(num_workers)
    with opened as workers:
        yield workers


@contextmanager
def _local_cluster(num_workers: int, memory_bytes: int | None) -> Iterator[Workers]:
    import dask
    from distributed import Client, LocalCluster

    threads = share_of_cores(num_workers)
    # The workers load numpy before they get `env`, so this process's environment has to say what
    # they may have. Not for numba, which would take it for this process at its next compilation.
    early = {name: value for name, value in threads.items() if not name.startswith("NUMBA")}
    early["DASK_LOGGING__DISTRIBUTED"] = "critical"
    settings = {
        "distributed.nanny.pre-spawn-environ": {},
        "distributed.deploy.lost-worker-timeout": "1 hour",
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.profile.enabled": False,
        # Nothing is kept that could be spilled, and a worker that only pauses would never go on.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
    }
    with ExitStack() as stack:
        # Queues that wait in cycles for the collector would be told of as leaked semaphores.
        stack.callback(gc.collect)
        stack.enter_context(_silent_dask())
        stack.enter_context(_environment(early))
        stack.enter_context(dask.config.set(settings))
        with interrupts_held():
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=num_workers,
                    threads_per_worker=1,
                    memory_limit=memory_bytes and memory_bytes // num_workers,
                    silence_logs=False,
                    scheduler_kwargs={
                        "allowed_failures": TRIES - 1,
                        "dashboard": False,
                        "dashboard_address": "127.0.0.1:0",  # its server runs even without
                    },
                    env=threads,
                )
            )
            stack.callback(_end_soon, cluster)
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield _Cluster(client, "of this command", local=True)


@contextmanager
def _connected(scheduler: str) -> Iterator[Workers]:
    if not _has_distributed():
        raise InputError(
            f"scheduler {scheduler}: needs Dask, which is not installed; "
            "pip install 'densify[cluster]'"
        )
    from distributed import Client
    from distributed.core import connect

    async def reach() -> None:
        await (await connect(scheduler, timeout=_CONNECT_S)).close()

    with ExitStack() as stack:
        stack.enter_context(_silent_dask())
        try:
            asyncio.run(reach())  # first, for a client that failed to start is hard to get rid of
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except Exception as error:  # whatever it is that answers there
            raise InputError(
                f"scheduler {scheduler}: not reached within {_CONNECT_S} s ({error}), expected "
                "the address of a running Dask scheduler, such as tcp://host:8786"
            ) from error
        stack.enter_context(client)
        yield _Cluster(client, scheduler, local=False)


class _Cluster(Elsewhere):
    """The workers of a Dask scheduler, which by itself gives a task of a lost worker to others."""

    def __init__(self, client: Any, where: str, local: bool) -> None:
        super().__init__()
        self._client, self._where, self._local = client, where, local
        # Not pure: Dask would take two equal calls for one.
        self._executor = client.get_executor(pure=False)
        self._none_since: float | None = None

    def num_slots(self) -> int:
        try:
            num_slots = sum(self._client.nthreads().values())
        except Exception as error:  # of many types, after the stage that the connection was in
            raise self._lost() from error
        if num_slots:
            self._none_since = None
        elif self._none_since is None:
            self._none_since = time.monotonic()
            if not self._local:
                _log.warning("Dask scheduler %s has no workers; waiting for one", self._where)
        elif self._local and time.monotonic() - self._none_since > _GONE_S:
            raise ComputationError(
                "all worker processes ended and none could be started again; "
                "run the same command again to go on"
            )
        return num_slots

    def _start(self, *call: Any) -> Future[bytes]:
        try:
            return self._executor.submit(*call)
        except Exception as error:
            raise self._lost() from error

    def _answer(self, task: Task, future: Future[bytes]) -> bytes | None:
        from distributed.scheduler import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            raise WorkersDiedError(error.allowed_failures + 1) from None
        except CancelledError:  # by nobody here: so does a client that lost its scheduler
            raise self._lost() from None

    def _lost(self) -> ComputationError:
        return ComputationError(
            f"the Dask scheduler {self._where} was lost; run the same command again to go on"
        )


def _has_distributed() -> bool:
    with interrupts_held():  # some of the many modules it loads would swallow one
        try:
            import distributed  # noqa: F401
        except ImportError:
            return False
    return True


def _end_soon(cluster: Any) -> None:
    """End the workers of a local Dask cluster; its own way gives each 4 s to finish its task."""

    async def end() -> None:
        nannies = cluster.workers.values()
        ends = (nanny.close(timeout=_CLOSE_S) for nanny in nannies)
        await asyncio.gather(*ends, return_exceptions=True)

    cluster.sync(end)


@contextmanager
def _silent_dask() -> Iterator[None]:
    """What Dask would tell on the screen is of no help to who does not know of its workers."""
    import distributed  # noqa: F401  sets the levels itself when it is loaded

    names = "distributed distributed.client distributed.gc tornado tornado.application asyncio"
    loggers = [logging.getLogger(name) for name in names.split()]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """The variables for the block; Dask's own for its workers go with them."""
    names = (*variables, "PYTHONHASHSEED", "__DASK_PARENT_PID")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
