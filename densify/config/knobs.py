# SPDX-License-Identifier: MIT
"""Knobs of the configuration, and how their values are checked."""

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
    """Return a dataclass field that `Section` checks and configs/default.yaml explains.

    help: what turning the knob does, unit in brackets.
    low, high: inclusive bounds of a number.
    choices: the words that a text knob accepts.
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
    """Return the value as its knob's type.

    where: file or option that the value comes from, for the message.
    Raises InputError for another type or a value out of range.
    """
    metadata = section.__dataclass_fields__[key].metadata
    kind = _kinds(section)[key]  # type: ignore[arg-type]  # a class is hashable
    optional = isinstance(kind, types.UnionType)
    if optional:
        kind = next(t for t in typing.get_args(kind) if t is not types.NoneType)
        if value is None:
            return None
    typed = _as(kind, value)
    low, high, choices = (metadata[name] for name in ("low", "high", "choices"))
    if choices is not None:
        fits, expected = typed in choices, f"one of {', '.join(choices)}"
    elif kind in (bool, str):
        fits, expected = typed is not None, "true or false" if kind is bool else "text"
    else:
        fits = typed is not None and low <= typed <= high
        expected = f"{'a whole number' if kind is int else 'a number'} from {low:g} to {high:g}"
    if fits:
        return typed
    expected += " or null" * optional
    name = f"{section.__name__.removesuffix('Settings').lower()}.{key}"
    raise InputError(f"{where}{name}: got {value!r}, expected {expected} ({metadata['help']})")


@cache
def _kinds(section: type[Section]) -> dict[str, Any]:
    """Return the types of the knobs by name."""
    return typing.get_type_hints(section)


def _as(kind: Any, value: Any) -> Any:
    """Return the value as bool, int, float or str, None if it is not one."""
    if kind is float and isinstance(value, str | int) and not isinstance(value, bool):
        try:
            value = float(value)  # text too: YAML 1.1 reads 1e-3 as text
        except (ValueError, OverflowError):
            return None
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        return None
    return value
