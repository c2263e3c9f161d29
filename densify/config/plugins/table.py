# SPDX-License-Identifier: MIT
"""Tables of plug-ins: the built-in ones, and those that other packages add by entry points.

The entry point's name is the plug-in's, its value a module::

    [project.entry-points."densify.readers"]
    npy = "densify_npy.reader"
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Generic, TypeVar

from densify.config.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_LOADED: dict[str, str] = {}  # outermost module of another package -> what it is, for messages


@dataclass(frozen=True)
class Row:
    """One plug-in. The fields that kinds of plug-in add are read from the attributes of another
    package's module: ``owned`` from OWNED, a function from its own name.

    name: as users write it. module: import path. about: a sentence for the help. version: of the
    other package, "" if built in.
    """

    name: str
    module: str
    about: str = field(default="", kw_only=True)
    version: str = field(default="", kw_only=True)

    @property
    def usage(self) -> str:
        """How users write it."""
        return self.name


R = TypeVar("R", bound=Row)


def owner_of(error: BaseException) -> str:
    """Return the plug-in of another package that an exception went through, "" if none."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__")).partition(".")[0]
        if module in _LOADED:
            return _LOADED[module]
    return ""


@dataclass(frozen=True)
class Table(Generic[R]):
    """kind: for messages. group: of the entry points. members: functions that each module has."""

    kind: str
    group: str
    members: tuple[str, ...]
    built_in: tuple[R, ...]

    def names(self) -> list[str]:
        """Return the built-in names, then those of other packages."""
        return [row.name for row in self.built_in] + sorted(self._added())

    def __contains__(self, name: str) -> bool:
        return name in self.names()

    def require(self, name: str, where: str) -> None:
        """Raise InputError, which begins with ``where``, unless there is such a plug-in. Imports
        none."""
        if name not in self:
            usages = [row.usage for row in self.built_in] + sorted(self._added())
            raise InputError(
                f"{where}: got {name!r}, {did_you_mean(name, self.names())}expected one of "
                f"{', '.join(usages)} (packages add others by entry points in {self.group})"
            )

    def row(self, name: str, where: str) -> R:
        """Return the row of that name; imports the module of another package. Raises InputError if
        there is none, two packages bring one, or the package is broken."""
        self.require(name, where)
        for row in self.built_in:
            if row.name == name:
                return row
        return self._load(name, self._added()[name])

    def __iter__(self) -> Iterator[R]:
        """Yield the built-in rows, then those of other packages, imported one by one."""
        yield from self.built_in
        for name, points in sorted(self._added().items()):
            yield self._load(name, points)

    def module(self, row: R) -> ModuleType:
        """Import the module that does the work."""
        return import_module(row.module)

    def _added(self) -> dict[str, list[EntryPoint]]:
        """Return the entry points of other packages by name, without the built-in names."""
        from importlib.metadata import entry_points

        found: dict[str, list[EntryPoint]] = {}
        built_in = {row.name for row in self.built_in}
        for point in entry_points(group=self.group):
            if point.name not in built_in and point not in found.get(point.name, []):
                found.setdefault(point.name, []).append(point)
        return found

    def _load(self, name: str, points: list[EntryPoint]) -> R:
        packages = " and ".join(sorted({p.dist.name if p.dist else "?" for p in points}))
        if len(points) > 1:
            raise InputError(
                f"{self.kind} {name}: comes with the packages {packages}; uninstall all but one"
            )
        what, point = f"{self.kind} {name} of the package {packages}", points[0]
        try:
            module = point.load()
        except Exception as error:  # an import raises anything
            raise InputError(
                f"{what}: cannot be imported from {point.value} ({type(error).__name__}: {error}); "
                f"mend or uninstall the package"
            ) from error
        if not all(callable(getattr(module, m, None)) for m in self.members):
            raise InputError(
                f"{what}: {point.value} is no module with {', '.join(self.members)}; mend or "
                f"uninstall the package"
            )
        _LOADED[module.__name__.partition(".")[0]] = what
        row_type = type(self.built_in[0])
        own = {f.name for f in fields(row_type)} - {f.name for f in fields(Row)}
        values = {n: getattr(module, n, getattr(module, n.upper(), None)) for n in own}
        return row_type(
            name,
            module.__name__,
            about=(module.__doc__ or "").strip().partition("\n")[0],
            version=point.dist.version if point.dist else "",
            **{n: value for n, value in values.items() if value is not None},
        )
