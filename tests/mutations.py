# SPDX-License-Identifier: MIT
"""Bytes of files as damage, other programs and malice change them. What is random comes from a
`random.Random`, which may be hypothesis's."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

_HEADER_BYTES, _TRAILER_BYTES = 512, 256
_MOST_BYTES = 1 << 22
_NUMBERS = (
    *("0", "-1", "1", "255", "256", "65536", "2147483647", "2147483648", "4294967296"),
    *("9223372036854775807", "99999999999999999999", "1e9", "1e308", "1e999", "-1e999", "1e-320"),
    *("nan", "inf", "-0.0", "0x10", "1_000", "", "٣", "1" * 400),
)
_WORDS = (
    *(b"", b"\0", b"\n", b"\r\n", b" ", b"\t", b"#", b":", b"- ", b"[", b"{", b'"', b"'", b"&a"),
    *(b"*a", b"!!python/object:os.system", b"\xff", b"\xef\xbb\xbf", b"../../etc/passwd", b"%s"),
    *(b"x" * 300, b"[" * 2000, b"NaN", b"null", b"true", b"~"),
)  # fmt: skip
_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 2**31, 2**63, 10**30, 0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "x" * 300, "a/b", "../..", "/dev/zero", "\0", [], {}, [[]], [[[[[[1]]]]]]),
)
_NUMBER = re.compile(rb"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", re.IGNORECASE)


def mutated(rng: Random, data: bytes, other: bytes = b"") -> bytes:
    """Changed in one to six places. other: of the same kind, for splices."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        inner = _container(data)
        if inner is not None and rng.random() < 0.6:
            data = inner(rng, data)
        else:
            data = rng.choice(_CHANGES)(rng, data, other)
    return data[:_MOST_BYTES]


def _place(rng: Random, data: bytes) -> int:
    """Headers and trailers more often than what lies between."""
    where, length = rng.random(), max(1, len(data))
    if where < 0.5:
        return rng.randrange(min(_HEADER_BYTES, length))
    if where < 0.7:
        return max(0, length - 1 - rng.randrange(min(_TRAILER_BYTES, length)))
    return rng.randrange(length)


def _length(rng: Random) -> int:
    return rng.choice((1, 2, 4, 8, 16, 100, 1000))


def _flip(rng: Random, data: bytes, other: bytes) -> bytes:
    changed = bytearray(data or b"\0")
    changed[_place(rng, changed)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _byte(rng: Random, data: bytes, other: bytes) -> bytes:
    changed = bytearray(data or b"\0")
    changed[_place(rng, changed)] = rng.choice((0, 1, 127, 128, 255, 10, 32, 45, 57))
    return bytes(changed)


def _cut(rng: Random, data: bytes, other: bytes) -> bytes:
    return data[: _place(rng, data)]


def _without(rng: Random, data: bytes, other: bytes) -> bytes:
    at = _place(rng, data)
    return data[:at] + data[at + _length(rng) :]


def _twice(rng: Random, data: bytes, other: bytes) -> bytes:
    at, length = _place(rng, data), _length(rng)
    return data[:at] + data[at : at + length] * rng.choice((2, 3, 100)) + data[at + length :]


def _spliced(rng: Random, data: bytes, other: bytes) -> bytes:
    source = other or data
    at, start, length = _place(rng, data), _place(rng, source), _length(rng)
    return data[:at] + source[start : start + length] + data[at + length * rng.randrange(2) :]


def _integer(rng: Random, data: bytes, other: bytes) -> bytes:
    """A binary field of a header."""
    kind = rng.choice(("<H", ">H", "<I", ">I", "<Q", ">Q", "<f", "<d"))
    if kind[1] in "fd":
        value = rng.choice((0.0, -1.0, 1e30, float("nan"), float("inf")))
    else:
        bits = 8 * struct.calcsize(kind)
        value = rng.choice((0, 1, 2, 255, 2 ** (bits - 1) - 1, 2 ** (bits - 1), 2**bits - 1))
    word, at = struct.pack(kind, value), _place(rng, data)
    return data[:at] + word + data[at + len(word) :]


def _number(rng: Random, data: bytes, other: bytes) -> bytes:
    """One that is spelled out."""
    at = _place(rng, data)
    found = _NUMBER.search(data, at) or _NUMBER.search(data)
    if found is None:
        return _word(rng, data, other)
    return data[: found.start()] + rng.choice(_NUMBERS).encode() + data[found.end() :]


def _word(rng: Random, data: bytes, other: bytes) -> bytes:
    at = _place(rng, data)
    return data[:at] + rng.choice(_WORDS) + data[at + _length(rng) * rng.randrange(2) :]


def _line(rng: Random, data: bytes, other: bytes) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at : at + 1] = rng.choice(
        ([], [lines[at]] * 2, [b""], [lines[rng.randrange(len(lines))]])
    )
    return b"\n".join(lines)


def _nothing(rng: Random, data: bytes, other: bytes) -> bytes:
    return rng.choice((b"", b"\0" * len(data), data + data, other or data))


_CHANGES: tuple[Callable[[Random, bytes, bytes], bytes], ...] = (
    *(_flip, _byte, _cut, _without, _twice, _spliced, _integer, _integer, _number, _number),
    *(_word, _line, _nothing),
)


# What has check sums or is packed is changed inside, so that more than the check sum is tried


def _container(data: bytes) -> Callable[[Random, bytes], bytes] | None:
    if data.startswith(b"\x89PNG"):
        return _in_png
    if data.startswith(b"PK"):
        return _in_zip
    if data.startswith(b"\x1f\x8b"):
        return _in_gzip
    return _in_json if data[:1] in (b"{", b"[") else None


def _in_png(rng: Random, data: bytes) -> bytes:
    parts, at = [], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        parts.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not parts:
        return data
    which = rng.randrange(len(parts))
    name, content = parts[which]
    if name == b"IDAT" and rng.random() < 0.5:
        try:
            content = zlib.compress(mutated(rng, zlib.decompress(content)), 1)
        except zlib.error:
            content = mutated(rng, content)
    else:
        content = mutated(rng, content)
    parts[which] = (name, content)
    if rng.random() < 0.2:
        parts.insert(rng.randrange(len(parts) + 1), rng.choice(parts))
    packed = [
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    ]
    return data[:8] + b"".join(packed)


def _in_zip(rng: Random, data: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # changed before
        return _byte(rng, data, b"")
    if not members:
        return data
    name = rng.choice(sorted(members))
    change = rng.random()
    if change < 0.15:
        del members[name]
    elif change < 0.3:
        members[rng.choice(("x.npy", "points.npy", "", "../a.npy"))] = members[name]
    else:
        members[name] = mutated(rng, members[name], members[rng.choice(sorted(members))])
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as z:
        for name, content in members.items():
            z.writestr(name or "x", content)
    return buffer.getvalue()


def _in_gzip(rng: Random, data: bytes) -> bytes:
    try:
        return gzip.compress(mutated(rng, gzip.decompress(data)), 1)
    except (OSError, EOFError, zlib.error):
        return _byte(rng, data, b"")


def _in_json(rng: Random, data: bytes) -> bytes:
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return _word(rng, data, b"")
    holder, key = None, None
    node = tree
    while isinstance(node, dict | list) and node and (holder is None or rng.random() < 0.8):
        holder = node
        key = rng.choice(sorted(node)) if isinstance(node, dict) else rng.randrange(len(node))
        node = node[key]
    if holder is None:
        return _word(rng, data, b"")
    change = rng.random()
    if change < 0.2:
        del holder[key]
    elif change < 0.3 and isinstance(holder, list):
        holder.append(node)
    else:
        holder[key] = rng.choice(_VALUES)
    return json.dumps(tree).encode()
