# SPDX-License-Identifier: MIT
"""Calls done here, by processes of this machine, and by the workers of a Dask scheduler."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import worker_calls

from densify.config.errors import ComputationError, InputError
from densify.dataset import executor
from densify.dataset.executor import call_all

PATIENCE_S = 60  # before a test that hangs fails
HOME = {**os.environ, "PYTHONPATH": str(Path(executor.__file__).parents[2])}


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


@pytest.fixture(scope="module", params=["here", "processes", "dask"])
def where(request: pytest.FixtureRequest):
    if request.param != "dask":
        yield {"num_workers": 1 if request.param == "here" else 2}
        return
    distributed = pytest.importorskip("distributed")
    options = {"dashboard_address": "127.0.0.1:0", "threads_per_worker": 2}
    with distributed.LocalCluster(n_workers=1, **options) as cluster:
        yield {"scheduler": cluster.scheduler_address}


def test_every_outcome_is_yielded_once(where: dict, tmp_path: Path) -> None:
    groups, log = [[1, 2, 3], [4], [-1, 5], [1000, 1001]], tmp_path / "log"
    yielded = list(call_all(worker_calls.square, groups, log=log, **where))
    outcomes = dict(yielded)
    assert len(yielded) == len(outcomes) == 8
    error = outcomes.pop(-1)
    assert isinstance(error, ComputationError) and "KeyError: 'negative'" in str(error)
    assert outcomes == {n: n * n for n in (1, 2, 3, 4, 5, 1000, 1001)}
    if where.get("num_workers") != 1:
        warnings = sorted(line.partition(" WARNING ")[2] for line in log.read_text().splitlines())
        assert warnings == ["large: 1000", "large: 1001"]
    assert list(call_all(worker_calls.square, [], **where)) == []


def test_the_first_of_a_group_is_over_before_the_others(where: dict, tmp_path: Path) -> None:
    groups = [[(tmp_path, 10 * g + n, n == 0) for n in range(5)] for g in range(6)]
    for (_, _, is_first), there in call_all(worker_calls.note, groups, **where):
        assert there is not is_first


def test_a_death_costs_its_item_alone(tmp_path: Path) -> None:
    groups = [[(tmp_path, 10 * g + n) for n in range(10)] for g in range(2)]
    found = {item[1]: out for item, out in call_all(worker_calls.die_once, groups, 2)}
    error = found.pop(7)
    assert isinstance(error, ComputationError) and "died of it twice" in str(error)
    assert found == {n: n for n in range(20) if n != 7}


def test_cores_are_shared_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    before = dict(os.environ)
    outcomes = [outcome for _, outcome in call_all(worker_calls.threads, [[0], [1]], 2)]
    assert outcomes[0] == ("3", 3, False)  # one worker may call both, and has loaded numba then
    assert {outcome[:2] for outcome in outcomes} == {("3", 3)}
    assert dict(os.environ) == before
    assert executor.share_of_cores(8)["OMP_NUM_THREADS"] == "1"


def test_a_script_without_its_guard_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "unguarded.py"
    script.write_text(
        "from densify.dataset.executor import call_all\nprint(list(call_all(abs, [[1]], 2)))\n"
    )
    done = subprocess.run(
        [sys.executable, script], env=HOME, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 1 and "before they have begun; a script" in done.stderr


MAIN = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import worker_calls
from densify.dataset.executor import call_all
if __name__ == "__main__":
    list(call_all(worker_calls.wait, [[Path(sys.argv[1]) / f"{n}.pid"] for n in range(4)], 2))
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_the_command(how: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(MAIN)
    arguments = [sys.executable, str(script), str(tmp_path), str(Path(__file__).parent)]
    with subprocess.Popen(
        arguments,
        env=HOME,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        places = [tmp_path / f"{n}.pid" for n in range(2)]
        until(lambda: all(place.exists() for place in places))
        process.send_signal(how)
        until(lambda: all(is_gone(int(place.read_text())) for place in places))


def test_a_scheduler_that_is_not_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(executor, "_CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:9: not reached .* expected"):
        list(call_all(abs, [[1]], scheduler="tcp://127.0.0.1:9"))
