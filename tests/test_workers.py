# SPDX-License-Identifier: MIT
"""Tasks done here, by processes of this machine, and by the workers of a Dask scheduler."""

from __future__ import annotations

import logging
import multiprocessing
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import worker_tasks

import densify
from densify.config.errors import ComputationError, InputError
from densify.dataset import calls, cluster, processes
from densify.dataset.tasks import Outcome, Task, Workers, run_tasks
from densify.dataset.workers import open_workers

PATIENCE_S = 60  # before a test that hangs fails


@pytest.fixture(scope="module", params=["here", "processes", "dask"])
def everywhere(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Workers]:
    with ExitStack() as stack:
        address = None
        if request.param == "dask":
            pytest.importorskip("distributed")
            folder = tmp_path_factory.mktemp("dask")
            address, _ = stack.enter_context(dask_scheduler(folder))
        found = stack.enter_context(open_workers(1 if request.param == "here" else 2, address))
        if request.param == "dask":
            until(lambda: found.num_slots() == 2)
        yield found


@pytest.fixture(scope="module")
def local() -> Iterator[Workers]:
    with open_workers(2) as found:
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
    except (FileNotFoundError, ProcessLookupError):  # before or while it is read
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


def test_errors_and_values_that_do_not_pickle(local: Workers) -> None:
    tasks = [
        Task(("odd",), worker_tasks.fail, (worker_tasks.TwoPartError, "sweep", "3")),
        Task(("lambda",), worker_tasks.unpicklable),
        *squares(4),
    ]
    found = done(tasks, local)
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


def test_a_worker_at_two_tasks_keeps_their_logs_apart(caplog: pytest.LogCaptureFixture) -> None:
    """Dask workers that others started may have several threads."""
    caplog.set_level(logging.WARNING, "densify")  # and back at the end: a worker sets its own
    tasks = [Task((n,), worker_tasks.warn_together, (n,)) for n in range(2)]
    with ThreadPoolExecutor(2) as threads:
        answers = list(threads.map(calls.answer, map(calls.packed, tasks)))
    for task, answered in zip(tasks, answers, strict=True):
        caplog.clear()
        assert calls.outcome(task, answered).error is None
        assert [r.getMessage() for r in caplog.records] == [str(task.name[0])]


def test_where_a_task_failed_is_in_the_debug_log(
    everywhere: Workers, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "densify")
    done([Task(("register", 12), worker_tasks.fail, (ValueError, "odd"))], everywhere)
    [record] = [r for r in caplog.records if "register 12 failed" in r.getMessage()]
    assert record.levelno == logging.DEBUG
    assert "in fail" in record.getMessage() and "ValueError: odd" in record.getMessage()


def test_other_processes_work(local: Workers) -> None:
    assert local.num_slots() == 2
    tasks = [Task((n,), worker_tasks.process) for n in range(20)]
    assert os.getpid() not in values(done(tasks, local)).values()


def test_a_killed_worker_costs_nothing(local: Workers, tmp_path: Path) -> None:
    tasks = squares(*range(6))
    tasks.insert(2, Task(("twice",), worker_tasks.square_at_second_try, (tmp_path, 12)))
    killed = False
    found = {}
    for outcome in run_tasks(tasks, local):
        found[outcome.name] = outcome
        if not killed and len(found) >= 3:
            os.kill(pid_in(tmp_path / "12.pid"), signal.SIGKILL)
            killed = True
    assert values(found) == {("square", n): n * n for n in range(6)} | {("twice",): 144}


def test_workers_killed_while_idle_cost_nothing(local: Workers) -> None:
    pids = values(done([Task((n,), worker_tasks.process) for n in range(8)], local)).values()
    for pid in set(pids):
        os.kill(pid, signal.SIGKILL)
    assert len(values(done(squares(*range(6)), local))) == 6


def test_workers_killed_at_random_cost_nothing(local: Workers, tmp_path: Path) -> None:
    """One after the other, at any moment of its life: while it starts, too."""
    chance, found = random.Random(3), {}
    tasks = [Task((n,), worker_tasks.nap, (0.02,)) for n in range(60)]
    for number, outcome in enumerate(run_tasks(tasks, local)):
        found[outcome.name] = outcome
        if number % 6 == 0:
            time.sleep(chance.uniform(0.0, 0.1))
            os.kill(chance.choice(children()), signal.SIGKILL)
    assert values(found) == {(n,): None for n in range(60)}


def children() -> list[int]:
    """Worker processes of this process."""
    return [w.pid for w in multiprocessing.active_children() if w.pid is not None]


def test_a_killer_of_workers_is_given_up(local: Workers) -> None:
    tasks = squares(*range(12))
    tasks.insert(1, Task(("densify", "0013", 120), worker_tasks.die))
    found = done(tasks, local)
    error = found.pop(("densify", "0013", 120)).error
    assert isinstance(error, ComputationError)
    assert re.match("densify 0013 120: .* 3 worker processes .* died", str(error))
    assert values(found) == {("square", n): n * n for n in range(12)}


def test_a_task_with_too_much_memory_is_given_up() -> None:
    tasks = [Task(("big",), worker_tasks.fill_memory, (1 << 29,)), *squares(3)]
    with open_workers(2, memory_bytes=2 << 29) as found:
        outcomes = done(tasks, found)
    assert "3 worker processes that tried this took more than its 0.54 GB" in str(
        outcomes["big",].error
    )
    assert outcomes["square", 3].value == 9


def test_workers_that_grew_are_replaced_and_the_work_goes_on() -> None:
    tasks = [Task((n,), worker_tasks.keep_memory, (1 << 27,)) for n in range(12)]
    with open_workers(2, memory_bytes=2 << 29) as found:
        outcomes = values(done(tasks, found))
    assert len(set(outcomes.values())) > 2


def test_workers_that_cannot_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a script that has several processes made by whoever imports it."""
    monkeypatch.setattr(processes, "_serve", worker_tasks.die)
    with (
        pytest.raises(ComputationError, match="before they have begun; a script"),
        open_workers(2) as found,
    ):
        done(squares(1, 2), found)


def test_cores_are_shared_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "5")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "6")
    before = dict(os.environ)
    with open_workers(2) as found:
        tasks = [Task((n,), worker_tasks.threads) for n in range(2)]
        assert os.environ["NUMBA_NUM_THREADS"] == "6"  # this process's own
        assert set(values(done(tasks, found)).values()) == {("3", 3, False)}
    assert dict(os.environ) == before
    assert processes.share_of_cores(8)["OMP_NUM_THREADS"] == "1"


def test_no_worker_listens() -> None:
    """Nobody but this process can send one work."""
    before = listening(os.getpid())
    with socket.create_server(("127.0.0.1", 0)):
        assert len(listening(os.getpid())) == len(before) + 1
    with open_workers(2) as found:
        done(squares(1, 2), found)
        assert listening(os.getpid()) == before
        pids = [pid for pid in children() if not is_gone(pid)]
        assert len(pids) >= 2 and not any(map(listening, pids))


def listening(pid: int) -> set[str]:
    """Sockets of a process on which it accepts connections."""
    sockets = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            sockets.add(os.readlink(entry))
    found = set()
    for table, listens, inode in (("tcp", "0A", 9), ("tcp6", "0A", 9), ("unix", "01", 6)):
        state = 3 if table.startswith("tcp") else 5
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            accepts = table != "unix" or fields[3] == "00010000"
            if fields[state] == listens and accepts:
                found.add(f"socket:[{fields[inode]}]")
    return found & sockets


def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match=r"--workers 0: expected 1 or more"), open_workers(0):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "localhost", "smoke://signal"])
def test_wrong_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
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


def test_a_scheduler_without_workers_is_waited_for(
    caplog: pytest.LogCaptureFixture,
) -> None:
    found = cluster._Cluster(Deserted(), "tcp://there:8786")
    assert [found.num_slots() for _ in range(3)] == [0, 0, 0]
    assert [r.getMessage() for r in caplog.records] == [
        "Dask scheduler tcp://there:8786 has no workers; waiting for one"
    ]


@contextmanager
def dask_scheduler(folder: Path, *options: str) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Address and process of a Dask scheduler that has two workers of its own. options: of both."""
    place = folder / "scheduler.json"
    home = Path(densify.__file__).parents[1]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(home), str(Path(__file__).parent), *sys.path])
    }
    started = []

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        dask = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(place), *options]
        # A session of its own, by which its nannies and workers are ended too.
        started.append(
            subprocess.Popen(dask, env=environment, cwd=folder, start_new_session=True, **quiet)
        )
        return started[-1]

    def written() -> bool:
        """It is there, and empty, before it says where the scheduler is."""
        return place.exists() and place.read_text().rstrip().endswith("}")

    process = start("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1")
    try:
        until(written)
        start("worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard")
        address = re.search(r"(tcp|tls)://[0-9.:]+", place.read_text())
        assert address is not None
        yield address.group(), process
    finally:
        for one in started:
            with suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
            one.wait()


def test_a_scheduler_that_loses_a_worker_and_ends(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with dask_scheduler(tmp_path) as (address, process), open_workers(1, address) as found:
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


def certificate(folder: Path) -> Path:
    """Certificate and key in one file; it vouches for itself."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("no openssl here to make certificates")
    path = folder / "certificate.pem"
    new = [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
    who = ["-nodes", "-days", "2", "-subj", "/CN=densify"]
    files = ["-keyout", str(folder / "key.pem"), "-out", str(path)]
    subprocess.run([*new, *who, *files], check=True, capture_output=True)
    path.write_text(path.read_text() + (folder / "key.pem").read_text())
    return path


def test_a_scheduler_behind_tls(tmp_path: Path) -> None:
    """Who has the certificate gets in, as Dask's own configuration says; others do not."""
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir(), theirs.mkdir()
    pem, other = str(certificate(ours)), str(certificate(theirs))
    options = ("--protocol", "tls", "--tls-ca-file", pem, "--tls-cert", pem)
    with dask_scheduler(tmp_path, *options) as (address, _):
        assert address.startswith("tls://")
        for place in (None, other):
            tls = {"distributed.comm.tls.ca-file": place}
            tls["distributed.comm.tls.client.cert"] = place
            with (
                dask.config.set(tls),
                pytest.raises(InputError, match=r"not reached .* certificates that the scheduler"),
                open_workers(1, address),
            ):
                pass
        tls = {"distributed.comm.tls.ca-file": pem, "distributed.comm.tls.client.cert": pem}
        with dask.config.set(tls), open_workers(1, address) as found:
            assert len(values(done(squares(*range(20)), found))) == 20


MAIN = """
import sys
from pathlib import Path
from densify import cli

plan, folder, tests = sys.argv[1:]
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
        if "write" in plan:
            asides = [place.with_suffix(".aside") for place in places]
            print(*run_tasks([Task((a,), worker_tasks.write_aside, (a,)) for a in asides], workers))
    return []

class Options:
    name, verb = "work", staticmethod(work)

cli.parse = lambda _: Options
cli.script()
"""


@contextmanager
def command(plan: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A command line of ours that has two workers, in a terminal session of its own."""
    arguments = [sys.executable, "-c", MAIN, plan, str(folder), str(Path(__file__).parent)]
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


def test_nothing_but_ours_reaches_the_screen(tmp_path: Path) -> None:
    with command("", tmp_path) as process:
        said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, *said) == (0, "4\n", "")


def test_an_interrupt_ends_all(tmp_path: Path) -> None:
    with command("death, wait", tmp_path) as process:
        pids = [pid_in(tmp_path / f"{n}.pid") for n in range(2)]
        os.killpg(process.pid, signal.SIGINT)  # as from a terminal: to the workers too
        said = process.communicate(timeout=PATIENCE_S)
    told = "densify: interrupted; what was unfinished is not kept\n"
    assert (process.returncode, *said) == (130, "5\n", told)
    assert all(map(is_gone, pids))


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_workers_end_with_a_killed_command(how: signal.Signals, tmp_path: Path) -> None:
    with command("wait", tmp_path) as process:
        pids = [pid_in(tmp_path / f"{n}.pid") for n in range(2)]
        process.send_signal(how)
        until(lambda: all(map(is_gone, pids)))


def test_an_ended_worker_clears_away_what_it_writes(tmp_path: Path) -> None:
    with command("write", tmp_path) as process:
        until(lambda: len(list(tmp_path.glob("*.aside"))) == 2)
        process.kill()
        until(lambda: not list(tmp_path.glob("*.aside")))
