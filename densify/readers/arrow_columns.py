# SPDX-License-Identifier: MIT
"""Read columns of feather and parquet files as arrays and check them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import needed, open_file, reason

_EXPECTED = {
    "n": "finite numbers",
    "m": "numbers",
    "i": "whole numbers",
    "s": "texts",
    "b": "bytes",
    "t": "truth values",
    "l": "lists of numbers",
}
_DTYPES = {"n": "iuf", "m": "iuf", "i": "iu", "t": "b"}
_TYPES = {"s": ("string", "large_string"), "b": ("binary", "large_binary")}


def read_feather(path: Path, columns: Mapping[str, str], needed_by: str) -> dict[str, NDArray[Any]]:
    """Return columns (N,) of a feather file by name; errors name the recordings ``needed_by``.

    ``columns`` has the kind of each: "n" finite numbers, "m" numbers or NaN, "i" integers, "s"
    strings, "b" bytes, "t" booleans, "l" lists of numbers (an object array of arrays or None).
    """
    needed("pyarrow", "argoverse", needed_by)
    feather = needed("pyarrow.feather", "argoverse", needed_by)
    return _read(path, columns, lambda: feather.read_table(path, memory_map=False))


def read_parquet(
    path: Path, columns: Mapping[str, str], needed_by: str, where: Mapping[str, int] | None = None
) -> dict[str, NDArray[Any]]:
    """Return columns of a parquet file as `read_feather`, of the rows with the values ``where``."""
    parquet = needed("pyarrow.parquet", "waymo", needed_by)
    filters = [(name, "=", value) for name, value in (where or {}).items()]

    def read() -> Any:
        present = [name for name in columns if name in parquet.read_schema(path).names]
        return parquet.read_table(path, columns=present, filters=filters or None)

    return _read(path, columns, read)


def _read(
    path: Path, columns: Mapping[str, str], read: Callable[[], Any]
) -> dict[str, NDArray[Any]]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected the columns {', '.join(columns)} in it")
    open_file(path).close()  # raises a clearer error if the file cannot be opened
    try:
        table = read()
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
    return {name: _array(table[name], kind, f"{path}: {name}") for name, kind in columns.items()}


def _array(column: Any, kind: str, where: str) -> NDArray[Any]:
    type_name, num_null, non_finite = str(column.type), column.null_count, 0
    if kind == "l":
        lists = np.empty(len(column), object)
        if "list" in type_name and any(n in type_name for n in ("float", "double", "int")):
            for row, scalar in enumerate(column):
                values = scalar.values
                lists[row] = None if values is None else values.to_numpy(zero_copy_only=False)
            return lists
    elif kind in _TYPES:
        if type_name in _TYPES[kind] and not num_null:
            return np.asarray(column.to_numpy())
    else:
        array = np.asarray(column.to_numpy())
        if array.dtype.kind == "f":
            non_finite = int((~np.isfinite(array)).sum())
        if array.dtype.kind in _DTYPES[kind] and not num_null and not (kind == "n" and non_finite):
            return array
    got = f"{type_name}, {num_null} of them missing" if num_null else type_name
    got += f", {non_finite} not finite" if non_finite else ""
    raise InputError(f"{where}: got {got}, expected {_EXPECTED[kind]}")
