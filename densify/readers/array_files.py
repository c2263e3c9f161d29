# SPDX-License-Identifier: MIT
"""NumPy's files. What a header claims has to be there before anything is made of it."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import MOST_BYTES, check_size, read_bytes, reason

Arrays = dict[str, NDArray[Any]]

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1


def read_array(path: Path) -> NDArray[Any]:
    """The array of a .npy file. Raises InputError if it is missing, too large, damaged, or holds
    Python objects."""
    data = read_bytes(path)
    try:
        if data.startswith(b"PK"):
            raise ValueError("it holds an archive of arrays; name it .npz")
        return _array(data)
    except Exception as error:  # a damaged header raises anything
        raise InputError(f"{path}: not a whole .npy file: {reason(error)}") from error


def read_arrays(
    path: Path, names: Sequence[str] | None = None, most_bytes: int = MOST_BYTES
) -> Arrays:
    """The arrays of a .npz file by name; names: only those of them that it holds.

    Raises InputError if it is missing or damaged, holds Python objects, or these arrays have more
    bytes than that together. Members that are no arrays are passed over.
    """
    data = read_bytes(path)
    try:
        if data.startswith(np.lib.format.MAGIC_PREFIX):
            raise ValueError("it holds a single array, not named ones; name it .npy")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            there = {m.filename[:-4]: m for m in archive.infolist() if m.filename[-4:] == ".npy"}
            wanted = {n: m for n, m in there.items() if names is None or n in names}
            check_size(sum(member.file_size for member in wanted.values()), path, most_bytes)
            return {name: _member(archive, member) for name, member in wanted.items()}
    except InputError:
        raise
    except Exception as error:  # and so do damaged archives
        raise InputError(f"{path}: not a readable .npz file: {reason(error)}") from error


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    if member.compress_type not in _METHODS or member.flag_bits & _ENCRYPTED:
        raise ValueError(f"{member.filename} is packed as numpy does not")
    with archive.open(member) as file:
        return _array(file.read(member.file_size))


def _array(data: bytes) -> NDArray[Any]:
    """Writable."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"got version {version}, expected {' or '.join(map(str, _HEADERS))}")
    shape, by_columns, dtype = _HEADERS[version](file)
    start = file.tell()
    if dtype.hasobject or not dtype.itemsize:
        what = "Python objects" if dtype.hasobject else "nothing"
        raise ValueError(f"it holds {what}, expected numbers")
    if min(shape, default=0) < 0 or start + math.prod(shape) * dtype.itemsize > len(data):
        raise ValueError(
            f"its header claims {dtype} of shape {shape}, and {len(data) - start} bytes follow; "
            f"it is cut off"
        )
    order: Any = "F" if by_columns else "C"
    flat = np.ndarray(math.prod(shape), dtype, data, start)
    return flat.copy().reshape(shape, order=order)
