# SPDX-License-Identifier: MIT
"""Tasks done here, by plain processes, by a local Dask cluster and by one that runs elsewhere."""

from __future__ import annotations

import logging
import os
import pickle
import random
import re
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import worker_tasks

import densify
from densify.dataset import calls, pools, workers
from densify.dataset.tasks import Outcome, Task, Workers, run_tasks
from densify.dataset.workers import open_workers
from densify.errors import ComputationError, InputError

KINDS = ("here", "pool", "dask")
ELSEWHERE = KINDS[1:]
PATIENCE_S = 60  # before a test that hangs fails


@contextmanager
def opened(kind: str, num_workers: int = 2) -> Iterator[Workers]:
    with pytest.MonkeyPatch.context() as patch:
        if kind == "pool":
            patch.setitem(sys.modules, "distributed", None)
        opening = open_workers(1 if kind == "here" else num_workers)
        found = opening.__enter__()
    with suppress(StopIteration):
        try:
            yield found
        finally:
            opening.__exit__(None, None, None)


@pytest.fixture(scope="module", params=KINDS)
def everywhere(request: pytest.FixtureRequest) -> Iterator[Workers]:
    with opened(request.param) as found:
        yield found


@pytest.fixture(scope="module", params=ELSEWHERE)
def processes(request: pytest.FixtureRequest) -> Iterator[Workers]:
    with opened(request.param) as found:
        yield found


def squares(*numbers: int) -> list[Task]:
    return [Task(("square", n), worker_tasks.square, (n,)) for n in numbers]


def done(tasks: list[Task], found: Workers) -> dict[Any, Outcome]:
    outcomes = list(run_tasks(tasks, found))
    by_name = {outcome.name: outcome for outcome in outcomes}
    assert len(outcomes) == len(by_name) == len(tasks)
    return by_name


def values(outcomes: dict[Any, Outcome]) -> dict[Any, Any]:
    assert all(outcome.error is None for outcome in outcomes.values())
    return {name: outcome.value for name, outcome in outcomes.items()}


def pid_in(place: Path) -> int:
    until(place.exists)
    return int(place.read_text())


def until(what: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.02)


def is_gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


def test_every_value_is_right(everywhere: Workers) -> None:
    found = values(done(squares(*range(40)), everywhere))
    assert found == {("square", n): n * n for n in range(40)}


def test_nothing_to_do(everywhere: Workers) -> None:
    assert list(run_tasks([], everywhere)) == []


def test_none_starts_before_what_it_needs(everywhere: Workers, tmp_path: Path) -> None:
    chance = random.Random(7)
    tasks = []
    for number in range(60):
        # Needs of later tasks of the list too: the order of the list is only a wish.
        needs = [n for n in chance.sample(range(60), 6) if n % 7 < number % 7]
        names = frozenset((f"{n}",) for n in needs)
        arguments = (tmp_path, f"{number}", [str(n) for n in needs])
        tasks.append(Task((f"{number}",), worker_tasks.note, arguments, names))
    assert sum(len(task.needs) for task in tasks) > 60
    assert set(map(tuple, values(done(tasks, everywhere)).values())) == {()}


def test_a_failed_task_stops_no_other(everywhere: Workers) -> None:
    tasks = [
        Task(("fails",), worker_tasks.fail, (KeyError, "frame 3")),
        Task(("after",), worker_tasks.square, (5,), frozenset({("fails",)})),
        *squares(2, 3),
    ]
    found = done(tasks, everywhere)
    error = found.pop(("fails",)).error
    assert type(error) is KeyError and error.args == ("frame 3",)
    assert sorted(values(found).values()) == [4, 9, 25]


def test_errors_and_values_that_do_not_pickle(processes: Workers) -> None:
    tasks = [
        Task(("odd",), worker_tasks.fail, (worker_tasks.TwoPartError, "sweep", "3")),
        Task(("lambda",), worker_tasks.unpicklable),
        *squares(4),
    ]
    found = done(tasks, processes)
    assert isinstance(found["odd",].error, ComputationError)
    assert str(found["odd",].error) == "TwoPartError: sweep 3"
    assert found["lambda",].error is not None
    assert found["square", 4].value == 16


def test_what_workers_log_is_logged_here(
    everywhere: Workers, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "densify")
    done([Task(("warn", n), worker_tasks.warn, (f"cut {n}",)) for n in range(4)], everywhere)
    told = [record for record in caplog.records if record.name == "densify.registration.odometry"]
    assert sorted(r.getMessage().partition(" by ")[0] for r in told) == [
        f"cut {n}" for n in range(4)
    ]
    assert {record.levelno for record in told} == {logging.WARNING}


def test_a_worker_at_two_tasks_keeps_their_logs_apart() -> None:
    """Dask workers that others started may have several threads."""
    with ThreadPoolExecutor(2) as threads:
        works = [pickle.dumps((worker_tasks.warn_together, (n,))) for n in range(2)]
        answers = list(threads.map(calls._call_pickled, works, [logging.INFO] * 2))
    for number, answer in enumerate(answers):
        _, error, _, records = pickle.loads(answer)
        assert error is None and [r.getMessage() for r in records] == [str(number)]


def test_where_a_task_failed_is_in_the_debug_log(
    everywhere: Workers, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "densify")
    done([Task(("register", 12), worker_tasks.fail, (ValueError, "odd"))], everywhere)
    [record] = [r for r in caplog.records if "register 12 failed" in r.getMessage()]
    assert record.levelno == logging.DEBUG
    assert "in fail" in record.getMessage() and "ValueError: odd" in record.getMessage()


def test_other_processes_work(processes: Workers) -> None:
    assert processes.num_slots() == 2
    tasks = [Task((n,), worker_tasks.process) for n in range(20)]
    assert os.getpid() not in values(done(tasks, processes)).values()


def test_a_killed_worker_costs_nothing(processes: Workers, tmp_path: Path) -> None:
    tasks = squares(*range(6))
    tasks.insert(2, Task(("twice",), worker_tasks.square_at_second_try, (tmp_path, 12)))
    killed = False
    found = {}
    for outcome in run_tasks(tasks, processes):
        found[outcome.name] = outcome
        if not killed and len(found) >= 3:
            os.kill(pid_in(tmp_path / "12.pid"), signal.SIGKILL)
            killed = True
    assert values(found) == {("square", n): n * n for n in range(6)} | {("twice",): 144}


def test_a_killer_of_workers_is_given_up(processes: Workers) -> None:
    tasks = squares(*range(12))
    tasks.insert(1, Task(("densify", "0013", 120), worker_tasks.die))
    found = done(tasks, processes)
    error = found.pop(("densify", "0013", 120)).error
    assert isinstance(error, ComputationError)
    assert re.match("densify 0013 120: .* 3 worker processes .* died", str(error))
    assert values(found) == {("square", n): n * n for n in range(12)}


def test_a_task_with_too_much_memory_is_given_up() -> None:
    tasks = [Task(("big",), worker_tasks.fill_memory, (1 << 29,)), *squares(3)]
    with open_workers(2, memory_bytes=2 << 29) as found:
        outcomes = done(tasks, found)
    assert "short of memory" in str(outcomes["big",].error)
    assert outcomes["square", 3].value == 9


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_cores_are_shared_out(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "5")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "6")
    before = dict(os.environ)
    with opened(kind) as found:
        tasks = [Task((n,), worker_tasks.threads) for n in range(2)]
        assert os.environ["NUMBA_NUM_THREADS"] == "6"  # this process's own
        assert set(values(done(tasks, found)).values()) == {("3", 3, False)}
    assert dict(os.environ) == before
    assert pools.share_of_cores(8)["OMP_NUM_THREADS"] == "1"


def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match=r"workers: got 0, expected 1 or more"), open_workers(0):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "localhost", "smoke://signal"])
def test_wrong_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_CONNECT_S", 0.5)
    expected = f"scheduler {address}: not reached .* expected the address"
    with pytest.raises(InputError, match=expected), open_workers(2, address):
        pass


def test_a_scheduler_needs_distributed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    expected = r"pip install 'densify\[cluster\]'"
    with pytest.raises(InputError, match=expected), open_workers(2, "tcp://127.0.0.1:9"):
        pass


class Deserted:
    """Stands for a client of a scheduler without workers."""

    def nthreads(self) -> dict[str, int]:
        return {}

    def get_executor(self, pure: bool) -> None:
        return None


def test_all_local_workers_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_GONE_S", -1.0)
    local = workers._Cluster(Deserted(), "here", local=True)
    assert local.num_slots() == 0
    with pytest.raises(ComputationError, match="same command again"):
        local.num_slots()


def test_a_scheduler_without_workers_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(workers, "_GONE_S", -1.0)
    cluster = workers._Cluster(Deserted(), "tcp://there:8786", local=False)
    assert [cluster.num_slots() for _ in range(3)] == [0, 0, 0]
    assert [r.getMessage() for r in caplog.records] == [
        "Dask scheduler tcp://there:8786 has no workers; waiting for one"
    ]


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Address and process of a Dask scheduler that has two workers of its own."""
    place = tmp_path / "scheduler.json"
    home = Path(densify.__file__).parents[1]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(home), str(Path(__file__).parent), *sys.path])
    }
    dask = [sys.executable, "-m", "dask"]
    started = []

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        command = [*dask, *arguments, "--scheduler-file", str(place)]
        # A session of its own, by which its nannies and workers are ended too.
        started.append(
            subprocess.Popen(
                command, env=environment, cwd=tmp_path, start_new_session=True, **quiet
            )
        )
        return started[-1]

    process = start("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1")
    start("worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard")
    try:
        until(place.exists)
        address = re.search(r"tcp://[0-9.:]+", place.read_text())
        assert address is not None
        yield address.group(), process
    finally:
        for one in started:
            with suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()


def test_a_scheduler_elsewhere(
    scheduler: tuple[str, subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    address, process = scheduler
    with open_workers(1, address) as found:
        tasks = squares(*range(20))
        tasks.insert(3, Task(("twice",), worker_tasks.square_at_second_try, (tmp_path, 12)))
        outcomes = {}
        for outcome in run_tasks(tasks, found):
            outcomes[outcome.name] = outcome
            if len(outcomes) == 10:
                os.kill(pid_in(tmp_path / "12.pid"), signal.SIGKILL)
        assert values(outcomes) == {("square", n): n * n for n in range(20)} | {("twice",): 144}
        tasks = [*squares(3), Task(("long",), worker_tasks.wait, (tmp_path / "long.pid",))]
        left = run_tasks(tasks, found)
        assert next(left).value == 9
        pid_in(tmp_path / "long.pid")
        process.kill()
        with pytest.raises(ComputationError, match=f"{address} was lost; run the same command"):
            next(left)


MAIN = """
import sys
from pathlib import Path
from densify import cli

kind, plan, folder, tests = sys.argv[1:]
if kind == "pool":
    sys.modules["distributed"] = None
sys.path.insert(0, tests)

def work(options):
    import worker_tasks
    from densify.dataset.tasks import Task, run_tasks
    from densify.dataset.workers import open_workers
    tasks = [Task((n,), worker_tasks.square, (n,)) for n in range(2)]
    tasks += [Task((error,), worker_tasks.fail, (error,)) for error in (KeyError, OSError)]
    if "death" in plan:
        tasks.insert(0, Task(("die",), worker_tasks.die))
    places = [Path(folder) / f"{n}.pid" for n in range(4)]
    waits = [Task((place,), worker_tasks.wait, (place,)) for place in places]
    with open_workers(2) as workers:
        print(len(list(run_tasks(tasks, workers))), flush=True)
        if "wait" in plan:
            print(*run_tasks(waits, workers))

class Options:
    verb = staticmethod(work)

cli.parse = lambda _: Options
cli.script()
"""


@contextmanager
def command(kind: str, plan: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A command line of ours that has two workers, in a terminal session of its own."""
    arguments = [sys.executable, "-c", MAIN, kind, plan, str(folder), str(Path(__file__).parent)]
    options = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "start_new_session": True,
        # Where the tests run in the background, interrupts are ignored by whoever they start.
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    }
    with subprocess.Popen(arguments, text=True, **options) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_nothing_but_ours_reaches_the_screen(kind: str, tmp_path: Path) -> None:
    with command(kind, "", tmp_path) as process:
        said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, *said) == (0, "4\n", "")


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_an_interrupt_ends_all(kind: str, tmp_path: Path) -> None:
    # On busy cores a Dask cluster that has lost a worker sometimes does not go on (seen once in
    # twelve; the cause is not known). That is not what is tested here: it is started again.
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with command(kind, "death, wait", folder) as process:
            if attempt < 2 and not started(folder / "0.pid", folder / "1.pid"):
                warnings.warn(f"{kind}: work did not go on after a worker died", stacklevel=1)
                continue
            pids = [pid_in(folder / f"{n}.pid") for n in range(2)]
            os.killpg(process.pid, signal.SIGINT)  # as from a terminal: to the workers too
            said = process.communicate(timeout=PATIENCE_S)
        told = "densify: interrupted; nothing was kept of the unfinished result\n"
        assert (process.returncode, *said) == (130, "5\n", told)
        assert all(map(is_gone, pids))
        return


def started(*places: Path) -> bool:
    """Whether the files appear within half of the usual patience."""
    end = time.monotonic() + PATIENCE_S / 2
    while time.monotonic() < end:
        if all(place.exists() for place in places):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_workers_end_with_a_killed_command(kind: str, tmp_path: Path) -> None:
    with command(kind, "wait", tmp_path) as process:
        pids = [pid_in(tmp_path / f"{n}.pid") for n in range(2)]
        process.kill()
        until(lambda: all(map(is_gone, pids)))
