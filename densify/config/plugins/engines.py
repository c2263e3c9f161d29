# SPDX-License-Identifier: MIT
"""The engines: each finds out how everything in a stretch of sweeps moves.

To add one, write a module with the function that `densify.flow.engines.EngineModule` describes and
one row here; in a package of your own an entry point in the group ``densify.flow_engines`` takes
the row's place, and the module may say ``ARGUMENT`` and ``SHARED`` as the row does.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

from densify.config.errors import InputError
from densify.config.plugins.table import Table


@dataclass(frozen=True)
class Engine:
    """argument: what follows the name after a colon, "" for nothing. shared: the motion of a long
    stretch serves every key in it (`densify.flow.engines.SharedMotion`); else it is made for each
    key's window. version: of the package that brings it, "" for densify's own: motion that was kept
    is of no use to another version."""

    name: str
    module: str
    about: str
    argument: str = ""
    shared: bool = False
    version: str = ""

    @property
    def usage(self) -> str:
        """How ``flow.engine`` names it."""
        return f"{self.name}:{self.argument}" if self.argument else self.name


def _row(name: str, module: ModuleType, version: str) -> Engine:
    return Engine(
        name,
        module.__name__,
        about=(module.__doc__ or "").strip().partition("\n")[0],
        argument=getattr(module, "ARGUMENT", ""),
        shared=getattr(module, "SHARED", False),
        version=version,
    )


ENGINES = Table(
    kind="engine",
    group="densify.flow_engines",
    built_in=(
        Engine(
            "groups",
            "densify.flow.tracking.groups",
            about="groups of points whose motion is proven, rigid and softened",
            shared=True,
        ),
        Engine(
            "pairs",
            "densify.flow.pairs.engine",
            about="two sweeps at a time, as estimate_flow",
        ),
        Engine(
            "paper",
            "densify.flow.objective.engine",
            about="the published objective, see the section objective",
        ),
        Engine(
            "network",
            "densify.learning.engine",
            about="what a network of densify train flow sees move, proven as with groups",
            argument="MODEL",
        ),
        Engine(
            "npz",
            "densify.readers.flow_files",
            about="files of others, see docs/formats.md",
            argument="DIR",
        ),
        Engine(
            "opensceneflow",
            "densify.readers.open_scene_flow.labels",
            about="labels or a network's flow in OpenSceneFlow's file of the recording",
            argument="FILE[#NAME]",
        ),
    ),
    members=("estimate_motion",),
    row_of=_row,
)


def check_spec(spec: str) -> None:
    """Raise InputError unless ``spec`` is ``NAME[:ARGUMENT]`` of an engine. Imports no engine."""
    name, _, argument = spec.partition(":")
    ENGINES.require(name, "flow.engine")
    for row in ENGINES.built_in:
        if row.name == name and bool(row.argument) != bool(argument):
            raise InputError(f"flow.engine: got {spec!r}, expected {row.usage}")


def engine(spec: str) -> tuple[Engine, str]:
    """Row and argument of ``NAME[:ARGUMENT]``. Raises InputError for no such engine."""
    check_spec(spec)
    name, _, argument = spec.partition(":")
    return ENGINES.row(name, "flow.engine"), argument


def described() -> str:
    """What the built-in engines are, for help texts."""
    return "; ".join(f"{row.usage}: {row.about}" for row in ENGINES.built_in)
