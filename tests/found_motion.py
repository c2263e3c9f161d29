# SPDX-License-Identifier: MIT
"""The motion that is found in a tiny scene, beside the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.config import Config
from densify.flow import engines as engine_scene
from densify.flow.engines import estimate_motion
from densify.flow.tracking.groups import GroupMotion
from densify.free_space.ground import HeightMap, ground
from densify.geometry.types import FlowField, Motion, Stretch
from tests.scenes import Arc, Scanner, Scene, World, street

CONFIG = Config()
NOISE = Scanner(sigma_m=0.01)
KEY = 5


@dataclass
class Found:
    """A scene, the motion in a stretch of it, and the flow of each sweep to the next one towards
    the key."""

    scene: Scene
    stretch: Stretch
    ground: HeightMap
    motion: GroupMotion
    fields: tuple[FlowField, ...]

    @staticmethod
    def of(movers, ego=None, size=4, scanner=NOISE, extra=()) -> Found:
        world = World((*street(), *extra, *movers))
        return Found.around(KEY, Scene(world, ego or Arc(0, -1.5, 0, 6.0, 0.0), scanner), size)

    @staticmethod
    def around(middle: int, scene: Scene, size: int) -> Found:
        stretch = scene.stretch(middle, size)
        heights = ground(stretch)
        motion = motion_in(stretch, heights)
        assert isinstance(motion, GroupMotion)
        fields = tuple(motion.flow(f, toward_key(f)) for f in stretch.frames)
        return Found(scene, stretch, heights, motion, fields)

    def near_key(self, reach=3):
        """(frame, scan, field) of the sweeps within ``reach`` of the key."""
        for frame, flow in zip(self.stretch.frames, self.fields, strict=True):
            if abs(frame - KEY) <= reach:
                yield frame, self.scene.scan(frame), flow

    def errors_m(self, instance: int, reach=3) -> np.ndarray:
        """Of the instance's points that move: off the true displacement to the next sweep."""
        found = []
        for frame, scan, flow in self.near_key(reach):
            on = (scan.instance == instance) & flow.moving
            true = self.scene.displacement(frame, toward_key(frame))
            found.append(np.linalg.norm(flow.displacement - true, axis=1)[on])
        return np.concatenate(found)

    def share_moving(self, instance: int, reach=3) -> float:
        moving = [f.moving[s.instance == instance] for _, s, f in self.near_key(reach)]
        return float(np.concatenate(moving).mean())

    def track_of(self, instance: int, reach=3) -> int:
        """The number most of the instance's moving points carry."""
        numbers = [
            f.instance[(s.instance == instance) & f.moving] for _, s, f in self.near_key(reach)
        ]
        return int(np.bincount(np.concatenate(numbers)).argmax())

    def false_share(self) -> float:
        """Of the points on what stands still: marked as moving."""
        frames = zip(self.stretch.frames, self.fields, strict=True)
        return float(
            np.concatenate([f.moving[self.scene.scan(k).instance < 0] for k, f in frames]).mean()
        )


def motion_in(stretch: Stretch, heights: HeightMap) -> Motion:
    """By the default engine."""
    scene = engine_scene.Scene(stretch, heights)
    return estimate_motion(scene, CONFIG)


def toward_key(frame: int) -> int:
    return frame + int(np.sign(KEY - frame))
