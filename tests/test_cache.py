# SPDX-License-Identifier: MIT
"""What was made once is found again: by what it was made from, undamaged, within bounds."""

from __future__ import annotations

import os
import pickle
import random
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from densify.config import cache as cache_module
from densify.config.cache import Cache, code_digest, digest
from densify.config.errors import InputError
from tests.command import exit_code

LIMIT = 10**9
VALUE = {"noise": np.random.default_rng(1).random((300, 3)), "few": np.arange(5)}


def get(cache: Cache, inputs: Any = 1) -> int:
    """How often it was made; whatever happens, the value is right."""
    calls: list[int] = []
    found = cache.get("stage", inputs, lambda: calls.append(1) or VALUE)
    assert found.keys() == VALUE.keys()
    assert all(np.array_equal(found[name], VALUE[name]) for name in VALUE)
    return len(calls)


# Values


class Why(NamedTuple):
    reason: str
    unreadable: bool


@dataclass
class Outer:
    points: NDArray[np.float64]
    scale: np.float32
    pair: tuple[int, float]
    by_frame: Mapping[int, str | Why]
    rows: Sequence[list[bool]]
    later: NDArray[np.float32] = field(init=False)


def same(a: Any, b: Any) -> bool:
    """In types, values, signs of zero, memory order."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        order = a.flags.c_contiguous == b.flags.c_contiguous
        return a.dtype == b.dtype and a.shape == b.shape and order and a.tobytes() == b.tobytes()
    if hasattr(a, "__dataclass_fields__"):
        return same(vars(a), vars(b))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return repr(a) == repr(b)


def test_what_is_kept_comes_back(tmp_path: Path) -> None:
    turned = np.asfortranarray(np.arange(12.0).reshape(4, 3))
    by_frame = {3: "ä", -4: Why("y", True)}
    value = Outer(turned, np.float32(np.nan), (1 << 60, 1 / 3), by_frame, ([True], []))
    value.later = np.zeros((0, 3), np.float32)
    values = [value, (np.array(-0.0), None, "x", ())]
    cache = Cache(LIMIT, tmp_path)
    assert cache.get("outer", 1, lambda: values) is values
    again = cache.get("outer", 1, lambda: None)
    assert same(again, values)
    again[0].later += 1  # writable


def test_what_has_other_parts_is_not_kept(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    for value in (object(), np.array([{}]), {1, 2}):
        assert cache.get("stage", 1, lambda value=value: value) is value
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError):
        cache.get("stage", 1, lambda: 1 / 0)
    assert get(cache) == 1


DIFFERENT = [
    *(0, 1, True, 1.5, -0.0, "1", "", None, [], [[]], [1], [1, [2]], [[1], 2], [1, 2], "1 2"),
    *(["a", "b"], ["ab"], ["a b"], {1: 2}, {2: 1}, {"a": {"b": 1}}, Why("a", True), np.float32(0)),
    *(np.zeros(3), np.zeros((3, 1)), np.zeros(3, np.float32), np.zeros(4), np.zeros(3, np.int64)),
    *(np.array([0, 0, -0.0]), np.array([0, 0, np.nan]), [np.zeros(1), np.zeros(2)], "array"),
    [np.zeros(2), np.zeros(1)],
]


def test_digests() -> None:
    digests = [digest(value) for value in DIFFERENT]
    assert len(set(digests)) == len(digests)
    assert [digest(value) for value in DIFFERENT] == digests
    array = np.arange(24.0).reshape(4, 6)
    assert digest(array[:, ::2]) == digest(array[:, ::2].copy()) == digest(array.T.copy().T[:, ::2])
    for value in (object(), b"bytes", {1}, np.float64):
        with pytest.raises(TypeError):
            digest([value])


# Entries


def test_once_for_everybody_and_each_version(tmp_path: Path, monkeypatch) -> None:
    assert [get(Cache(LIMIT, tmp_path)) for _ in range(3)] == [1, 0, 0]
    assert get(Cache(LIMIT, tmp_path), 2) == 1
    assert get(Cache(LIMIT, tmp_path / "other")) == 1
    monkeypatch.setattr(cache_module, "__version__", "0.0.0")
    assert [get(Cache(LIMIT, tmp_path)) for _ in range(2)] == [1, 0]


def test_code_that_makes_other_results_has_another_digest(tmp_path: Path, monkeypatch) -> None:
    package = tmp_path / "densify"
    for name in ("config/cache.py", "flow/tracking/vote.py", "outputs/plots.py"):
        (package / name).parent.mkdir(parents=True)
        (package / name).write_text("one\n")
    monkeypatch.setattr(cache_module, "__file__", str(package / "config/cache.py"))
    digests = []
    for changed in ("outputs/plots.py", "flow/tracking/vote.py"):
        (package / changed).write_text("two\n")
        code_digest.cache_clear()
        digests.append(code_digest())
    code_digest.cache_clear()
    assert digests[0] != digests[1]


class Planted:
    def __reduce__(self):
        return os.mkdir, ("planted",)


def test_damaged_and_foreign_entries_are_made_again(tmp_path: Path, monkeypatch, caplog) -> None:
    monkeypatch.chdir(tmp_path)
    cache = Cache(LIMIT, tmp_path / "cache")
    get(cache)
    (path,) = (tmp_path / "cache").iterdir()
    whole, chance = path.read_bytes(), random.Random(3)
    objects = tmp_path / "objects.npz"
    np.savez(objects, json=np.array([Planted()], object))
    bad = [whole[:n] for n in (0, 10, len(whole) // 2, len(whole) - 1)]
    bad += [chance.randbytes(len(whole)), pickle.dumps(Planted()), objects.read_bytes()]
    for at in chance.choices(range(300, len(whole) - 600), k=10):
        bad.append(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    for data in bad:
        path.write_bytes(data)
        get(cache)
        assert get(cache) == 0
    path.unlink()
    path.mkdir()
    assert get(cache) == 1
    assert not (tmp_path / "planted").exists() and not caplog.records


def test_what_was_used_longest_ago_goes_first(tmp_path: Path) -> None:
    cache = Cache(LIMIT, tmp_path)
    for inputs in range(4):
        get(cache, inputs)
        (made,) = [path for path in tmp_path.iterdir() if path.stat().st_mtime > 100]
        os.utime(made, (inputs, inputs))
    assert get(cache, 0) == 0  # used again
    Cache(int(2.5 * made.stat().st_size), tmp_path).trim()
    assert [get(cache, inputs) for inputs in (0, 3, 1)] == [0, 0, 1]
    Cache(0, tmp_path).trim()
    assert list(tmp_path.iterdir()) == []


def test_one_of_several_at_once_makes_it(tmp_path: Path) -> None:
    made: list[int] = []

    def make() -> dict[str, Any]:
        made.append(1)
        time.sleep(0.2)
        return VALUE

    with ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(Cache(LIMIT, tmp_path).get, "s", 1, make) for _ in range(4)]
        assert all(np.array_equal(f.result()["few"], VALUE["few"]) for f in futures)
    assert len(made) == 1
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


# Folders


def test_the_folder_is_the_users_alone(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(tmp_path / "cache"))
    get(Cache())
    assert (tmp_path / "cache" / "steps").stat().st_mode & 0o777 == 0o700
    os.chown(tmp_path / "cache", 12345, -1)
    monkeypatch.setattr(os, "getuid", lambda: 1)
    with pytest.raises(InputError, match="others can write"):
        Cache()


@pytest.mark.parametrize(("mode", "name"), [(0o770, ""), (0o702, "steps")])
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
