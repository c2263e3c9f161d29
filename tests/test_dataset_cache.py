# SPDX-License-Identifier: MIT
"""What was made once is found again: by what it was made from, undamaged, within bounds."""

from __future__ import annotations

import logging
import os
import pickle
import random
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import densify
from densify.config.cache import Cache, digest, steps_folder
from densify.config.errors import InputError
from tests.command import exit_code

LIMIT = 10**9
VALUE = {"noise": np.random.default_rng(1).random((3000, 3)), "few": np.arange(5)}
KIND = dict[str, NDArray]


def get(cache: Cache, inputs=1) -> int:
    """How often it was made; whatever happens, the value is right."""
    calls = []
    found = cache.get("stage", KIND, inputs, lambda: calls.append(1) or VALUE)
    assert found.keys() == VALUE.keys()
    assert all(np.array_equal(found[name], VALUE[name]) for name in VALUE)
    return len(calls)


@dataclass(frozen=True)
class One:
    a: int
    b: float


@dataclass(frozen=True)
class Other:
    a: int
    c: float


DIFFERENT = [
    *(0, 1, True, 1.0, -0.0, "1", "", None, [], [[]], [1], [1, [2]], [[1], 2], [1, 2], "1 2"),
    *(["a", "b"], ["ab"], ["a b"], {1: 2}, {2: 1}, {"a": {"b": 1}}, One(1, 2.0), Other(1, 2.0)),
    *(np.zeros(3), np.zeros((3, 1)), np.zeros(3, np.float32), np.zeros(4), np.zeros(3, np.int64)),
    *(np.array([0, 0, -0.0]), np.array([0, 0, np.nan]), [np.zeros(1), np.zeros(2)], "array"),
    [np.zeros(2), np.zeros(1)],
]


def test_what_differs_has_another_digest() -> None:
    digests = [digest(value) for value in DIFFERENT]
    assert len(set(digests)) == len(digests)


def test_what_is_equal_has_the_same_digest() -> None:
    array = np.arange(24.0).reshape(4, 6)
    assert digest(array[:, ::2]) == digest(array[:, ::2].copy()) == digest(array.T.copy().T[:, ::2])
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest((1, 2)) == digest([1, 2])


@given(st.lists(st.text() | st.integers() | st.floats() | st.lists(st.text()), max_size=4))
def test_a_digest_says_all(values: list) -> None:
    assert digest(values) == digest(list(values))
    assert digest(values) != digest([*values, None])


@pytest.mark.parametrize("value", [object(), b"bytes", {1}, np.float64, range(3)])
def test_what_has_no_digest(value) -> None:
    with pytest.raises(TypeError, match="cannot be told from others"):
        digest([value])


def test_once_for_everybody(tmp_path: Path) -> None:
    assert [get(Cache(LIMIT, tmp_path)) for _ in range(3)] == [1, 0, 0]
    assert get(Cache(LIMIT, tmp_path), 2) == 1
    assert get(Cache(LIMIT, tmp_path / "other")) == 1


def test_what_fails_is_not_kept(tmp_path: Path) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    cache = Cache(LIMIT, tmp_path)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            cache.get("stage", KIND, 1, fail)
    assert get(cache) == 1


def test_every_flipped_bit_is_noticed(tmp_path: Path, caplog) -> None:
    cache = Cache(LIMIT, tmp_path)
    get(cache)
    (path,) = tmp_path.iterdir()
    whole, rng = path.read_bytes(), random.Random(3)
    places = [0, 1, 5, len(whole) - 1, len(whole) - 4, *rng.choices(range(len(whole)), k=60)]
    with caplog.at_level(logging.DEBUG):
        for place in places:
            damaged = bytearray(whole)
            damaged[place] ^= 1 << rng.randrange(8)
            path.write_bytes(damaged)
            assert get(cache) == 1
    assert {record.levelno for record in caplog.records} == {logging.DEBUG}
    assert len(caplog.records) == len(places) and "made anew" in caplog.text
    for length in (0, 1, 10, len(whole) // 2, len(whole) - 10, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert get(cache) == 1
    path.write_bytes(whole + b"x")
    assert get(cache) == 1
    assert get(cache) == 0


class Planted:
    def __reduce__(self):
        return os.mkdir, ("planted",)


def test_nothing_that_others_put_there_is_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    cache = Cache(LIMIT, tmp_path / "cache")
    get(cache)
    (path,) = (tmp_path / "cache").iterdir()
    path.write_bytes(pickle.dumps(Planted()))
    assert get(cache) == 1
    assert not (tmp_path / "planted").exists()


def test_an_entry_larger_than_the_cache_may_be_is_not_read(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    get(cache)
    (path,) = tmp_path.iterdir()
    with path.open("r+b") as file:
        file.truncate(1 << 40)  # of which nothing is on the disk
    assert get(cache) == 1


def test_what_cannot_be_kept_only_costs_time(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    for _ in range(2):
        assert cache.get("stage", dict[str, str], 1, lambda: {"a": 1}) == {"a": 1}
    assert list(tmp_path.iterdir()) == []


def test_the_folder_is_the_users_alone(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(tmp_path / "cache"))
    Cache(LIMIT)
    assert {p.stat().st_mode & 0o777 for p in (tmp_path / "cache", steps_folder())} == {0o700}


@pytest.mark.parametrize("mode", [0o770, 0o702])
@pytest.mark.parametrize("name", ["", "steps", "street"])
def test_a_folder_that_others_can_write_to_is_refused(
    mode: int, name: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(tmp_path / "cache"))
    folder = tmp_path / "cache" / name
    folder.mkdir(parents=True)
    folder.chmod(mode)
    arguments = ["dataset", "--data", "street", "--keys", "1:2", "--out", tmp_path / "out"]
    assert exit_code(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"densify: cache {folder}: others can write to it")
    assert not (tmp_path / "out").exists() and list(folder.rglob("*.*")) == []
    if name != "street":
        with pytest.raises(InputError, match="others can write"):
            Cache(LIMIT)


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    if tmp_path.stat().st_uid == 0:
        os.chown(tmp_path, 12345, -1)
    with pytest.raises(InputError, match="others can write"):
        steps_folder()


def num_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_what_was_used_longest_ago_goes_first(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    get(cache, 0)
    one = num_bytes(tmp_path)
    for inputs in range(1, 6):
        get(cache, inputs)
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0))
    for age, inputs in enumerate([3, 0, 5, 1, 4, 2]):
        assert get(cache, inputs) == 0
        (used,) = [path for path in tmp_path.iterdir() if path.stat().st_mtime > 100]
        os.utime(used, (age, age))
    cache.trim()
    assert len(list(tmp_path.iterdir())) == 6
    Cache(int(2.5 * one), tmp_path).trim()
    assert num_bytes(tmp_path) <= 2.5 * one
    assert [get(cache, inputs) for inputs in (2, 4)] == [0, 0]
    assert [get(cache, inputs) for inputs in (3, 0, 5, 1)] == [1, 1, 1, 1]
    Cache(0, tmp_path).trim()
    assert list(tmp_path.iterdir()) == []


def test_what_killed_processes_left_aside_goes(tmp_path: Path) -> None:
    for name, age_s in (("old.tmp", 7200), ("new.tmp", 5), ("of_somebody", 7200)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    Cache(0, tmp_path).trim()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.tmp", "of_somebody"]


USING = """
import random, sys
from pathlib import Path
from tests.test_dataset_cache import Cache, get
cache, rng = Cache(int(sys.argv[3]), Path(sys.argv[1])), random.Random(int(sys.argv[2]))
made = 0
for _ in range(150):
    made += get(cache, rng.randrange(12))
    cache.trim()
print(made)
"""


def test_several_processes_read_write_and_trim(tmp_path: Path) -> None:
    get(Cache(LIMIT, tmp_path / "size"))
    limit = 4 * num_bytes(tmp_path / "size")
    home = Path(densify.__file__).parents[1]
    path = os.pathsep.join([str(home), str(Path(__file__).parents[1])])
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", USING, str(tmp_path / "shared"), str(seed), str(limit)],
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in (1, 2)
    ]
    for process in processes:
        said, errors = process.communicate(timeout=120)
        assert (process.returncode, errors) == (0, "")
        assert 12 < int(said) < 150
    cache = Cache(limit, tmp_path / "shared")
    cache.trim()
    assert num_bytes(tmp_path / "shared") <= limit
    assert not list((tmp_path / "shared").glob("*.tmp"))
    get(cache)
