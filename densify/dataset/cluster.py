# SPDX-License-Identifier: MIT
"""The workers of a Dask scheduler that runs somewhere. The one door to Dask.

By ``tcp://`` Dask trusts everybody who reaches the scheduler: they can have anything done by its
workers, and by whoever asks it for results. ``tls://`` lets in only who has a certificate.
"""

from __future__ import annotations

import asyncio
import logging
import queue
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack, contextmanager
from typing import Any

from densify.config.errors import ComputationError, InputError
from densify.dataset.calls import answer, given_up, outcome, packed
from densify.dataset.processes import interrupts_held
from densify.dataset.tasks import Outcome, Task, Workers

_log = logging.getLogger("densify")

_CONNECT_S = 10


def check_reached(scheduler: str) -> None:
    """Raise InputError unless a Dask scheduler answers at this address."""
    if not _has_distributed():
        raise InputError(
            f"scheduler {scheduler}: needs Dask, which is not installed; "
            "pip install 'densify[cluster]'"
        )
    from distributed import Security
    from distributed.core import connect

    async def reach() -> None:
        arguments = Security().get_connection_args("client")
        await (await connect(scheduler, timeout=_CONNECT_S, **arguments)).close()

    with _silent_dask():
        try:
            asyncio.run(reach())
        except Exception as error:  # whatever it is that answers there
            raise _not_reached(scheduler, error) from error


@contextmanager
def connected(scheduler: str) -> Iterator[Workers]:
    """scheduler: its address; how ``tls://`` shows who it is says Dask's own configuration.

    Raises InputError if it cannot be used.
    """
    check_reached(scheduler)  # first, for a client that failed to start is hard to get rid of
    from distributed import Client

    with ExitStack() as stack:
        stack.enter_context(_silent_dask())
        try:
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except Exception as error:
            raise _not_reached(scheduler, error) from error
        stack.enter_context(client)
        yield _Cluster(client, scheduler)


def _not_reached(scheduler: str, error: Exception) -> InputError:
    expected = "the address of a running Dask scheduler, such as tcp://host:8786"
    if scheduler.startswith("tls://"):
        expected += (
            "; for tls://, Dask's configuration has to name certificates that the scheduler trusts "
            "(distributed.comm.tls.ca-file, .client.cert, .client.key)"
        )
    return InputError(
        f"scheduler {scheduler}: not reached within {_CONNECT_S} s ({error}), expected {expected}"
    )


class _Cluster(Workers):
    """A client's workers; Dask itself gives a task of a lost one to others."""

    def __init__(self, client: Any, scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        # Not pure: Dask would take two equal calls for one.
        self._executor = client.get_executor(pure=False)
        self._tasks: dict[Future[bytes], Task] = {}
        self._over: queue.SimpleQueue[Future[bytes]] = queue.SimpleQueue()
        self._deserted = False

    def num_slots(self) -> int:
        try:
            num_slots = sum(self._client.nthreads().values())
        except Exception as error:  # of many types, after the stage that the connection was in
            raise self._lost() from error
        if not num_slots and not self._deserted:
            _log.warning("Dask scheduler %s has no workers; waiting for one", self._scheduler)
        self._deserted = not num_slots
        return num_slots

    def submit(self, task: Task) -> None:
        work = packed(task)
        try:
            future = self._executor.submit(answer, work)
        except Exception as error:
            raise self._lost() from error
        self._tasks[future] = task
        future.add_done_callback(self._over.put)

    def next_over(self, wait_s: float) -> Outcome | None:
        from distributed.scheduler import KilledWorker

        try:
            future = self._over.get(timeout=wait_s)
        except queue.Empty:
            return None
        task = self._tasks.pop(future)
        try:
            return outcome(task, future.result())
        except KilledWorker as error:
            return given_up(task, error.allowed_failures + 1, "died (killed, or short of memory?)")
        except CancelledError:  # by nobody here: so does a client that lost its scheduler
            raise self._lost() from None

    def _lost(self) -> ComputationError:
        return ComputationError(
            f"the Dask scheduler {self._scheduler} was lost; run the same command again to go on"
        )


def _has_distributed() -> bool:
    with interrupts_held():  # some of the many modules it loads would swallow one
        try:
            import distributed  # noqa: F401
        except ImportError:
            return False
    return True


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
