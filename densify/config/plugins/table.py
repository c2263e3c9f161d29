# SPDX-License-Identifier: MIT
"""A table of modules with one interface: the built-in ones, and those of other people's packages.

A package adds a row by an entry point: the name is the row's, the value is a module::

    [project.entry-points."densify.readers"]
    npy = "densify_npy.reader"
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from densify.config.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class Row(Protocol):
    """name: as users write it. module: import path of the module that does the work."""

    @property
    def name(self) -> str: ...

    @property
    def module(self) -> str: ...

    @property
    def usage(self) -> str:
        """How users write it, what may follow the name included."""
        ...


R = TypeVar("R", bound=Row)
_LOADED: dict[str, str] = {}  # other people's modules, by the name of the outermost: what they are


def owner_of(error: BaseException) -> str:
    """Which row of another package an exception went through, "" if none."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        if (found := module.partition(".")[0]) in _LOADED:
            return _LOADED[found]
    return ""


@dataclass(frozen=True)
class Table(Generic[R]):
    """kind: what a row is, for messages. group: of the entry points. members: functions that every
    module must have. row_of: name, module and version of another package -> row."""

    kind: str
    group: str
    built_in: tuple[R, ...]
    members: tuple[str, ...]
    row_of: Callable[[str, ModuleType, str], R]

    def usages(self) -> list[str]:
        """How the rows are written: the built-in ones, then other packages' names, sorted."""
        return [row.usage for row in self.built_in] + sorted(self._added())

    def __contains__(self, name: str) -> bool:
        return self._is_built_in(name) or name in self._added()

    def require(self, name: str, where: str) -> None:
        """Raise InputError unless there is such a row. Imports nothing.

        where: what the name was given to, for the message.
        """
        if name not in self:
            raise InputError(
                f"{where}: got {name!r}, expected one of {', '.join(self.usages())} (others come "
                f"with packages that have an entry point in {self.group})"
            )

    def row(self, name: str, where: str) -> R:
        """The row of that name. Imports the module of another package. Raises InputError if there
        is none, several packages have one, or the package is broken."""
        self.require(name, where)
        for row in self.built_in:
            if row.name == name:
                return row
        return self._load(name, self._added()[name])

    def __iter__(self) -> Iterator[R]:
        """The built-in rows, then those of other packages, each imported when its turn comes."""
        yield from self.built_in
        for name, points in sorted(self._added().items()):
            yield self._load(name, points)

    def module(self, row: R) -> ModuleType:
        """That does the work; imported when asked for."""
        return import_module(row.module)

    def _is_built_in(self, name: str) -> bool:
        return any(row.name == name for row in self.built_in)

    def _added(self) -> dict[str, list[EntryPoint]]:
        """Entry points of other packages by name; no built-in row can be replaced."""
        from importlib.metadata import entry_points

        found: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self.group):
            if not self._is_built_in(point.name) and point not in found.get(point.name, []):
                found.setdefault(point.name, []).append(point)
        return found

    def _load(self, name: str, points: list[EntryPoint]) -> R:
        packages = " and ".join(
            sorted({point.dist.name if point.dist else "?" for point in points})
        )
        if len(points) > 1:
            raise InputError(
                f"{self.kind} {name}: comes with the packages {packages}; uninstall all but one"
            )
        what = f"{self.kind} {name} of the package {packages}"
        try:
            module = points[0].load()
        except Exception as error:  # whatever a stranger's import raises
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(
                f"{what}: cannot be imported from {points[0].value} ({reason}); mend or uninstall "
                f"the package"
            ) from error
        missing = [m for m in self.members if not callable(getattr(module, m, None))]
        if missing or not isinstance(module, ModuleType):
            raise InputError(
                f"{what}: {points[0].value} is no module with {', '.join(self.members)}; mend or "
                f"uninstall the package"
            )
        _LOADED[module.__name__.partition(".")[0]] = what
        return self.row_of(name, module, points[0].dist.version if points[0].dist else "")
