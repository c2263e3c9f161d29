# SPDX-License-Identifier: MIT
"""Mutated files at every door: taken, or refused in a line. `python -m tests.fuzz` does it for
hours; what that found lies in ``corpus/DOOR`` and is tried again here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz import Case, case, what_is_wrong
from tests.fuzz_doors import Door, door, file_doors, trees

CORPUS = Path(__file__).with_name("corpus")
FOUND = sorted(p for p in CORPUS.rglob("*") if p.is_file())
NUM_TREE_CASES = 3


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture
def said(tmp_path: Path) -> Iterator[None]:
    """What libraries write to stderr themselves goes where it is seen."""
    before, log = os.dup(2), os.open(tmp_path / "stderr", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 2)
    yield
    os.dup2(before, 2)
    os.close(before)
    os.close(log)


@pytest.mark.parametrize("path", FOUND, ids=lambda p: p.relative_to(CORPUS).as_posix())
def test_what_was_found_before(path: Path, root: Path, said, tmp_path: Path) -> None:
    name, _, *inside = path.relative_to(CORPUS).parts
    tried = Case(door(name, root), "/".join(inside), path.read_bytes())
    assert what_is_wrong(tried, tmp_path) is None


@pytest.mark.parametrize("name", file_doors())
def test_files(name: str, root: Path, said, tmp_path: Path) -> None:
    chosen = door(name, root)

    @settings(
        max_examples=40,
        derandomize=True,
        database=None,
        deadline=None,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.randoms(use_true_random=False))
    def all_is_well(rng: Random) -> None:
        tried = case(chosen, rng)
        wrong = what_is_wrong(tried, tmp_path)
        assert wrong is None, f"{tried.name} {tried.content[:2000]!r}: {wrong}"

    all_is_well()


@pytest.mark.parametrize("name", trees())
def test_recordings_sets_and_runs(name: str, root: Path, said, tmp_path: Path) -> None:
    chosen = door(name, root)
    for number in range(NUM_TREE_CASES):
        tried = case(chosen, Random(f"{name} {number}"))
        wrong = what_is_wrong(tried, tmp_path)
        assert wrong is None, f"{tried.name}, seed '{name} {number}': {wrong}"


def test_a_door_that_does_not_hold_is_noticed(said, tmp_path: Path) -> None:
    def careless(path: Path) -> None:
        path.read_text("ascii")

    def chatty(path: Path) -> None:
        os.write(2, b"libpng warning: x")

    for use, says in ((careless, "UnicodeDecodeError"), (chatty, "on stderr")):
        wrong = what_is_wrong(Case(Door("a", use, {}), "a", b"\xff"), tmp_path)
        assert wrong is not None and says in wrong
