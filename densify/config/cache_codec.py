# SPDX-License-Identifier: MIT
"""Values made of arrays and plain numbers as bytes, and back.

A header in JSON and the arrays' raw bytes behind it, as safetensors has them, which by itself
keeps neither structure nor memory order, nor a check sum; compressed, for much of it repeats. What
is built from the bytes is said by the type that the reader expects, never by the bytes: dataclasses
and named tuples by the types of their fields, tuples, lists, mappings, unions, arrays, numbers,
text. Nothing in them can be run, and nothing is made that is larger than `MOST_BYTES`.

    MAGIC, number of bytes compressed and not (8 each), BLAKE2b of the compressed ones (32)
    compressed: number of bytes of the header (8)
                header {"arrays": [[dtype, shape, order]], "value": …}
                the arrays, each from a multiple of 64 bytes on
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import struct
import types
import typing
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

MOST_BYTES = 1 << 30
"""No value is larger as bytes, compressed or not."""
_MAGIC = b"densify cache 1\n"
_LENGTHS = struct.Struct("<QQ")
_DTYPES = ("|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")
_PLAIN = (bool, int, float, str, type(None))
_ALIGNED = 64
_DIGEST_BYTES = 32
_START = len(_MAGIC) + _LENGTHS.size + _DIGEST_BYTES
_ZLIB_LEVEL = 1


class DamagedError(Exception):
    """The bytes are not what `encode` made of a value of the type."""


def encode(value: Any, kind: Any) -> bytes:
    """A value of that type as bytes. Raises TypeError if it is of another, or has other parts than
    the above, ValueError if it is too large."""
    writer = _Writer()
    tree = writer.tree(value, kind)
    arrays = [[a.dtype.str, a.shape, _order(a)] for a in writer.arrays]
    header = json.dumps({"arrays": arrays, "value": tree}).encode()
    body = bytearray(len(header).to_bytes(8, "little") + header)
    for array in writer.arrays:
        body += bytes(-len(body) % _ALIGNED)
        body += array.tobytes("A")
    if len(body) > MOST_BYTES:
        raise ValueError(f"{len(body)} bytes")
    return _sealed(body)


def decode(data: bytes, kind: Any) -> Any:
    """The value of that type. Raises DamagedError, before anything is decoded if size or check sum
    are wrong."""
    body = _unsealed(data)
    try:
        num_header = int.from_bytes(body[:8], "little")
        header = json.loads(bytes(body[8 : 8 + num_header]))
        arrays = list(_arrays(body, 8 + num_header, header["arrays"]))
        return _Reader(arrays).value(header["value"], kind)
    except Exception as error:  # whoever can write a check sum can write anything
        raise DamagedError(f"no {kind}: {type(error).__name__}: {error}") from None


def _sealed(body: bytes | bytearray) -> bytes:
    packed = zlib.compress(body, _ZLIB_LEVEL)
    digest = hashlib.blake2b(packed, digest_size=_DIGEST_BYTES).digest()
    return _MAGIC + _LENGTHS.pack(len(packed), len(body)) + digest + packed


def _unsealed(data: bytes) -> memoryview:
    """The inverse, or DamagedError."""
    head, packed = data[:_START], memoryview(data)[_START:]
    if len(head) < _START or not head.startswith(_MAGIC):
        raise DamagedError("no entry of this version")
    num_packed, num_bytes = _LENGTHS.unpack_from(head, len(_MAGIC))
    if num_packed != len(packed) or num_bytes > MOST_BYTES:
        raise DamagedError("another size than it says, or too large")
    if not head.endswith(hashlib.blake2b(packed, digest_size=_DIGEST_BYTES).digest()):
        raise DamagedError("another check sum than it says")
    unpack = zlib.decompressobj()
    try:
        body = unpack.decompress(packed, num_bytes + 1)
    except zlib.error as error:
        raise DamagedError(str(error)) from None
    if len(body) != num_bytes or not unpack.eof or unpack.unused_data:
        raise DamagedError("another size than it says")
    return memoryview(body)


def _arrays(body: memoryview, at: int, table: list[Any]) -> Iterator[np.ndarray]:
    """Writable copies, each aligned."""
    for name, shape, order in table:
        if name not in _DTYPES or order not in ("C", "F") or not all(map(_is_count, shape)):
            raise ValueError(f"an array of {name}, {shape}, {order}")
        dtype, at = np.dtype(name), at + -at % _ALIGNED
        end = at + math.prod(shape) * dtype.itemsize
        if end > len(body):
            raise ValueError("an array that is not there")
        flat = np.frombuffer(body[at:end], dtype)
        yield flat.reshape(shape, order=order).copy(order)
        at = end
    if at != len(body):
        raise ValueError("more than the arrays")


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _order(array: np.ndarray) -> str:
    return "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"


class _Writer:
    """arrays: what was met so far, each once."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self._index: dict[int, int] = {}

    def tree(self, value: Any, kind: Any) -> Any:
        members = _members(kind)
        if members is not None:
            number = next((i for i, m in enumerate(members) if _fits(value, m)), None)
            if number is None:
                raise TypeError(f"expected {kind}, got {type(value).__name__}")
            return [number, self.tree(value, members[number])]
        if not _fits(value, kind):
            raise TypeError(f"expected {kind}, got {_described(value)}")
        origin = typing.get_origin(kind) or kind
        if origin is np.ndarray:
            return self._array(value)
        if origin in _PLAIN:
            return value if value is None else origin(value)
        if issubclass(origin, np.generic):
            return value.item()
        if (fields := _fields(origin)) is not None:
            return [self.tree(getattr(value, name), k) for name, k in fields.items()]
        if issubclass(origin, Mapping):
            key, item = typing.get_args(kind)
            return [[self.tree(k, key), self.tree(v, item)] for k, v in value.items()]
        return [self.tree(v, k) for v, k in zip(value, _items(kind, len(value)), strict=True)]

    def _array(self, array: np.ndarray) -> int:
        if array.dtype.str not in _DTYPES:
            raise TypeError(f"an array of {array.dtype}")
        if id(array) not in self._index:
            self._index[id(array)] = len(self.arrays)
            self.arrays.append(array)
        return self._index[id(array)]


class _Reader:
    def __init__(self, arrays: list[np.ndarray]) -> None:
        self._arrays = arrays

    def value(self, tree: Any, kind: Any) -> Any:
        members = _members(kind)
        if members is not None:
            number, part = tree
            return self.value(part, members[number])
        value, origin = tree, typing.get_origin(kind) or kind
        if origin is np.ndarray:
            value = self._arrays[tree]
        elif isinstance(origin, type) and issubclass(origin, np.generic):
            value = origin(tree)
        elif (fields := _fields(origin)) is not None:
            parts = [self.value(t, k) for t, k in zip(tree, fields.values(), strict=True)]
            value = _built(origin, dict(zip(fields, parts, strict=True)))
        elif origin not in _PLAIN and issubclass(origin, Mapping):
            key, item = typing.get_args(kind)
            value = {self.value(k, key): self.value(v, item) for k, v in tree}
        elif origin not in _PLAIN and issubclass(origin, Sequence):
            parts = [self.value(t, k) for t, k in zip(tree, _items(kind, len(tree)), strict=True)]
            value = parts if issubclass(origin, list) else tuple(parts)
        if not _fits(value, kind):
            raise TypeError(f"expected {kind}, got {_described(value)}")
        return value


def _fits(value: Any, kind: Any) -> bool:
    """Whether the value itself, not its parts, is of the type."""
    origin = typing.get_origin(kind) or kind
    if origin is np.ndarray:
        arguments = typing.get_args(kind)
        dtype = typing.get_args(arguments[1])[0] if arguments else Any
        if not (isinstance(dtype, type) and issubclass(dtype, np.generic)):
            dtype = np.generic  # any
        return type(value) is np.ndarray and issubclass(value.dtype.type, dtype)
    if origin is bool:
        return isinstance(value, bool | np.bool_)
    if origin is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    if origin is float:  # and not float32, whose sums with floats are float32
        return isinstance(value, float | int) and not isinstance(value, bool)
    return isinstance(value, origin)


def _described(value: Any) -> str:
    return f"{value.dtype} array" if isinstance(value, np.ndarray) else type(value).__name__


def _members(kind: Any) -> tuple[Any, ...] | None:
    """The types of a union; None for anything else."""
    union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if union else None


def _items(kind: Any, length: int) -> tuple[Any, ...]:
    """The types of a sequence's items."""
    arguments = typing.get_args(kind)
    if issubclass(typing.get_origin(kind), tuple) and arguments[-1:] != (...,):
        return arguments
    return arguments[:1] * length


@cache
def _fields(kind: Any) -> dict[str, Any] | None:
    """Names and types of the fields of a dataclass or named tuple; None for anything else."""
    if dataclasses.is_dataclass(kind):
        names = [f.name for f in dataclasses.fields(kind)]
    elif isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):
        names = list(kind._fields)
    else:
        return None
    hints = typing.get_type_hints(kind)
    return {name: hints[name] for name in names}


def _built(kind: Any, parts: dict[str, Any]) -> Any:
    later = {}
    if dataclasses.is_dataclass(kind):
        later = {f.name: parts.pop(f.name) for f in dataclasses.fields(kind) if not f.init}
    value = kind(**parts)
    for name, part in later.items():
        object.__setattr__(value, name, part)
    return value
