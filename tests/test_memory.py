# SPDX-License-Identifier: MIT
"""What a run takes is known before it starts, and so is what there is; freed memory is used."""

from __future__ import annotations

from pathlib import Path

import pytest

from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.pipeline import memory
from tests.command import refused
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
    for free in (0.9 * need, None):
        monkeypatch.setattr(memory, "available_bytes", lambda free=free: free)
        memory.check_fits(one_car(), KEY, 2, None, Config())
    monkeypatch.setattr(memory, "available_bytes", lambda: 0.7 * need)
    with pytest.raises(InputError, match=r"--window 2: a run takes about [\d.]+ GB"):
        memory.check_fits(one_car(), KEY, 2, None, Config())
    monkeypatch.setattr(memory, "available_bytes", lambda: 0.3 * GB)
    out = tmp_path / "out"
    for verb, keys, who in (
        ("run", ("--key", "40"), "a run"),
        ("dataset", ("--keys", "40:41"), "a process"),
    ):
        line = refused(capsys, 2, verb, "--data", border_drive, *keys, "--out", out)
        assert f"--window 5: {who} takes about " in line and "0.3 GB are free" in line
    assert not out.exists()


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="not Linux")
def test_what_the_machine_and_its_groups_have_counts(monkeypatch, tmp_path: Path) -> None:
    assert 0.05 * GB < (memory.available_bytes() or 0) < 1e14
    group = tmp_path / "a" / "b"
    group.mkdir(parents=True)
    (group / "memory.max").write_text("max\n")
    stat = "anon 5\ninactive_file 4\nactive_file 3\n"
    for name, text in (("max", "3000"), ("current", "1000"), ("stat", stat)):
        (group.parent / f"memory.{name}").write_text(text)
    monkeypatch.setattr(memory, "_own_groups", lambda: [group, group.parent])
    assert memory.available_bytes() == 2007.0
