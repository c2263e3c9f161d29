# SPDX-License-Identifier: MIT
"""Values of the JSON files of a run, checked one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError, brief
from densify.config.file_content import read_json
from densify.geometry.types import Float


@dataclass(frozen=True)
class Fields:
    """A mapping in the file. prefix: where, for messages."""

    path: Path
    prefix: str
    table: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not isinstance(self.table, dict):
            where = self.prefix.rstrip(".") or "the file"
            raise InputError(f"{self.path}: {where}: expected a mapping; densify the key again")

    @staticmethod
    def of_file(path: Path, what: str) -> Fields:
        """what: it has, for the message if it is not there."""
        if not path.is_file():
            raise InputError(
                f"{path}: not there, and has {what}; densify the key again (run --overwrite)"
            )
        return Fields(path, "", read_json(path))

    def value(self, name: str, fits: Callable[[Any], bool], what: str) -> Any:
        value = self.table.get(name)
        if not fits(value):
            raise InputError(
                f"{self.path}: {self.prefix}{name}: got {brief(repr(value))}, expected {what}; "
                f"densify the key again"
            )
        return value

    def number(self, name: str, least: float = -np.inf, most: float = np.inf) -> float:
        what = "a number" if least == -np.inf else f"a number from {least:g} to {most:g}"
        return float(self.value(name, lambda v: is_number(v) and least <= v <= most, what))

    def whole(self, name: str) -> int:
        """A whole number with all its digits, as stamps need it."""
        return int(
            self.value(name, lambda v: type(v) is int and abs(v) < 1 << 63, "a whole number")
        )

    def vector(self, name: str, size: int) -> Float:
        """(size,)"""
        value = self.value(name, lambda v: _are_numbers(v, size), f"{size} numbers")
        return np.array(value, np.float64)

    def matrix(self, name: str, size: int) -> Float:
        """(size,size)"""

        def fits(value: Any) -> bool:
            rows = value if isinstance(value, list) else []
            return len(rows) == size and all(_are_numbers(row, size) for row in rows)

        return np.array(self.value(name, fits, f"{size} x {size} numbers"), np.float64)

    def pose(self, name: str) -> Float:
        """(4,4) a rotation and a translation."""
        T = self.matrix(name, 4)
        R = T[:3, :3]
        upright = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
        if not upright or T[3].tolist() != [0, 0, 0, 1]:
            raise InputError(
                f"{self.path}: {self.prefix}{name}: expected a rotation and a translation; densify "
                f"the key again"
            )
        return T

    def each(self, name: str) -> list[tuple[str, Fields]]:
        inner = self.value(name, lambda v: isinstance(v, dict), "a mapping")
        return [(n, Fields(self.path, f"{self.prefix}{name}.{n}.", v)) for n, v in inner.items()]

    def rows(self, name: str) -> list[Fields]:
        inner = self.value(name, lambda v: isinstance(v, list), "a list")
        return [Fields(self.path, f"{self.prefix}{name}[{i}].", v) for i, v in enumerate(inner)]


def _are_numbers(value: Any, size: int) -> bool:
    return isinstance(value, list) and len(value) == size and all(map(is_number, value))


def is_number(value: Any) -> bool:
    """Neither true nor false, not infinite and no code for it."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e20
