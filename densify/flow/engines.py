# SPDX-License-Identifier: MIT
"""Call any engine of scene flow. `densify.config.plugins` has their table."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, cast

from densify.config import Config
from densify.config.plugins import engine
from densify.flow.tracking.candidates import Candidates, find_candidates
from densify.free_space.ground import HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.geometry.types import Motion, Stretch


@dataclass(frozen=True, eq=False)
class Scene:
    """The input of an engine: registered sweeps in one world, their ground and free space.

    Attributes:
        ground: Under all sweeps.
        asked: Frames whose flow is needed, None for all. The other sweeps only help to find
            motion.
    """

    stretch: Stretch
    ground: HeightMap
    asked: Collection[int] | None = None

    @cached_property
    def space(self) -> FreeSpace:
        """The free space that each sweep observed."""
        return FreeSpace.of(self.stretch)

    @cached_property
    def candidates(self) -> tuple[Candidates, ...]:
        """The points of each sweep that may move."""
        return find_candidates(self.stretch, self.space, self.ground)

    def is_asked(self, i: int) -> bool:
        """Return True if the flow of sweep number i is needed."""
        return self.asked is None or self.stretch.sweeps[i].frame in self.asked


class SharedMotion(Motion, Protocol):
    """Motion of a long stretch that serves every key in it.

    It is a dataclass that is cached on disk without points.
    """

    def with_stretch(self, stretch: Stretch) -> SharedMotion:
        """Return the same motion with other copies of its sweeps, which may lack their points.

        Before it is written to disk the stretch is empty.
        """
        ...


class EngineModule(Protocol):
    """The functions of an engine's module.

    It may also have ``check_argument(argument: str) -> None``. It is called before anything is
    computed, and raises InputError for a bad argument.
    """

    def estimate_motion(self, scene: Scene, settings: Config, argument: str) -> Motion:
        """Return the motion of all points of the scene's stretch.

        The same input gives the same bytes. Work may be postponed until the motion's ``flow`` is
        called. If the engine's row says ``shared``, the motion is a `SharedMotion`.

        Args:
            argument: The part of ``flow.engine`` after the colon, "" for none.
        """
        ...


def estimate_motion(scene: Scene, settings: Config, spec: str | None = None) -> Motion:
    """Return the motion by the engine ``NAME[:ARGUMENT]``, that of ``flow.engine`` for None."""
    row, argument = engine(spec or settings.flow.engine)
    module = cast(EngineModule, row.work())
    return module.estimate_motion(scene, settings, argument)


def check_engine(spec: str) -> None:
    """Raise InputError if the engine does not exist or cannot use its argument; imports it."""
    row, argument = engine(spec)
    check = getattr(row.work(), "check_argument", None)
    if check is not None:
        check(argument)
