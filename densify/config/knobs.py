# SPDX-License-Identifier: MIT
"""What a knob of the configuration is, and how its values are checked."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from functools import cache
from typing import Any

from densify.config.errors import InputError


def knob(
    default: Any,
    help: str,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field with what `Section` checks and default.yaml says.

    help: what turning the knob does, unit in brackets. low, high: inclusive bounds of a number.
    choices: the words a text knob accepts.
    """
    metadata = {"help": help, "low": low, "high": high, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Section:
    """The knobs of one stage, checked whenever one is made."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            object.__setattr__(self, field.name, checked(type(self), field.name, value, ""))


def checked(section: type[Section], key: str, value: Any, where: str) -> Any:
    """The value as its knob's type; InputError if it has another type or is out of range."""
    field = section.__dataclass_fields__[key]
    kind = _kinds(section)[key]  # type: ignore[arg-type]  # a class is hashable
    optional = isinstance(kind, types.UnionType)
    if optional:
        kind = next(t for t in typing.get_args(kind) if t is not types.NoneType)
        if value is None:
            return None
    typed = _as(kind, value)
    low, high, choices = (field.metadata[m] for m in ("low", "high", "choices"))
    if typed is not None:
        if choices is not None and typed in choices:
            return typed
        if choices is None and (kind in (bool, str) or low <= typed <= high):
            return typed
    if choices is not None:
        expected = f"one of {', '.join(choices)}"
    elif kind is bool:
        expected = "true or false"
    elif kind is str:
        expected = "text"
    else:
        expected = f"{'a whole number' if kind is int else 'a number'} from {low:g} to {high:g}"
    expected += " or null" if optional else ""
    name = f"{section.__name__.removesuffix('Settings').lower()}.{key}"
    raise InputError(
        f"{where}{name}: got {value!r}, expected {expected} ({field.metadata['help']})"
    )


@cache
def _kinds(section: type[Section]) -> dict[str, Any]:
    """The knobs' types, which are texts until they are asked for."""
    return typing.get_type_hints(section)


def _as(kind: Any, value: Any) -> Any:
    """`value` as bool, int, float or str, None if it is not one."""
    if kind is float and isinstance(value, str | int) and not isinstance(value, bool):
        try:
            value = float(value)  # text too: YAML 1.1 reads 1e-3 as text
        except (ValueError, OverflowError):
            return None
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        return None
    return value
