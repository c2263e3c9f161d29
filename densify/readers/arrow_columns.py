# SPDX-License-Identifier: MIT
"""Columns of Arrow tables (feather and parquet files) as arrays, checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.readers.extras import needed

_EXPECTED = {"n": "finite numbers", "i": "whole numbers", "s": "texts", "m": "numbers"}


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
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a whole feather file ({reason}); fetch it again") from error
    return column_arrays(table, columns, path)


def column_arrays(table: Any, columns: Mapping[str, str], path: Path) -> dict[str, NDArray[Any]]:
    """The table's columns of these names, each (N,).

    columns: name -> "n" finite numbers, "m" numbers that may be NaN, "i" whole numbers, "s" texts.
    Raises InputError, which names the file, if one is absent, has gaps or holds something else.
    """
    absent = [name for name in columns if name not in table.column_names]
    if absent:
        raise InputError(
            f"{path}: no column {', '.join(absent)}; got {', '.join(table.column_names) or 'none'}"
        )
    return {name: _array(table[name], kind, f"{path}: {name}") for name, kind in columns.items()}


def _array(column: Any, kind: str, where: str) -> NDArray[Any]:
    array = column.to_numpy()
    is_text = str(column.type) in ("string", "large_string")
    fits = {"i": "iu", "s": "O", "n": "iuf", "m": "iuf"}[kind]
    right = array.dtype.kind in fits and (is_text or kind != "s") and not column.null_count
    if not (right and (kind != "n" or np.isfinite(array).all())):
        gaps = f", {column.null_count} of them missing" if column.null_count else ""
        odd = "" if array.dtype.kind != "f" else f", {int((~np.isfinite(array)).sum())} not finite"
        raise InputError(f"{where}: got {column.type}{gaps}{odd}, expected {_EXPECTED[kind]}")
    return array
