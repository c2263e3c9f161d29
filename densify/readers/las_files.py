# SPDX-License-Identifier: MIT
"""LAS and LAZ files. What laspy and lazrs would believe is looked at before they are called: they
make room for what headers claim, and some damage ends the process."""

from __future__ import annotations

import io
import logging
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

from densify.config.errors import InputError
from densify.config.file_content import check_size, read_bytes, reason

_HEADER = struct.Struct("<94xHIIBHI")  # up to the number of points
_EXTENDED = struct.Struct("<235xQIQ")  # of version 1.4
_LASZIP = ("laszip encoded", 22204)
_ITEMS_AT, _ITEM_BYTES = 34, 6
_VARIABLE = 0xFFFFFFFF
_ONE_AT_A_TIME = Lock()
_LAYERED = 3  # the compressor of version 1.4's points
_NUM_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by item; further bytes have one each


def read_las(path: Path) -> Any:
    """A `laspy.LasData` with all of the file's points. Raises InputError if it is missing, too
    large, damaged or no LAS or LAZ file."""
    import laspy

    data, quiet = read_bytes(path), logging.getLogger("laspy")
    try:
        quiet.disabled = True  # it tells stderr what the exception says too
        num_points, num_bytes = _claimed(data)
        check_size(num_points * num_bytes, path)
        # Not the parallel one, which makes room for what the table of chunks claims.
        backend = laspy.LazBackend.Lazrs
        with laspy.open(io.BytesIO(data), laz_backend=backend) as file, _stderr_aside():
            cloud = file.read()
        if len(cloud) != num_points:
            raise ValueError(f"got {len(cloud)} points, expected {num_points}; it is cut off")
        return cloud
    except InputError:
        raise
    except Exception as error:  # a damaged header raises anything
        raise InputError(f"{path}: not a readable {path.suffix} file: {reason(error)}") from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # of lazrs, which is written in Rust
            raise
        raise InputError(f"{path}: not a readable {path.suffix} file: it is damaged") from error
    finally:
        quiet.disabled = False


@contextmanager
def _stderr_aside() -> Iterator[None]:
    """While lazrs decodes: a panic of Rust's writes to stderr before it can be caught."""
    with _ONE_AT_A_TIME:
        try:
            kept = os.dup(2)
        except OSError:  # closed
            yield
            return
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)


def _claimed(data: bytes) -> tuple[int, int]:
    """Points, and bytes of each. Raises ValueError or struct.error unless all that is claimed fits
    into the file."""
    if data[:4] != b"LASF":
        raise ValueError("it does not begin with LASF")
    header_bytes, begin, num_records, kind, num_bytes, num_points = _HEADER.unpack_from(data)
    if data[24] != 1 or not 227 <= header_bytes <= begin <= len(data) or not num_bytes:
        raise ValueError("its header does not fit")
    if data[25] >= 4 and header_bytes >= _EXTENDED.size:
        late, num_late, num_points = _EXTENDED.unpack_from(data)[0:3]
        if num_late:
            _records(data, late, len(data), num_late, extended=True)
    packing = _records(data, header_bytes, begin, num_records).get(_LASZIP)
    if not kind & 0x80:
        if begin + num_points * num_bytes > len(data):
            raise ValueError(f"its header claims {num_points:,} points; it is cut off")
    else:
        _check_packing(data, packing, begin, num_points, num_bytes)
    return num_points, num_bytes


def _records(
    data: bytes, at: int, end: int, number: int, extended: bool = False
) -> dict[tuple[str, int], bytes]:
    """Those of variable length, by user and number."""
    found, head = {}, 60 if extended else 54
    for _ in range(number):
        if at + head > end:
            raise ValueError("its records do not fit")
        user, name = data[at + 2 : at + 18].rstrip(b"\0"), data[at + 18 : at + 20]
        length = int.from_bytes(data[at + 20 : at + (28 if extended else 22)], "little")
        if at + head + length > end:
            raise ValueError("its records do not fit")
        key = user.decode("ascii", "replace"), int.from_bytes(name, "little")
        found[key] = data[at + head : at + head + length]
        at += head + length
    return found


def _check_packing(
    data: bytes, packing: bytes | None, begin: int, num_points: int, num_bytes: int
) -> None:
    """Raise ValueError unless what says how points are packed agrees with them."""
    if packing is None or len(packing) < _ITEMS_AT:
        raise ValueError("nothing says how its points are packed")
    compressor, _, _, _, _, _, chunk_points = struct.unpack_from("<HHBBHII", packing)
    (num_items,) = struct.unpack_from("<H", packing, _ITEMS_AT - 2)
    if len(packing) < _ITEMS_AT + num_items * _ITEM_BYTES:
        raise ValueError("nothing says how its points are packed")
    items = [
        struct.unpack_from("<HH", packing, _ITEMS_AT + i * _ITEM_BYTES) for i in range(num_items)
    ]
    item_bytes = sum(size for _, size in items)
    if item_bytes != num_bytes:
        raise ValueError(f"its points of {num_bytes} bytes are packed as {item_bytes}")
    if compressor not in (2, 3):
        raise ValueError(f"its points are packed in a way that is not known ({compressor})")
    (table,) = struct.unpack_from("<q", data, begin)
    table = int.from_bytes(data[-8:], "little", signed=True) if table == -1 else table
    if not begin + 8 <= table <= len(data) - 8:
        raise ValueError("it has no table of chunks; it is cut off")
    (num_chunks,) = struct.unpack_from("<I", data, table + 4)
    room = table - begin - 8  # the first point of a chunk is not packed
    if num_chunks * num_bytes > room or (num_points and not num_chunks):
        raise ValueError(f"its table claims {num_chunks:,} chunks; it is damaged")
    if chunk_points != _VARIABLE and not (
        (num_chunks - 1) * chunk_points < num_points <= num_chunks * chunk_points or not num_points
    ):
        raise ValueError(f"{num_chunks:,} chunks of {chunk_points:,} do not make {num_points:,}")
    if compressor == _LAYERED:
        num_layers = sum(_NUM_LAYERS.get(kind, size) for kind, size in items)
        _check_layers(data[begin + 8 : table], num_chunks, num_bytes, num_layers)


def _check_layers(chunks: bytes, num_chunks: int, num_bytes: int, num_layers: int) -> None:
    """Raise ValueError or struct.error unless the chunks, each of a point as it is, a number and
    the layers' sizes before the layers, fill their place."""
    at = 0
    for _ in range(num_chunks):
        sizes = struct.unpack_from(f"<{num_layers}I", chunks, at + num_bytes + 4)
        at += num_bytes + 4 + 4 * num_layers + sum(sizes)
    if at != len(chunks):
        raise ValueError("the sizes of its chunks do not fit; it is damaged")
