# SPDX-License-Identifier: MIT
"""What an engine of scene flow is given: sweeps in one world, and what is known of them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property

from densify.flow.tracking.evidence import Candidates, FreeSpace, find_candidates
from densify.free_space.height_map import HeightMap
from densify.geometry.types import Stretch


@dataclass(frozen=True, eq=False)
class Scene:
    """A stretch of registered sweeps and what several engines want to know of it, each made when it
    is first asked for and then kept.

    ground: under all sweeps. min_height_m: points lower above it start no motion.
    make_space, make_candidates: where what they give is known already, as from a cache. asked:
    frames whose flow will be asked for, all if None; the others only tell what moves.
    """

    stretch: Stretch
    ground: HeightMap
    min_height_m: float
    make_space: Callable[[], FreeSpace] | None = None
    make_candidates: Callable[[], tuple[Candidates, ...]] | None = None
    asked: Collection[int] | None = None

    @cached_property
    def space(self) -> FreeSpace:
        """What each sweep saw through."""
        return FreeSpace.of(self.stretch) if self.make_space is None else self.make_space()

    @cached_property
    def candidates(self) -> tuple[Candidates, ...]:
        """What of each sweep may move: sweep by sweep, as in the stretch."""
        if self.make_candidates is not None:
            return self.make_candidates()
        return find_candidates(self.stretch, self.space, self.ground, self.min_height_m)

    def is_asked(self, i: int) -> bool:
        """Whether the flow of sweep number i will be asked for."""
        return self.asked is None or self.stretch.sweeps[i].frame in self.asked
