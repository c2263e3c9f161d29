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
    return _replaced(
        container, {n: None if a is None else a.take(rows, axis=0) for n, a in arrays.items()}
    )


def joined_rows(containers: Iterable[T]) -> T:
    """Return one dataclass or named tuple, all of whose fields are columns, of several."""
    pieces = list(containers)
    names = _field_names(pieces[0])
    return _replaced(pieces[0], {n: np.concatenate([getattr(p, n) for p in pieces]) for n in names})


def _field_names(container: Any) -> Sequence[str]:
    return getattr(container, "_fields", None) or [f.name for f in fields(container)]


def _replaced(container: Any, columns: Mapping[str, Any]) -> Any:
    is_tuple = isinstance(container, tuple)
    return container._replace(**columns) if is_tuple else replace(container, **columns)


def table(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return an (M,) structured array of (M,) columns, by field name, without padding."""
    rows = np.empty(
        len(next(iter(columns.values()))), [(name, c.dtype) for name, c in columns.items()]
    )
    for name, column in columns.items():
        rows[name] = column
    return rows
