# SPDX-License-Identifier: MIT
"""Columns of a pickled pandas data frame, without pandas and without running what the file says.

A pickle is a program: it may name any function of any package and call it. Here every name stands
for a record that only notes what it was called with, and names that a data frame's file does not
have are refused, so nothing is ever run; the columns are then taken from the notes.
"""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import gunzipped, read_bytes

_NUMBERS = re.compile(r"[fiu][1248]|b1")
_OBJECTS = "O8"


class _Record:
    """What a file says of one object: how it is made, and what is set on it."""

    args: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *args: Any) -> _Record:
        record = super().__new__(cls)
        record.args = args
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state


_NAMES = {
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
}
_RECORDS: dict[str, type[_Record]] = {
    name: type(name.rpartition(".")[2], (_Record,), {}) for name in _NAMES
}


class _Unpickler(pickle._Unpickler):
    """The one written in Python: a damaged file cannot reach past its buffers, and files have few
    instructions, whatever their size."""

    def find_class(self, module: str, name: str) -> type[_Record]:
        named = f"{module}.{name}"
        if named not in _RECORDS:
            raise pickle.UnpicklingError(f"it names {named}")
        return _RECORDS[named]


def read_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Columns of a gzipped pickle of a data frame of numbers and texts, by name, (N,) each; where
    there are texts, of objects, each of which the caller must check.

    Raises InputError if the file is missing, damaged, or anything else than such a frame, above all
    if it names a function that frames do not need; nothing in it is run.
    """
    data = read_bytes(path)
    try:
        return _columns(_Unpickler(io.BytesIO(gunzipped(data, path))).load())
    except Exception as error:  # any kind: the file decides which
        raise InputError(
            f"{path}: not a gzipped pandas data frame of numbers and texts "
            f"({str(error) or repr(error)}); nothing in it was run; fetch the file again from "
            f"where the data set is published"
        ) from error


def _columns(frame: Any) -> dict[str, NDArray[Any]]:
    """pandas stores columns of one kind together, (C,N), and says which they are."""
    if not isinstance(frame, _RECORDS["pandas.core.frame.DataFrame"]):
        raise ValueError(f"it holds a {type(frame).__name__}")
    managed: Mapping[str, Any] = frame.state["_data"].state[-1]["0.14.1"]
    names = managed["axes"][0].args[1]["data"].state[-1]
    columns = {}
    for block in managed["blocks"]:
        values, places = _array(block["values"]), block["mgr_locs"]
        is_slice = isinstance(places, _RECORDS["builtins.slice"])
        for row, column in enumerate(range(*places.args) if is_slice else _array(places).tolist()):
            columns[str(names[column])] = values[row]
    return columns


def _array(record: _Record) -> NDArray[Any]:
    _, shape, dtype, by_columns, data = record.state
    kind, order = dtype.args[0], dtype.state[1]
    if kind == _OBJECTS and isinstance(data, list):
        objects = np.empty(len(data), object)
        objects[:] = data
        return objects.reshape(shape, order="F" if by_columns else "C")
    if not _NUMBERS.fullmatch(kind):
        raise ValueError(f"a column of the kind {kind!r}")
    array = np.frombuffer(data, np.dtype(kind).newbyteorder(order))
    return array.reshape(shape, order="F" if by_columns else "C")
