# SPDX-License-Identifier: MIT
"""Values of arrays and plain numbers as bytes and back; bytes of others are never believed."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from densify.config import cache_codec as codec
from densify.config.cache_codec import DamagedError, decode, encode
from densify.geometry.arrays import Bool, Float, Float32, Int


class Why(NamedTuple):
    reason: str
    unreadable: bool


@dataclass(frozen=True)
class Inner:
    points: Float
    scale: np.float32
    names: tuple[str, ...]


@dataclass
class Outer:
    inner: tuple[Inner, ...]
    pair: tuple[int, float]
    by_frame: Mapping[int, str | Why]
    maybe: Int | None
    free: Sequence[Bool]
    rows: dict[float, NDArray[Any]] = field(default_factory=dict)
    later: Float32 = field(init=False)


def same(a: Any, b: Any) -> bool:
    """In types, values, signs of zero, memory order."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        order = a.flags.c_contiguous == b.flags.c_contiguous
        return a.dtype == b.dtype and a.shape == b.shape and order and a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return repr(a) == repr(b)


def floats(dtype: type = np.float64) -> st.SearchStrategy:
    shapes = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    return st.tuples(arrays.arrays(dtype, shapes), st.sampled_from("CF")).map(
        lambda made: made[0].copy(made[1])
    )


inners = st.builds(
    Inner,
    points=floats(),
    scale=st.floats(width=32).map(np.float32),
    names=st.lists(st.text(), max_size=3).map(tuple),
)


@st.composite
def outers(draw) -> Outer:
    made = Outer(
        inner=tuple(draw(st.lists(inners, max_size=3))),
        pair=(draw(st.integers()), draw(st.floats())),
        by_frame=draw(
            st.dictionaries(st.integers(), st.text() | st.builds(Why, st.text(), st.booleans()))
        ),
        maybe=draw(st.none() | floats(np.int64)),
        free=tuple(draw(st.lists(floats(np.bool_), max_size=2))),
        rows=draw(st.dictionaries(st.floats(allow_nan=False), floats(np.uint8), max_size=2)),
    )
    made.later = draw(floats(np.float32))
    return made


@settings(deadline=None, max_examples=60)
@given(outers())
def test_what_is_kept_comes_back(value: Outer) -> None:
    data = encode(value, Outer)
    found = decode(data, Outer)
    assert same(found, value)
    assert encode(found, Outer) == data


def some() -> Outer:
    points = np.arange(12.0).reshape(4, 3)
    inner = Inner(points, np.float32(0.1), ("a",))
    made = Outer((inner, inner), (1, 2.5), {3: "x", 4: Why("y", True)}, None, ())
    made.later = np.ones((2, 3), np.float32)
    return made


def test_an_array_is_kept_once_and_can_be_written_to() -> None:
    found = decode(encode(some(), Outer), Outer)
    assert found.inner[0].points is found.inner[1].points
    found.later[:] = 0
    assert found.inner[0].points.ctypes.data % 8 == 0


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (np.zeros(3, np.float32), Float),
        (np.array([{}]), NDArray),
        (np.array(["a"]), NDArray),
        (np.zeros(2, [("a", float)]), NDArray),
        (np.float32(1.5), float),
        (True, int),
        (1, bool),
        (None, str),
        (3, str | None),
        ([1], tuple[int, ...]),
        ((1, 2, 3), tuple[int, int]),
        ({"a": 1}, dict[str, str]),
        (object(), object),
        (some(), Inner),
    ],
)
def test_what_is_of_another_type_is_not_kept(value: Any, kind: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        encode(value, kind)


def test_every_flipped_bit_and_every_other_size_is_noticed() -> None:
    whole, chance = encode(some(), Outer), random.Random(1)
    for place in [*range(80), *chance.choices(range(len(whole)), k=100)]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << chance.randrange(8)
        with pytest.raises(DamagedError):
            decode(bytes(damaged), Outer)
    for other in [whole[:n] for n in range(len(whole))] + [whole + b"x", whole + whole]:
        with pytest.raises(DamagedError):
            decode(other, Outer)


def planted(header: Any, data: bytes = b"", num_header: int | None = None) -> bytes:
    """With a right check sum: whoever can write to the folder can make one."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    size = len(text) if num_header is None else num_header
    return codec._sealed(size.to_bytes(8, "little") + text + data)


def one_array(dtype: Any, shape: Any, order: Any = "C", data: bytes = bytes(1000)) -> bytes:
    return planted({"arrays": [[dtype, shape, order]], "value": 0}, data)


HOSTILE = [
    (one_array("<f8", [10**12]), Float),
    (one_array("<f8", [2**62, 4]), Float),
    (one_array("<f8", [-1, -8]), Float),
    (one_array("<f8", [2.0]), Float),
    (one_array("<f8", [True]), Float),
    (one_array("|O", [1]), NDArray),
    (one_array("<f8", [1], "K"), Float),
    (one_array("<f8", [0, 10**30], data=b""), Float),
    (one_array(["<f8"], [1]), Float),
    (one_array("<f4", [1]), Float),
    (one_array("<f8", [1]), Float),
    (planted({"arrays": [], "value": 0}), Float),
    (planted({"arrays": [], "value": -1}), Float),
    (planted({"arrays": [], "value": "__import__"}), int),
    (planted({"arrays": [], "value": [1.5, 2]}), tuple[int, ...]),
    (planted({"arrays": [], "value": [[1, 2, 3]]}), dict[int, int]),
    (planted({"arrays": [], "value": [5, 1]}), int | None),
    (planted({"arrays": [], "value": [0, []]}), str | None),
    (planted({"arrays": [], "value": [[], 1, [], 1]}), Inner),
    (planted({"arrays": [], "value": {"reason": "a", "unreadable": True}}), Why),
    (planted({"value": 1}), int),
    (planted([]), int),
    (planted(b"[" * 100_000), int),
    (planted(b""), int),
    (planted(b"{}", num_header=2**63), int),
    (planted(b"\xff"), int),
]


def test_no_more_is_unpacked_than_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    value = np.zeros(10**6)
    data = encode(value, Float)
    assert len(data) < 50_000
    start = len(codec._MAGIC)
    for said in (0, 100, 8 * 10**6, 10**9, 2**63):
        lengths = codec._LENGTHS.pack(len(data) - codec._START, said)
        with pytest.raises(DamagedError, match="size than it says"):
            decode(data[:start] + lengths + data[start + len(lengths) :], Float)
    monkeypatch.setattr(codec, "MOST_BYTES", 10**6)
    with pytest.raises(DamagedError, match="too large"):
        decode(data, Float)
    with pytest.raises(ValueError, match="bytes"):
        encode(value, Float)


@pytest.mark.parametrize(("data", "kind"), HOSTILE)
def test_bytes_of_others_are_not_believed(data: bytes, kind: Any) -> None:
    with pytest.raises(DamagedError):
        decode(data, kind)
