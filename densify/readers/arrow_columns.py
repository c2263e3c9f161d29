# SPDX-License-Identifier: MIT
"""Columns of Arrow tables (feather and parquet files) as arrays, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.readers.extras import needed

_EXPECTED = {
    "n": "finite numbers",
    "m": "numbers",
    "i": "whole numbers",
    "s": "texts",
    "b": "bytes",
    "t": "truth values",
    "l": "lists of numbers",
}
_TYPES = {"s": ("string", "large_string"), "b": ("binary", "large_binary")}


def read_feather(path: Path, columns: Mapping[str, str], what: str) -> dict[str, NDArray[Any]]:
    """Columns of a feather file, each (N,), as `column_arrays` checks them.

    what: needs them, such as "Argoverse 2 recordings" (extra ``argoverse``). Raises InputError if
    the file is missing or damaged, or a column is not as expected.
    """
    needed("pyarrow", "argoverse", what)
    feather = needed("pyarrow.feather", "argoverse", what)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected the columns {', '.join(columns)} in it")
    try:
        table = feather.read_table(path, memory_map=False)
        there = table.column_names  # decoded now
        table.validate(full=True)  # columns may point beyond the file
    except Exception as error:  # a damaged schema raises anything
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a whole feather file ({reason}); fetch it again") from error
    _check_there(columns, there, path)
    return column_arrays(table, columns, path)


def read_parquet(
    path: Path, columns: Mapping[str, str], what: str, where: Mapping[str, int] | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of a parquet file, each (N,), as `column_arrays` checks them.

    what: needs them (extra ``waymo``). where: column -> value that it has in the rows wanted; row
    groups without it are not read. Raises InputError as `read_feather`.
    """
    parquet = needed("pyarrow.parquet", "waymo", what)
    if not path.is_file():
        raise InputError(f"{path}: no such file; fetch that component of the data set too")
    filters = [(name, "=", value) for name, value in (where or {}).items()]
    try:
        there = parquet.read_schema(path).names
        present = [name for name in columns if name in there]
        table = parquet.read_table(path, columns=present, filters=filters or None)
    except Exception as error:  # likewise
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a whole parquet file ({reason}); fetch it again") from error
    _check_there(columns, there, path)
    return column_arrays(table, columns, path)


def column_arrays(table: Any, columns: Mapping[str, str], path: Path) -> dict[str, NDArray[Any]]:
    """The table's columns of these names, each (N,).

    columns: name -> "n" finite numbers, "m" numbers that may be NaN, "i" whole numbers, "s" texts,
    "b" bytes, "t" truth values, "l" lists of numbers or None, as arrays in an array of objects.
    Raises InputError, which names the file, if one is absent, has gaps or holds something else.
    """
    _check_there(columns, table.column_names, path)
    return {name: _array(table[name], kind, f"{path}: {name}") for name, kind in columns.items()}


def _check_there(columns: Mapping[str, str], there: Sequence[str], path: Path) -> None:
    absent = [name for name in columns if name not in there]
    if absent:
        raise InputError(f"{path}: no column {', '.join(absent)}; got {', '.join(there) or 'none'}")


def _array(column: Any, kind: str, where: str) -> NDArray[Any]:
    type_name = str(column.type)
    if kind == "l":
        right = "list" in type_name and any(n in type_name for n in ("float", "double", "int"))
        if not right:
            raise InputError(f"{where}: got {type_name}, expected {_EXPECTED[kind]}")
        lists = np.empty(len(column), object)
        for row, scalar in enumerate(column):
            values = scalar.values
            lists[row] = None if values is None else values.to_numpy(zero_copy_only=False)
        return lists
    try:
        array = column.to_numpy()
    except Exception as error:  # a damaged column raises anything
        what = " ".join(repr(error)[:80].split())
        raise InputError(f"{where}: cannot be decoded ({what}); fetch the file again") from error
    if kind in _TYPES:
        right = type_name in _TYPES[kind] and not column.null_count
    else:
        kinds = {"i": "iu", "t": "b"}.get(kind, "iuf")
        right = array.dtype.kind in kinds and not column.null_count
        right = right and (kind != "n" or bool(np.isfinite(array).all()))
    if not right:
        gaps = f", {column.null_count} of them missing" if column.null_count else ""
        odd = "" if array.dtype.kind != "f" else f", {int((~np.isfinite(array)).sum())} not finite"
        raise InputError(f"{where}: got {type_name}{gaps}{odd}, expected {_EXPECTED[kind]}")
    return array
