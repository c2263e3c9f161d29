# SPDX-License-Identifier: MIT
"""Name the array types used everywhere, and select, join and tabulate columns of rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
T = TypeVar("T")


def select_rows(container: T, keep: Bool | Int | slice, columns: Sequence[str] = ()) -> T:
    """Return a dataclass or named tuple with only some rows of its columns.

    Args:
        keep: Mask of the rows, array of row numbers, or slice.
        columns: Names of the fields with an array of rows, or None; by default all fields.
    """
    names = columns or _field_names(container)
    arrays = {name: getattr(container, name) for name in names}
    rows = np.arange(len(arrays[names[0]]))[keep]  # once for all columns
    selected = {
        name: None if array is None else array.take(rows, axis=0) for name, array in arrays.items()
    }
    return _replace_columns(container, selected)


def joined_rows(containers: Iterable[T]) -> T:
    """Return one dataclass or named tuple, all fields columns, with the rows of all containers."""
    pieces = list(containers)
    columns = {
        name: np.concatenate([getattr(piece, name) for piece in pieces])
        for name in _field_names(pieces[0])
    }
    return _replace_columns(pieces[0], columns)


def _field_names(container: Any) -> Sequence[str]:
    """Return the names of the fields of a dataclass or named tuple."""
    return getattr(container, "_fields", None) or [field.name for field in fields(container)]


def _replace_columns(container: Any, columns: Mapping[str, Any]) -> Any:
    """Return a dataclass or named tuple with other values for some of its fields."""
    is_tuple = isinstance(container, tuple)
    return container._replace(**columns) if is_tuple else replace(container, **columns)


def table(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the columns (M,), by name, as the fields of one structured array (M,), unpadded."""
    num_rows = len(next(iter(columns.values())))
    dtype = [(name, column.dtype) for name, column in columns.items()]
    rows = np.empty(num_rows, dtype)
    for name, column in columns.items():
        rows[name] = column
    return rows
