# SPDX-License-Identifier: MIT
"""Read columns of a pickled pandas data frame without pandas and without running the pickle.

A pickle may import and call any function. Here imported names become classes that only store their
arguments, from which the columns are taken; names that a data frame does not need are refused.
"""

from __future__ import annotations

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import gunzipped, read_bytes, reason

_NUMBERS = re.compile(r"[fiu][1248]|b1")


class _Record:
    """Store the constructor arguments and the state of a pickled object, without making it."""

    args: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *args: Any) -> _Record:
        record = super().__new__(cls)
        record.args = args
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state


_RECORDS: dict[str, type[_Record]] = {
    name: type(name.rpartition(".")[2], (_Record,), {})
    for name in (
        "pandas.core.frame.DataFrame",
        "pandas.core.internals.managers.BlockManager",
        "pandas.core.indexes.base._new_Index",
        "pandas.core.indexes.base.Index",
        "pandas.core.indexes.numeric.Int64Index",
        "pandas.core.indexes.range.RangeIndex",
        "numpy.core.multiarray._reconstruct",
        "numpy._core.multiarray._reconstruct",
        "numpy.ndarray",
        "numpy.dtype",
        "builtins.slice",
    )
}


class _Unpickler(pickle._Unpickler):
    """Unpickle in pure Python, where a damaged file cannot read outside its buffers."""

    def find_class(self, module: str, name: str) -> type[_Record]:
        named = f"{module}.{name}"
        if named not in _RECORDS:
            raise pickle.UnpicklingError(f"it names {named}")
        return _RECORDS[named]


def read_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns (N,) of a gzipped, pickled data frame, by name; no code in it is run.

    A column of texts holds Python objects, whose type the caller must check.
    """
    data = read_bytes(path)
    try:
        return _columns(_Unpickler(io.BytesIO(gunzipped(data, path))).load())
    except Exception as error:  # a damaged file can raise any type
        raise InputError(
            f"{path}: not a gzipped pandas data frame of numbers and texts ({reason(error)}); "
            f"nothing in it was run; fetch the file again from where the data set is published"
        ) from error


def _columns(frame: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of a frame; pandas stores the C columns of a type together, (C,N)."""
    if not isinstance(frame, _RECORDS["pandas.core.frame.DataFrame"]):
        raise ValueError(f"it holds a {type(frame).__name__}")
    managed = frame.state["_data"].state[-1]["0.14.1"]
    names = managed["axes"][0].args[1]["data"].state[-1]
    columns = {}
    for block in managed["blocks"]:
        values, locs = _array(block["values"]), block["mgr_locs"]
        is_slice = isinstance(locs, _RECORDS["builtins.slice"])
        for row, column in enumerate(range(*locs.args) if is_slice else _array(locs).tolist()):
            columns[str(names[column])] = values[row]
    return columns


def _array(record: _Record) -> NDArray[Any]:
    """Rebuild a NumPy array from the stored state of its pickle."""
    _, shape, dtype, by_columns, data = record.state
    kind, order = dtype.args[0], dtype.state[1]
    if kind == "O8" and isinstance(data, list):
        array: NDArray[Any] = np.empty(len(data), object)
        array[:] = data
    elif _NUMBERS.fullmatch(kind):
        array = np.frombuffer(data, np.dtype(kind).newbyteorder(order))
    else:
        raise ValueError(f"a column of the kind {kind!r}")
    return array.reshape(shape, order="F" if by_columns else "C")
