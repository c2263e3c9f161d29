# SPDX-License-Identifier: MIT
"""Tasks with dependencies, called by several processes: in this one, in a few of this machine, or
wherever a Dask scheduler has workers.

A task may be called twice: if a worker process dies, what it was at is done again elsewhere. What
a worker logs below ``densify`` comes back with its answer and is logged in this process.
"""

from __future__ import annotations

import asyncio
import heapq
import logging
import logging.handlers
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from graphlib import TopologicalSorter
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from densify.errors import ComputationError, InputError

_log = logging.getLogger("densify")

_TRIES = 3  # workers that may die of one task
_CONNECT_S = 10
_POLL_S = 2.0  # between questions how many workers there are
_GONE_S = 60.0  # a local worker is back within seconds
_CLOSE_S = 1.0  # what a Dask worker may take to end in peace


@dataclass(frozen=True)
class Task:
    """One call, ``call(*arguments)``, by whichever process is free.

    call: a function of a module, for a worker gets its name only. arguments: picklable and small.
    needs: names of the tasks of the same list that must be over before, done or failed.
    """

    name: tuple[Any, ...]
    call: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    needs: frozenset[tuple[Any, ...]] = frozenset()


@dataclass(frozen=True)
class Outcome:
    """What a task returned, or the exception that ended it; a ComputationError if every worker
    that tried it died."""

    name: tuple[Any, ...]
    value: Any
    error: Exception | None


class Workers(ABC):
    """Where tasks are called. `open_workers` makes one, `run_tasks` uses it, once at a time."""

    @abstractmethod
    def num_slots(self) -> int:
        """How many tasks can be worked at now. Workers may come and go."""

    @abstractmethod
    def submit(self, task: Task) -> None:
        """Hand over a task; at most as many at a time as there are slots.

        So none is queued behind another, and is blamed if a worker dies of that one.
        """

    @abstractmethod
    def next_over(self, wait_s: float) -> Outcome | None:
        """The next task that is over; None if there is none within the time.

        Raises ComputationError if the workers are lost for good.
        """


def run_tasks(tasks: Sequence[Task], workers: Workers) -> Iterator[Outcome]:
    """Do all tasks, those first in the list that are ready, and yield each as soon as it is over.

    If the iteration is left early, the workers are of no more use: leave `open_workers` as well.
    Raises ValueError if names are double or unknown or the needs go in a circle, ComputationError
    if the workers are lost for good.
    """
    waiting = _Waiting(tasks)
    num_in_flight = 0
    outcome = None
    while True:
        num_free = workers.num_slots() - num_in_flight
        while num_free > 0 and (task := waiting.pop()) is not None:
            workers.submit(task)
            num_in_flight += 1
            num_free -= 1
        if outcome is not None:  # only now, so that no worker is idle while the caller is busy
            yield outcome
        if not waiting.left():
            return
        outcome = workers.next_over(_POLL_S)
        if outcome is not None:
            num_in_flight -= 1
            waiting.over(outcome.name)


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
        yield _InThisProcess()
        return
    elif _has_distributed():
        opened = _local_cluster(num_workers, memory_bytes)
    else:
        opened = _pools(num_workers)
    with opened as workers:
        yield workers


class _Waiting:
    """Tasks that were not handed over yet, in the order of the list among those that are ready."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._tasks = tasks
        self._position = {task.name: position for position, task in enumerate(tasks)}
        if len(self._position) < len(tasks):
            raise ValueError("two tasks have the same name")
        for task in tasks:
            for need in task.needs:
                if need not in self._position:
                    raise ValueError(f"task {task.name} needs {need}, which is not in the list")
        self._graph = TopologicalSorter({task.name: task.needs for task in tasks})
        self._graph.prepare()
        self._ready: list[int] = []

    def pop(self) -> Task | None:
        for name in self._graph.get_ready():
            heapq.heappush(self._ready, self._position[name])
        return self._tasks[heapq.heappop(self._ready)] if self._ready else None

    def over(self, name: tuple[Any, ...]) -> None:
        self._graph.done(name)

    def left(self) -> bool:
        """Whether there are tasks that are not over."""
        return self._graph.is_active()


class _InThisProcess(Workers):
    def __init__(self) -> None:
        self._task: Task | None = None

    def num_slots(self) -> int:
        return 1

    def submit(self, task: Task) -> None:
        self._task = task

    def next_over(self, wait_s: float) -> Outcome | None:
        task, self._task = self._task, None
        if task is None:
            return None
        return _outcome(task, *_called(task.call, *task.arguments))


class _Elsewhere(Workers):
    """Workers that give a future for a call."""

    def __init__(self) -> None:
        self._tasks: dict[Future[bytes], Task] = {}
        self._over: queue.SimpleQueue[Future[bytes]] = queue.SimpleQueue()

    @abstractmethod
    def _start(self, *call: Any) -> Future[bytes]:
        """Have ``call[0](*call[1:])`` called."""

    @abstractmethod
    def _answer(self, task: Task, future: Future[bytes]) -> bytes | None:
        """What came of it, None if the task was submitted again; raises _WorkersDied."""

    def submit(self, task: Task) -> None:
        # Pickled here and not on the way, where each kind of workers fails in its own manner.
        work = pickle.dumps((task.call, task.arguments))
        future = self._start(_answer, work, _log.getEffectiveLevel())
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
        except _WorkersDied as died:
            return Outcome(task.name, None, ComputationError(f"{_words(task.name)}: {died}"))
        if answer is None:
            return None
        value, error, trace, records = pickle.loads(answer)
        for record in records:
            logging.getLogger(record.name).handle(record)
        return _outcome(task, None if value is None else pickle.loads(value), error, trace)


class _WorkersDied(Exception):
    def __init__(self, times: int) -> None:
        super().__init__(
            f"each of the {times} worker processes that tried this died (killed, or short of "
            "memory?); try again with fewer workers"
        )


class _Pools(_Elsewhere):
    """One pool of one process for each worker: a pool breaks as a whole if a process dies, so
    that nobody could tell of which task, and the others would be lost with it."""

    def __init__(self, num_workers: int, lifeline: Connection) -> None:
        super().__init__()
        self._begin = (lifeline, _share_of_cores(num_workers))
        self._idle = [self._new() for _ in range(num_workers)]
        self._busy: dict[Future[bytes], ProcessPoolExecutor] = {}
        self._num_workers = num_workers
        self._deaths: Counter[tuple[Any, ...]] = Counter()

    def num_slots(self) -> int:
        return self._num_workers

    def close(self) -> None:
        """To be called when the lifeline is cut."""
        for pool in (*self._idle, *self._busy.values()):
            pool.shutdown(wait=True, cancel_futures=True)

    def _new(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, _begin_worker, self._begin)

    def _start(self, *call: Any) -> Future[bytes]:
        pool = self._idle.pop()
        with _no_interrupts_for_children():
            try:
                future = pool.submit(*call)
            except BrokenProcessPool:  # the process died while it had nothing to do
                pool = self._new()
                future = pool.submit(*call)
        self._busy[future] = pool
        return future

    def _answer(self, task: Task, future: Future[bytes]) -> bytes | None:
        pool = self._busy.pop(future)
        try:
            answer = future.result()
        except BrokenProcessPool:
            pool.shutdown(wait=False)
            self._idle.append(self._new())
            self._deaths[task.name] += 1
            if self._deaths[task.name] == _TRIES:
                raise _WorkersDied(_TRIES) from None
            self.submit(task)
            return None
        self._idle.append(pool)
        return answer


class _Cluster(_Elsewhere):
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
            raise _WorkersDied(error.allowed_failures + 1) from None
        except CancelledError:  # by nobody here: so does a client that lost its scheduler
            raise self._lost() from None

    def _lost(self) -> ComputationError:
        return ComputationError(
            f"the Dask scheduler {self._where} was lost; run the same command again to go on"
        )


@contextmanager
def _pools(num_workers: int) -> Iterator[Workers]:
    lifeline, ours = multiprocessing.get_context("spawn").Pipe(duplex=False)
    pools = _Pools(num_workers, lifeline)
    try:
        yield pools
    finally:
        ours.close()
        pools.close()
        lifeline.close()


@contextmanager
def _local_cluster(num_workers: int, memory_bytes: int | None) -> Iterator[Workers]:
    import dask
    from distributed import Client, LocalCluster

    threads = _share_of_cores(num_workers)
    # The workers import numpy before they take over `env`, so its threads go by this process's
    # environment. Numba, which reads it again with every compilation, must not see it there.
    early = {name: value for name, value in threads.items() if not name.startswith("NUMBA")}
    early["DASK_LOGGING__DISTRIBUTED"] = "critical"
    settings = {
        "distributed.nanny.pre-spawn-environ": early,
        "distributed.deploy.lost-worker-timeout": "1 hour",
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.profile.enabled": False,
        # Nothing is kept that could be spilled, and a worker that only pauses would never go on.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
    }
    with ExitStack() as stack:
        stack.enter_context(_silent_dask())
        stack.enter_context(_restored_environment(*early, "PYTHONHASHSEED"))
        stack.enter_context(dask.config.set(settings))
        with _no_interrupts_for_children():
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=num_workers,
                    threads_per_worker=1,
                    memory_limit=memory_bytes and memory_bytes // num_workers,
                    dashboard_address=None,
                    silence_logs=False,
                    scheduler_kwargs={"allowed_failures": _TRIES - 1},
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


def _has_distributed() -> bool:
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


def _called(
    call: Callable[..., Any], *arguments: Any
) -> tuple[Any, Exception | None, str | None]:
    """Value, or the error and its traceback."""
    try:
        return call(*arguments), None, None
    except Exception as error:
        return None, error, traceback.format_exc()


def _outcome(task: Task, value: Any, error: Exception | None, trace: str | None) -> Outcome:
    if error is not None:
        _log.debug("%s failed: %s", _words(task.name), trace)
    return Outcome(task.name, value, error)


def _words(name: tuple[Any, ...]) -> str:
    return " ".join(str(part) for part in name)


def _answer(work: bytes, level: int) -> bytes:
    """In the worker: call what is pickled; value or error, traceback, log records, pickled."""
    kept = _Kept()
    _log.addHandler(kept)
    _log.setLevel(level)
    try:
        value, error, trace = _called(_unpacked, work)
    finally:
        _log.removeHandler(kept)
    return pickle.dumps((value, error and _portable(error), trace, kept.queue))


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

    queue: list[logging.LogRecord]

    def __init__(self) -> None:
        super().__init__([])  # type: ignore[arg-type]
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:  # a Dask worker may be at several tasks
            super().emit(record)

    def enqueue(self, record: logging.LogRecord) -> None:
        self.queue.append(record)


def _begin_worker(lifeline: Connection, environment: Mapping[str, str]) -> None:
    """First thing in a process of a pool; such a one does not end with its parent by itself."""
    os.environ.update(environment)

    def end_with_parent() -> None:
        with suppress(EOFError, OSError):
            lifeline.recv()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _share_of_cores(num_workers: int) -> dict[str, str]:
    """What a worker's libraries are told about their number of threads."""
    share = str(max(1, len(os.sched_getaffinity(0)) // num_workers))
    return {
        f"{library}_NUM_THREADS": share for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")
    } | {"OPENCV_FOR_THREADS_NUM": share}


@contextmanager
def _no_interrupts_for_children() -> Iterator[None]:
    """Threads and processes started in the block do not get the Ctrl-C of the terminal."""
    resource_tracker.ensure_running()  # else started with the first child: it lifts the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _silent_dask() -> Iterator[None]:
    """What Dask would tell on the screen is of no help to who does not know of its workers."""
    import distributed  # noqa: F401  sets the levels itself when it is loaded

    names = ("distributed", "distributed.client", "distributed.gc", "tornado", "asyncio")
    names += ("tornado.application",)
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def _restored_environment(*names: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
