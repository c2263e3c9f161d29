# SPDX-License-Identifier: MIT
"""Tables of text, from nested mappings of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

NONE = "-"
Column = tuple[str, tuple[str, ...], str]
"""Title, where the number lies in a row, and how it is written."""


def table(rows: Mapping[str, Any], columns: Sequence[Column]) -> str:
    """A row for each of several mappings; columns that say nothing of any are left out."""
    told = [c for c in columns if any(look_up(r, *c[1]) is not None for r in rows.values())]
    body = [
        [name, *(written(look_up(row, *path), form) for _, path, form in told)]
        for name, row in rows.items()
    ]
    return aligned([["", *(title for title, _, _ in told)], *body])


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; an empty row is a blank line."""
    widths = [max(map(len, column)) for column in zip(*filter(None, rows), strict=True)]
    lines = []
    for row in rows:
        first, *others = row or [""]
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=False)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)


def written(value: float | None, form: str) -> str:
    """Format by a format and, after a blank, a unit; percentages with a blank before the sign."""
    if value is None:
        return NONE
    number, _, unit = form.partition(" ")
    return f"{value:{number}}".replace("%", " %") + (f" {unit}" if unit else "")


def percent(value: float | None, digits: int = 2) -> str:
    """A share, with a blank before the sign."""
    return NONE if value is None else f"{100 * value:.{digits}f} %"


def look_up(metrics: Mapping[str, Any], *path: str) -> Any:
    """metrics[a][b]..., None where a step of it is missing."""
    value: Any = metrics
    for step in path:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value
