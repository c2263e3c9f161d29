# SPDX-License-Identifier: MIT
"""The cheap rows of `python -m tests.faults`."""

from __future__ import annotations

import shutil
from pathlib import Path
from random import Random

import pytest

from tests.faults import Bench, faults, tried


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench.of(tmp_path_factory.mktemp("faults").resolve())


@pytest.mark.parametrize("name", ["SIGTERM, 2 worker(s)", "EIO of rename", "EINTR of write"])
def test_the_same_command_makes_it_whole(name: str, bench: Bench) -> None:
    if " of " in name and not (shutil.which("cc") or shutil.which("gcc")):
        pytest.skip("no C compiler for calls that fail")
    tried(bench, faults()[name], Random(name))


def test_what_is_missing_is_noticed(bench: Bench) -> None:
    out: Path = shutil.copytree(bench.whole, bench.place / "less")
    bench.check(out)
    next(out.rglob("*.png")).unlink()
    with pytest.raises(AssertionError):
        bench.check(out)
