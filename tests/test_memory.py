# SPDX-License-Identifier: MIT
"""What a run takes is known before it starts, and so is what there is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from densify.bench import peaks
from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.pipeline import memory
from tests.command import exit_code, refused
from tests.small_street import KEY, one_car

GB = 1e9


def test_more_of_everything_takes_more() -> None:
    sequence, near = one_car(), resolve({"accumulate": {"far_m": 0}})
    usual = memory.need_of_run(sequence, KEY, 2, None, near)
    assert memory.need_of_run(sequence, KEY, 3, None, near) > usual
    assert memory.need_of_run(sequence, KEY, 2, None, Config()) > usual
    assert memory.need_of_run(sequence, KEY, 2, [], near) < usual
    # there are seven sweeps
    few, many = (memory.need_of_run(sequence, KEY, w, None, near) for w in (3, 2 * 10**9))
    assert few == many == memory.need_of_run(sequence, KEY, 3, None, Config())  # none is beyond


def test_a_run_that_cannot_fit_is_not_begun(
    monkeypatch: pytest.MonkeyPatch, border_drive: Path, tmp_path: Path, capsys
) -> None:
    need = memory.need_of_run(one_car(), KEY, 2, None, Config())
    for free, fits in ((0.7 * need, False), (0.9 * need, True), (None, True)):
        monkeypatch.setattr(memory, "available_bytes", lambda free=free: free)
        if fits:
            memory.check_fits(one_car(), KEY, 2, None, Config())
            continue
        with pytest.raises(InputError, match=r"--window 2: a run takes about [\d.]+ GB"):
            memory.check_fits(one_car(), KEY, 2, None, Config())
    monkeypatch.setattr(memory, "available_bytes", lambda: 0.3 * GB)
    out = tmp_path / "out"
    for verb, keys, who in (
        ("run", ("--key", "40"), "a run"),
        ("compare", ("--key", "40"), "a run"),
        ("dataset", ("--keys", "40:41"), "a process"),
    ):
        line = refused(capsys, 2, verb, "--data", border_drive, *keys, "--out", out)
        assert f"--window 5: {who} takes about " in line and "0.3 GB are free" in line
    assert not out.exists()


def test_limits_of_ulimit_count() -> None:
    code = (
        "import resource; from densify.process import memory\n"
        "resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))\n"
        "print(memory.available_bytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 1.5 * GB < float(done.stdout) < 3.2 * GB


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="not Linux")
def test_what_the_machine_has_counts(monkeypatch, tmp_path: Path) -> None:
    (free,) = memory._of_machine()
    assert 0.05 * GB < free < 1e14
    assert (memory.available_bytes() or 0) <= 1.2 * free
    group = tmp_path / "a" / "b"
    group.mkdir(parents=True)
    (group / "memory.max").write_text("max\n")
    for name, text in (
        ("max", "3000"),
        ("current", "1000"),
        ("stat", "anon 5\ninactive_file 4\nactive_file 3\n"),
    ):
        (group.parent / f"memory.{name}").write_text(text)
    monkeypatch.setattr(memory, "_GROUPS", tmp_path)
    monkeypatch.setattr(memory, "_own_group", lambda: group)
    assert list(memory._of_group()) == [2007.0]


def test_the_bench_measures_what_is_said(tmp_path: Path, capsys) -> None:
    """Smallest case: what is said before is no less than a third below what was taken, and what
    the process that measures holds itself does not count."""
    held = np.ones(1_500_000_000, np.uint8)
    (row,) = peaks.bench_memory(120, resolve("fast"), [(16, 1, 2)])
    assert row["points"] > 20_000 and 0.2 < row["peak_gb"] < 1e-9 * len(held)
    assert 0.65 * row["peak_gb"] < row["said_gb"] < 3 * row["peak_gb"]
    assert len(peaks.grid()) == 9
    assert exit_code("bench", "memory", "--rings", "7") == 2
