# SPDX-License-Identifier: MIT
"""The windows that benchmarks work on: sweeps registered around a key, and our motion of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from densify.config import Config
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.geometry import poses
from densify.geometry.types import Bool, Float, LidarSequence, Motion, Stretch
from densify.pipeline.recording import Recording


@dataclass(frozen=True)
class Window:
    """Consecutive sweeps around the key. above: by frame (N,) above the ground. around: the
    sweeps that our motion of it is found out from."""

    stretch: Stretch
    key: int
    around: Stretch
    above: Mapping[int, Bool]

    @staticmethod
    def open(sequence: LidarSequence, key: int, size: int, config: Config) -> Window:
        """The key's window, as the pipeline has it. Raises InputError for a missing key,
        ComputationError where registration went wrong."""
        recording = Recording(sequence, config, size, [key], looks_around=True)
        stretch, around = recording.window(key), recording.around(key)
        heights = ground(stretch)
        above = {f: heights.above(_in_world(stretch, f)) >= ABOVE_GROUND_M for f in stretch.frames}
        return Window(stretch, key, around, above)

    @property
    def frames(self) -> tuple[int, ...]:
        return self.stretch.frames

    def towards_key(self, frame: int) -> int:
        """The neighbour on the way to the key; the key itself of the key."""
        here, key = self.frames.index(frame), self.frames.index(self.key)
        return self.frames[here + (key > here) - (key < here)]

    def points(self, frame: int) -> Float:
        """(N,3) of a sweep, world, z up."""
        return _in_world(self.stretch, frame)

    def around_key(self) -> Stretch:
        """The key and its neighbours."""
        key = self.frames.index(self.key)
        return Stretch(self.stretch.sweeps[max(0, key - 1) : key + 2])


def our_motion(stretch: Stretch, config: Config, asked: Collection[int] | None = None) -> Motion:
    """This package's engine, or that of ``flow.engine``, from the ground on. asked: frames whose
    flow will be asked for, all if None."""
    heights = ground(stretch)
    scene = Scene(stretch, heights, asked=asked)
    return estimate_motion(scene, config)


def _in_world(stretch: Stretch, frame: int) -> Float:
    registered = stretch[frame]
    return poses.transform(registered.T_world_lidar, registered.sweep.points)
