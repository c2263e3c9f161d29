# SPDX-License-Identifier: MIT
"""The windows that benchmarks work on: sweeps registered around a key, and our motion of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from densify.config import Config
from densify.flow.engines import estimate_motion
from densify.flow.scene import Scene
from densify.geometry import poses
from densify.geometry.ground import ground
from densify.pipeline import find_trajectory
from densify.readers.window import read_sweeps, window_frames
from densify.registration.deskew import deskew
from densify.types import Bool, Float, LidarSequence, Motion, Stretch


@dataclass(frozen=True)
class Window:
    """Consecutive sweeps around the key. above: by frame (N,) above the ground."""

    stretch: Stretch
    key: int
    above: Mapping[int, Bool]

    @staticmethod
    def open(sequence: LidarSequence, key: int, size: int, config: Config) -> Window:
        """Read, register and deskew, as the pipeline does. Raises InputError for missing frames,
        ComputationError where registration went wrong."""
        frames, lead_in = window_frames(sequence, key, size, config.register.num_lead_in)
        sweeps = list(read_sweeps(sequence, [*lead_in, *frames], config.register))
        trajectory = find_trajectory(sequence, sweeps, config.register)
        stretch = deskew([s for s in sweeps if s.frame in frames], trajectory)
        heights = ground(stretch, config.ground)
        above = {
            f: heights.above(_in_world(stretch, f)) >= config.flow.min_height_m for f in frames
        }
        return Window(stretch, key, above)

    @property
    def frames(self) -> tuple[int, ...]:
        return self.stretch.frames

    def towards_key(self, frame: int) -> int:
        """The neighbour on the way to the key; the key itself of the key."""
        return frame + (self.key > frame) - (self.key < frame)

    def points(self, frame: int) -> Float:
        """(N,3) of a sweep, world, z up."""
        return _in_world(self.stretch, frame)

    def around_key(self) -> Stretch:
        """The key and its neighbours."""
        near = tuple(s for s in self.stretch.sweeps if abs(s.frame - self.key) <= 1)
        return Stretch(near)


def our_motion(stretch: Stretch, config: Config) -> Motion:
    """From the ground on."""
    heights = ground(stretch, config.ground)
    return estimate_motion(Scene(stretch, heights, config.flow.min_height_m), config)


def _in_world(stretch: Stretch, frame: int) -> Float:
    registered = stretch[frame]
    return poses.transform(registered.T_world_lidar, registered.sweep.points)
