# SPDX-License-Identifier: MIT
"""The engines of scene flow. Each has the function `densify.flow.engines.EngineModule`; the module
of another package may have ARGUMENT and SHARED."""

from __future__ import annotations

from dataclasses import dataclass

from densify.config.errors import InputError
from densify.config.plugins.table import Row, Table


@dataclass(frozen=True)
class Engine(Row):
    """argument: what follows the name after a colon, "" for nothing. shared: the motion of a long
    stretch serves every key in it (`densify.flow.engines.SharedMotion`); else each key's window is
    estimated alone."""

    argument: str = ""
    shared: bool = False

    @property
    def usage(self) -> str:
        """How ``flow.engine`` names it."""
        return f"{self.name}:{self.argument}" if self.argument else self.name


ENGINES = Table(
    "engine",
    "densify.flow_engines",
    ("estimate_motion",),
    (
        Engine(
            "groups",
            "densify.flow.tracking.groups",
            about="groups of points whose motion is proven, rigid and softened",
            shared=True,
        ),
        Engine(
            "pairs", "densify.flow.pairs.estimate", about="two sweeps at a time, as estimate_flow"
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
            "densify.readers.open_scene_flow",
            about="labels or a network's flow in OpenSceneFlow's file of the recording",
            argument="FILE[#NAME]",
        ),
    ),
)


def check_spec(spec: str) -> None:
    """Raise InputError unless ``spec`` is ``NAME[:ARGUMENT]`` of an engine. Imports no engine."""
    name, _, argument = spec.partition(":")
    ENGINES.require(name, "flow.engine")
    for row in ENGINES.built_in:
        if row.name == name and bool(row.argument) != bool(argument):
            raise InputError(f"flow.engine: got {spec!r}, expected {row.usage}")


def engine(spec: str) -> tuple[Engine, str]:
    """Return row and argument of ``NAME[:ARGUMENT]``. Raises InputError for no such engine."""
    check_spec(spec)
    name, _, argument = spec.partition(":")
    return ENGINES.row(name, "flow.engine"), argument


def described() -> str:
    """Return one line about the built-in engines, for help texts."""
    return "; ".join(f"{row.usage}: {row.about}" for row in ENGINES.built_in)
