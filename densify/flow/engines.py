# SPDX-License-Identifier: MIT
"""How everything in a stretch moves: all engines behind one call.

The table of engines, and how to add one, is `densify.config.plugins.engines`.
"""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Protocol, cast, get_type_hints

from densify.config import Config
from densify.config.errors import InputError
from densify.config.plugins.engines import ENGINES, engine
from densify.flow.scene import Scene
from densify.geometry.types import Motion, Stretch


class SharedMotion(Motion, Protocol):
    """Motion of a long stretch that serves every key in it.

    A dataclass that is kept without points, by the types of its fields (`config.cache_codec`).
    """

    def with_stretch(self, stretch: Stretch) -> SharedMotion:
        """The same motion with the sweeps that it was estimated from, where any may lack their
        points; an empty stretch where it is to be kept without."""
        ...


class EngineModule(Protocol):
    """What the module of an engine has.

    It may have ``check_argument(argument: str) -> None`` too, called before anything is computed,
    which raises InputError for an argument that cannot be used.
    """

    def estimate_motion(self, scene: Scene, settings: Config, argument: str) -> Motion:
        """How everything in the scene's stretch moves.

        argument: what follows the engine's name and a colon in ``flow.engine``, "" for nothing.
        May estimate at once or when the motion's ``flow`` is called; same input, same bytes. A
        `SharedMotion` where the engine's row says ``shared``, and then annotated as returning
        the very type of it.
        """
        ...


def estimate_motion(scene: Scene, settings: Config, spec: str | None = None) -> Motion:
    """Estimate by the engine ``NAME[:ARGUMENT]``, that of ``flow.engine`` if None."""
    row, argument = engine(spec or settings.flow.engine)
    module = cast(EngineModule, ENGINES.module(row))
    return module.estimate_motion(scene, settings, argument)


def motion_type(spec: str) -> type[SharedMotion]:
    """What the engine's ``estimate_motion`` is annotated to return. Raises InputError if that is no
    dataclass."""
    row, _ = engine(spec)
    found = get_type_hints(ENGINES.module(row).estimate_motion).get("return")
    if not (isinstance(found, type) and is_dataclass(found)):
        raise InputError(
            f"flow.engine: {row.name} shares its motion among keys, expected an estimate_motion "
            f"annotated as returning a dataclass, got {found}"
        )
    return cast(type[SharedMotion], found)


def check_engine(spec: str) -> None:
    """Find out before a computation whether the engine is there and can use its argument; imports
    it. Raises InputError."""
    row, argument = engine(spec)
    if row.shared:
        motion_type(spec)
    check = getattr(ENGINES.module(row), "check_argument", None)
    if check is not None:
        check(argument)
