# SPDX-License-Identifier: MIT
"""The order in which tasks are handed over, whoever does them."""

from __future__ import annotations

import pytest
import worker_tasks

from densify.dataset.tasks import Outcome, Task, Workers, run_tasks


class OneAtATime(Workers):
    """Slots that come and go, each task over only when the test says so."""

    def __init__(self, slots: list[int]) -> None:
        self.slots, self.in_work, self.started = slots, [], []

    def num_slots(self) -> int:
        return self.slots.pop(0) if len(self.slots) > 1 else self.slots[0]

    def submit(self, task: Task) -> None:
        self.in_work.append(task)
        self.started.append(task.name[0])

    def next_over(self, wait_s: float) -> Outcome | None:
        if not self.in_work:
            return None
        return Outcome(self.in_work.pop(0).name, None, None)


def named(*tasks: tuple[str, str]) -> list[Task]:
    """Tasks of one letter, each with the letters that it needs."""
    return [
        Task((n,), worker_tasks.process, (), frozenset((m,) for m in needs)) for n, needs in tasks
    ]


def test_order_is_the_lists_among_the_ready() -> None:
    tasks = named(("z", ""), ("y", "x"), ("d", ""), ("x", ""), ("c", ""), ("b", "z"), ("a", ""))
    order = OneAtATime([1])
    assert [o.name[0] for o in run_tasks(tasks, order)] == order.started == list("zdxycba")


def test_no_more_in_work_than_there_are_workers() -> None:
    found = OneAtATime([0, 0, 2, 2, 1, 1, 1, 3])
    most = []
    for _ in run_tasks(named(*((c, "") for c in "abcdefghij")), found):
        most.append(len(found.in_work))
    assert found.started == list("abcdefghij")
    assert max(most[:2]) == 2 and most[2] == 1 and max(most) == 3


def test_many_tasks_are_no_burden() -> None:
    """Every task is looked at a few times, not once for every other."""
    looks = 0

    class Counted(tuple):  # type: ignore[type-arg]
        def __hash__(self) -> int:
            nonlocal looks
            looks += 1
            return super().__hash__()

    names = [Counted((kind, n)) for kind in "red" for n in range(1000)]
    of = {tuple(name): name for name in names}
    tasks = [
        Task(of["d", n], worker_tasks.process, (), frozenset({of["e", n]})) for n in range(1000)
    ]
    tasks += [
        Task(of["e", n], worker_tasks.process, (), frozenset({of["r", n]})) for n in range(1000)
    ]
    tasks += [Task(of["r", n], worker_tasks.process) for n in range(1000)]
    assert sum(1 for _ in run_tasks(tasks, OneAtATime([8]))) == 3000
    assert looks < 30 * len(tasks)


@pytest.mark.parametrize(
    ("tasks", "words"),
    [
        (named(("a", ""), ("a", "")), "same name"),
        (named(("a", "b")), "'b'.* not in the list"),
        (named(("a", "b"), ("b", "a")), "cycle"),
    ],
    ids=["double", "unknown", "circle"],
)
def test_lists_that_make_no_sense(tasks: list[Task], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        next(run_tasks(tasks, OneAtATime([1])))
