# SPDX-License-Identifier: MIT
"""Tables of plug-ins: the built-in ones, and those that other packages add by entry points.

The entry point's name is the plug-in's, its value a module::

    [project.entry-points."densify.readers"]
    npy = "densify_npy.reader"
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Generic, TypeVar

from densify.config.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class Row:
    """One plug-in. The fields that kinds of plug-in add are read from the attributes of another
    package's module: ``owned`` from OWNED, a function from its own name.

    name: as users write it. module: import path. about: a sentence for the help.
    """

    name: str
    module: str
    about: str = field(default="", kw_only=True)

    @property
    def usage(self) -> str:
        """How users write it."""
        return self.name


R = TypeVar("R", bound=Row)


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
        there is none, or the package is broken."""
        self.require(name, where)
        rows = {row.name: row for row in self.built_in}
        return rows[name] if name in rows else self._load(self._added()[name])

    def __iter__(self) -> Iterator[R]:
        """Yield the built-in rows, then those of other packages, imported one by one."""
        yield from self.built_in
        yield from (self._load(point) for _, point in sorted(self._added().items()))

    def module(self, row: R) -> ModuleType:
        """Import the module that does the work."""
        return import_module(row.module)

    def _added(self) -> dict[str, EntryPoint]:
        """Return the entry points of other packages by name; none replaces a built-in one."""
        from importlib.metadata import entry_points

        built_in = {row.name for row in self.built_in}
        points = entry_points(group=self.group)
        return {point.name: point for point in points if point.name not in built_in}

    def _load(self, point: EntryPoint) -> R:
        """Return the row of a plug-in, as its module describes it."""
        package = point.dist.name if point.dist else "?"
        what = f"{self.kind} {point.name} of the package {package}"
        try:
            module = point.load()
        except Exception as error:  # an import raises anything
            raise InputError(
                f"{what}: cannot be imported from {point.value} ({type(error).__name__}: {error}); "
                f"mend or uninstall the package"
            ) from error
        if not all(callable(getattr(module, member, None)) for member in self.members):
            raise InputError(
                f"{what}: {point.value} is no module with {', '.join(self.members)}; mend or "
                f"uninstall the package"
            )
        row_type = type(self.built_in[0])
        own = {f.name for f in fields(row_type)} - {f.name for f in fields(Row)}
        values = {name: getattr(module, name, getattr(module, name.upper(), None)) for name in own}
        return row_type(
            point.name,
            module.__name__,
            about=(module.__doc__ or "").strip().partition("\n")[0],
            **{name: value for name, value in values.items() if value is not None},
        )
