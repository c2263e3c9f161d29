# SPDX-License-Identifier: MIT
"""Read columns of feather, parquet and pickled files of data frames as arrays, and check them.

No code of a pickle is run: imported names become classes that only store their arguments, from
which the columns are taken. Names of other packages than pandas and NumPy are refused.
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
from densify.config.file_content import gunzip, import_extra, open_file, read_bytes, reason

# Letter of a kind -> words for messages, and kinds of NumPy types (a text) or names of Arrow types
_KINDS = {
    "n": ("finite numbers", "iuf"),
    "m": ("numbers", "iuf"),
    "i": ("whole numbers", "iu"),
    "t": ("truth values", "b"),
    "s": ("texts", ("string", "large_string")),
    "b": ("bytes", ("binary", "large_binary")),
    "l": ("lists of numbers", ("float", "double", "int")),
}


def read_arrow(
    path: Path,
    columns: Mapping[str, str],
    data_set: tuple[str, str],
    where: Mapping[str, int] | None = None,
) -> dict[str, NDArray[Any]]:
    """Return columns (N,) of a feather or parquet file by name.

    Args:
        path: File whose suffix is .feather or .parquet.
        columns: Name of a column -> its kind: "n" finite numbers, "m" numbers or NaN, "i" integers,
            "s" strings, "b" bytes, "t" booleans, "l" lists of numbers (an object array of arrays or
            None).
        data_set: Extra that installs pyarrow, and the name of the recordings for messages.
        where: Name of a column -> value that the rows to read have there, for a parquet file; None
            for all rows.

    Raises:
        InputError: The file is missing or damaged, or a column is missing or of another kind.
    """
    import_extra("pyarrow", *data_set)
    is_feather = path.suffix == ".feather"
    library = import_extra("pyarrow.feather" if is_feather else "pyarrow.parquet", *data_set)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected the columns {', '.join(columns)} in it")
    open_file(path).close()  # raises a clearer error if the file cannot be opened
    try:
        if is_feather:
            table = library.read_table(path, memory_map=False)
        else:
            present = [name for name in columns if name in library.read_schema(path).names]
            filters = [(name, "=", value) for name, value in (where or {}).items()]
            table = library.read_table(path, columns=present, filters=filters or None)
        names = table.column_names
        table.validate(full=True)  # offsets in a damaged column may lie outside the file
    except Exception as error:  # a damaged schema raises anything
        kind = path.suffix.removeprefix(".")
        raise InputError(
            f"{path}: not a whole {kind} file ({reason(error)}); fetch it again"
        ) from error
    absent = [name for name in columns if name not in names]
    if absent:
        raise InputError(f"{path}: no column {', '.join(absent)}; got {', '.join(names) or 'none'}")
    return {
        name: _arrow_array(table[name], kind, f"{path}: {name}") for name, kind in columns.items()
    }


def _arrow_array(column: Any, kind: str, where: str) -> NDArray[Any]:
    """Return a column of Arrow as an array; raise InputError if it is not of the kind."""
    expected, types = _KINDS[kind]
    type_name = str(column.type)
    num_null = column.null_count
    num_not_finite = 0
    if kind == "l":
        if "list" in type_name and any(name in type_name for name in types):
            lists = np.empty(len(column), object)
            for row, scalar in enumerate(column):
                values = scalar.values
                lists[row] = None if values is None else values.to_numpy(zero_copy_only=False)
            return lists
    elif isinstance(types, str) or type_name in types:
        array = np.asarray(column.to_numpy())
        if kind == "n" and array.dtype.kind == "f":
            num_not_finite = int((~np.isfinite(array)).sum())
        fits = isinstance(types, tuple) or array.dtype.kind in types
        if fits and not num_null and not num_not_finite:
            return array
    got = f"{type_name}, {num_null} of them missing" if num_null else type_name
    got += f", {num_not_finite} not finite" if num_not_finite else ""
    raise InputError(f"{where}: got {got}, expected {expected}")


# Pickles

_PACKAGES = ("pandas", "numpy")  # whose names a pickled data frame needs, besides slice
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


class _Unpickler(pickle._Unpickler):
    """Unpickle in pure Python, where a damaged file cannot read outside its buffers."""

    def find_class(self, module: str, name: str) -> type[_Record]:
        is_slice = (module, name) == ("builtins", "slice")
        if module.partition(".")[0] not in _PACKAGES and not is_slice:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return type(name, (_Record,), {})


def read_pickled(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns (N,) of a gzipped, pickled pandas data frame, by name; no code is run.

    A column of texts holds Python objects, whose type the caller must check. Raise InputError if
    the file is no such data frame.
    """
    data = read_bytes(path)
    try:
        return _pickled_columns(_Unpickler(io.BytesIO(gunzip(data, path))).load())
    except Exception as error:  # a damaged file can raise any type
        raise InputError(
            f"{path}: not a gzipped pandas data frame of numbers and texts ({reason(error)}); "
            f"nothing in it was run; fetch the file again from where the data set is published"
        ) from error


def _pickled_columns(frame: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of a frame; pandas stores the C columns of a type together, (C,N)."""
    if type(frame).__name__ != "DataFrame":
        raise ValueError(f"it holds a {type(frame).__name__}")
    manager_state = frame.state["_data"].state[-1]["0.14.1"]
    names = manager_state["axes"][0].args[1]["data"].state[-1]
    columns: dict[str, NDArray[Any]] = {}
    for block in manager_state["blocks"]:
        values = _pickled_array(block["values"])
        # Numbers of the block's columns in the frame, as a slice or an array
        placement = block["mgr_locs"]
        is_slice = type(placement).__name__ == "slice"
        numbers = range(*placement.args) if is_slice else _pickled_array(placement).tolist()
        columns |= {str(names[number]): row for number, row in zip(numbers, values, strict=True)}
    return columns


def _pickled_array(record: _Record) -> NDArray[Any]:
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
