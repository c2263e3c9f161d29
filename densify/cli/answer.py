# SPDX-License-Identifier: MIT
"""The answer of a verb on stdout, and tables of text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Answer:
    """The answer of a verb.

    text: for people.
    facts: for programs (``--json``); lists of several answers are joined.
    files: the files written.
    first: the files to open first, each with what it shows.
    """

    text: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Sequence[Path] = ()
    first: Mapping[Path, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Return the text, every file, and the files to open first."""
        lines = [self.text] if self.text else []
        lines += map(str, self.files)
        if self.first:
            rows = [[f"  {path}", what] for path, what in self.first.items()]
            lines += ["open first:", aligned(rows, "<")]
        return lines


def first_of(files: Sequence[Path], kinds: Mapping[str, str], most: int = 3) -> dict[Path, str]:
    """Return the files to open first, at most one of each kind.

    kinds: pattern of the end of a path -> what the file shows; the first kinds come first.
    """
    first: dict[Path, str] = {}
    for pattern, what in kinds.items():
        found = next((f for f in files if f.match(pattern) and f not in first), None)
        if found is not None and len(first) < most:
            first[found] = what
    return first


def numbers_table(columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with a column for each mapping and a row for each number in any of them, named
    by its path."""
    flat = {title: dict(_numbers(numbers, "")) for title, numbers in columns.items()}
    names = dict.fromkeys(name for numbers in flat.values() for name in numbers)
    body = [[name, *(_cell(column.get(name)) for column in flat.values())] for name in names]
    return aligned([["", *columns], *body])


def _cell(value: float | None) -> str:
    return written(value, ",d" if isinstance(value, int) else ".4g")


def _numbers(values: Mapping[str, Any], path: str) -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{path}{name} ")
        elif isinstance(value, float | int):
            yield f"{path}{name}", value


def aligned(rows: Sequence[Sequence[str]], side: str = ">") -> str:
    """Return the rows as text, the first column to the left, the others to the right or left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<", *(side * (len(widths) - 1))]
    lines = (
        "  ".join(f"{cell:{s}{w}}" for cell, s, w in zip(row, sides, widths, strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def written(value: float | None, form: str) -> str:
    """Return the number as text, "-" for None. form: a format, and after a blank a unit."""
    if value is None:
        return "-"
    number, _, unit = form.partition(" ")
    return f"{value:{number}}".replace("%", " %") + (f" {unit}" if unit else "")


def percent(value: float | None, digits: int = 2) -> str:
    """Return a share as a percentage."""
    return written(value, f".{digits}%")


def look_up(metrics: Mapping[str, Any], *path: str) -> Any:
    """Return ``metrics[a][b]...``, None where a step of the path is missing."""
    value: Any = metrics
    for step in path:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value
