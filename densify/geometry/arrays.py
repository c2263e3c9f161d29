# SPDX-License-Identifier: MIT
"""Name the array types used everywhere, and make tables of columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]


def table(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return an (M,) structured array of (M,) columns, by field name, without padding."""
    rows = np.empty(
        len(next(iter(columns.values()))), [(name, c.dtype) for name, c in columns.items()]
    )
    for name, column in columns.items():
        rows[name] = column
    return rows
