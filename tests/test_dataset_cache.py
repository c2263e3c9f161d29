# SPDX-License-Identifier: MIT
"""What was made once is found again: by what it was made from, undamaged, within bounds."""

from __future__ import annotations

import logging
import os
import random
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import densify
from densify.cache import Cache, digest

LIMIT = 10**9
VALUE = {"noise": np.random.default_rng(1).random((3000, 3)), "few": np.arange(5)}


def get(cache: Cache, inputs=1) -> int:
    """How often it was made; whatever happens, the value is right."""
    calls = []
    found = cache.get("stage", inputs, lambda: calls.append(1) or VALUE)
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
            cache.get("stage", 1, fail)
    assert get(cache) == 1


def test_every_flipped_bit_is_noticed(tmp_path: Path, caplog) -> None:
    cache = Cache(LIMIT, tmp_path)
    get(cache)
    (path,) = tmp_path.rglob("output.pkl")
    whole, rng = path.read_bytes(), random.Random(3)
    places = [0, 1, 5, len(whole) - 1, len(whole) - 4, *rng.choices(range(len(whole)), k=60)]
    with caplog.at_level(logging.DEBUG):
        for place in places:
            damaged = bytearray(whole)
            damaged[place] ^= 1 << rng.randrange(8)
            path.write_bytes(damaged)
            get(cache)
    assert caplog.records == []
    for length in (0, 1, 10, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:length])
        assert get(cache) == 1
    assert get(cache) == 0


def num_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_what_was_used_longest_ago_goes_first(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    get(cache, 0)
    one = num_bytes(tmp_path)
    for inputs in range(1, 6):
        get(cache, inputs)
    for age, inputs in enumerate([3, 0, 5, 1, 4, 2]):
        before = {path: path.stat().st_atime_ns for path in tmp_path.rglob("output.pkl")}
        get(cache, inputs)
        for path, seen_ns in before.items():
            if path.stat().st_atime_ns != seen_ns:
                os.utime(path, (age, age))
                os.utime(path.parent, (age, age))
    cache.trim()
    assert len(list(tmp_path.rglob("output.pkl"))) == 6
    Cache(int(2.5 * one), tmp_path).trim()
    assert num_bytes(tmp_path) <= 2.5 * one
    assert [get(cache, inputs) for inputs in (2, 4)] == [0, 0]
    assert [get(cache, inputs) for inputs in (3, 0, 5, 1)] == [1, 1, 1, 1]
    Cache(0, tmp_path).trim()
    assert list(tmp_path.rglob("output.pkl")) == []


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
    assert num_bytes(tmp_path / "shared") <= limit + 2000  # the code beside the entries
    assert not [p for p in (tmp_path / "shared").rglob("*.thread-*")]
    get(cache)
