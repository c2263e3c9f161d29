# SPDX-License-Identifier: MIT
"""A YAML file of sections, read so that whatever is wrong is named by file, line and key."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_yaml
from densify.geometry.types import Float


@dataclass
class Section:
    """A mapping in the file. where: the file. name: keys down to it, "" for the whole. Each value
    is asked for once, by what it must be; `done` refuses what nobody asked for."""

    where: Path
    name: str
    values: Mapping[str, Any]
    lines: Mapping[str, int]
    asked: set[str] = field(default_factory=set)

    def has(self, key: str) -> bool:
        return self.values.get(key) is not None

    def wrong(self, key: str, expected: str) -> InputError:
        """That the value of this key is not what was expected."""
        got = self.values.get(key)
        shown = "nothing" if got is None else repr(got)
        shown = shown if len(shown) < 80 else shown[:77] + "..."
        return InputError(f"{self.place(key)}: got {shown}, expected {expected}")

    def text(self, key: str, default: str = "") -> str:
        value = self._take(key, default)
        if not isinstance(value, str):
            raise self.wrong(key, "a text")
        return value

    def choice(self, key: str, choices: Sequence[str], default: str = "") -> str:
        value = self.text(key, default)
        if value not in (*choices, default):
            raise self.wrong(key, f"one of {', '.join(choices)}")
        return value

    def flag(self, key: str, default: bool | None = None) -> bool | None:
        value = self._take(key, default)
        if value is not None and not isinstance(value, bool):
            raise self.wrong(key, "true or false")
        return value

    def number(self, key: str, default: float, above: float = -np.inf) -> float:
        value = self._take(key, None)
        if value is None:
            return default
        if isinstance(value, str):
            with suppress(ValueError):
                value = float(value)  # YAML 1.1 reads 1e-3 as text
        if not _is_number(value) or not value > above:
            beyond = "" if above == -np.inf else f" above {above:g}"
            raise self.wrong(key, f"a finite number{beyond}")
        return float(value)

    def names(self, key: str) -> tuple[str, ...] | None:
        value = self._take(key, None)
        if value is None:
            return None
        if not (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
            raise self.wrong(key, "a list of names")
        return tuple(value)

    def numbers(self, key: str, *shapes: tuple[int, ...]) -> Float | None:
        """An array of one of these shapes (-1: any number of rows), also written as one long list;
        None if the key is not there."""
        value = self._take(key, None)
        if value is None:
            return None
        expected = "numbers of shape " + " or ".join(
            "(" + ", ".join("N" if n < 0 else str(n) for n in shape) + ")" for shape in shapes
        )
        try:
            array = np.array(value, dtype=np.float64)
        except (ValueError, TypeError):
            raise self.wrong(key, expected) from None
        if not np.isfinite(array).all():
            raise self.wrong(key, f"finite {expected}")
        for shape in shapes:
            size = int(np.prod(shape))
            fits = array.size == size if size > 0 else array.size % -size == 0
            if fits and array.ndim in (1, len(shape)) and (array.size or shape == (-1,)):
                return array.reshape(shape)
        raise self.wrong(key, expected)

    def section(self, key: str) -> Section:
        """The mapping below this key, empty if it is not there."""
        value = self._take(key, {})
        if not isinstance(value, Mapping) or not all(isinstance(k, str) for k in value):
            raise self.wrong(key, "a mapping of keys to values")
        return Section(self.where, self._full(key), value, self.lines)

    def sections(self) -> dict[str, Section]:
        """All mappings in this one, by key."""
        return {key: self.section(key) for key in self.values}

    def done(self) -> None:
        """Raises InputError for a key that was not asked for."""
        for key in self.values:
            if key not in self.asked:
                close = difflib.get_close_matches(key, sorted(self.asked), n=1, cutoff=0.6)
                hint = f"did you mean {close[0]}? " if close else ""
                raise InputError(
                    f"{self.place(key)}: unknown key; {hint}expected some of "
                    f"{', '.join(sorted(self.asked))}"
                )

    def _take(self, key: str, default: Any) -> Any:
        self.asked.add(key)
        value = self.values.get(key)
        return default if value is None else value

    def _full(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key

    def place(self, key: str) -> str:
        """File, line and key, to begin a message with."""
        full = self._full(key)
        line = self.lines.get(full)
        return f"{self.where}: {'' if line is None else f'line {line}: '}{full}"


def read_sections(path: Path) -> Section:
    """The whole file as a section, empty if it holds nothing. Raises InputError if it is not YAML
    or not a mapping. Tags that build objects are refused."""
    values, lines = read_yaml(path)
    if values is None:
        values = {}
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise InputError(f"{path}: got {values!r:.60}, expected a mapping such as sweeps: {{...}}")
    return Section(path, "", values, lines)


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )
