# SPDX-License-Identifier: MIT
"""Run the scene flow engine that the settings name; `densify.config.plugins` lists all engines."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, cast

from densify.config import Config
from densify.config.plugins import engine
from densify.flow.tracking.candidates import Obstacles, find_candidates
from densify.free_space.ground import HeightMap
from densify.free_space.range_image import FreeSpace
from densify.geometry.types import Motion, Stretch


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of a scene flow engine: registered sweeps in one world, their ground and free space."""

    stretch: Stretch  # consecutive registered sweeps
    ground: HeightMap  # height map of the ground under all sweeps
    # Frame numbers whose flow is needed, None for all. The other sweeps only help to find motion.
    asked: Collection[int] | None = None

    @cached_property
    def space(self) -> FreeSpace:
        """The free space that each sweep observed."""
        return FreeSpace.of(self.stretch)

    @cached_property
    def obstacles(self) -> tuple[Obstacles, ...]:
        """The points of each sweep above the ground, and which of them may move."""
        return find_candidates(self.stretch, self.space, self.ground)

    def is_asked(self, i: int) -> bool:
        """Return True if the flow of the sweep with index i is needed."""
        return self.asked is None or self.stretch.sweeps[i].frame in self.asked


class SharedMotion(Motion, Protocol):
    """Motion of a long stretch that serves every key frame in it."""

    # A dataclass, which the disk cache stores without the points of its sweeps

    def with_stretch(self, stretch: Stretch) -> SharedMotion:
        """Return the same motion on another copy of its stretch; that on disk has no points."""
        ...


class EngineModule(Protocol):
    """The functions of an engine's module.

    A module may also have ``check_argument(argument: str) -> None``. It is called before anything
    is computed, and raises InputError for a bad argument.
    """

    def estimate_motion(self, scene: Scene, settings: Config, argument: str) -> Motion:
        """Return the motion of all points in the scene; the same input gives the same bytes.

        ``argument`` is the text after the colon in ``flow.engine``, "" without a colon. Work may
        wait until the motion's ``flow`` is called. An engine that is registered as ``shared``
        returns a `SharedMotion`.
        """
        ...


def estimate_motion(scene: Scene, settings: Config, spec: str | None = None) -> Motion:
    """Return the motion of all points in a scene, by one scene flow engine.

    It is the engine ``spec``, as ``NAME`` or ``NAME:ARGUMENT``, or that of the settings. InputError
    is raised for an unknown name, or an argument that the engine rejects.
    """
    plugin, argument = engine(spec or settings.flow.engine)
    module = cast(EngineModule, plugin.load_module())
    return module.estimate_motion(scene, settings, argument)


def check_engine(spec: str) -> None:
    """Import an engine ``NAME[:ARGUMENT]`` and check its argument; InputError if it is bad."""
    plugin, argument = engine(spec)
    check = getattr(plugin.load_module(), "check_argument", None)
    if check is not None:
        check(argument)
