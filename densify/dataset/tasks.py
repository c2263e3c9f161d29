# SPDX-License-Identifier: MIT
"""Tasks with dependencies, and the loop that has them done."""

from __future__ import annotations

import heapq
import logging
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Any

_log = logging.getLogger("densify")

_POLL_S = 2.0  # between questions how many workers there are


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


class InThisProcess(Workers):
    """No other process: a task is called when its outcome is asked for."""

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
        return outcome_of(task, *called(task.call, *task.arguments))


def called(call: Callable[..., Any], *arguments: Any) -> tuple[Any, Exception | None, str | None]:
    """Value, or the error and its traceback."""
    try:
        return call(*arguments), None, None
    except Exception as error:
        return None, error, traceback.format_exc()


def outcome_of(task: Task, value: Any, error: Exception | None, trace: str | None) -> Outcome:
    """The outcome of a call; where it failed goes to the debug log."""
    if error is not None:
        _log.debug("%s failed: %s", words(task.name), trace)
    return Outcome(task.name, value, error)


def words(name: tuple[Any, ...]) -> str:
    """A task's name for people."""
    return " ".join(str(part) for part in name)
