# SPDX-License-Identifier: MIT
"""Sweeps of a few points whose motion from sweep to sweep, and so over many, is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from densify.flow.engines import ChainedMotion
from densify.geometry import poses
from densify.geometry.types import FlowField, RegisteredSweep, Stretch, Sweep

FRAMES = range(100, 107)
KEY = 103
PAIRS = [(f, t) for f in FRAMES for t in FRAMES if f != t]
NUM_STATIC, NUM_MOVING = 20, 15
CAR = 4


def T_world_lidar(frame: int) -> np.ndarray:
    """An ego vehicle that drives, turns, pitches; at no frame of the tests the identity."""
    return poses.exp(np.array([0.01, -0.02, 0.15, 1.3, -0.2, 0.05]) * (frame - 98))


def registered(frame: int, points_world: np.ndarray) -> RegisteredSweep:
    n = len(points_world)
    sweep = Sweep(
        frame=frame,
        stamp_ns=frame * 100_000_000,
        points=poses.transform(poses.inverse(T_world_lidar(frame)), points_world),
        intensity=np.linspace(0, 1, n).astype(np.float32),
        offset_ns=None,
        lidar=np.zeros(n, np.uint8),
        row=np.arange(n) * 3,
    )
    return RegisteredSweep(sweep, T_world_lidar(frame), np.zeros(6), np.zeros(6))


def chained(
    points: Mapping[int, np.ndarray],
    moved: Callable[[int, int], np.ndarray],
    instance: Mapping[int, np.ndarray],
) -> ChainedMotion:
    """points: world, of every frame. moved: (frame, target) -> displacement in the world."""
    frames = tuple(points)

    def step(here: int, there: int) -> FlowField:
        assert abs(here - there) == 1
        return flow_field(frames[here], moved(frames[here], frames[there]), instance[frames[here]])

    stretch = Stretch(tuple(registered(f, p) for f, p in points.items()))
    return ChainedMotion(stretch, step)


def flow_field(frame: int, moved: np.ndarray, instance: np.ndarray) -> FlowField:
    """moved: (N,3) displacement in the world. What stands still has instance -2."""
    return FlowField(
        displacement=moved @ T_world_lidar(frame)[:3, :3],
        moving=instance > -2,
        instance=np.maximum(instance, -1).astype(np.int32),
        lost=np.zeros(len(instance), bool),
    )


def in_world(frame: int, vectors: np.ndarray) -> np.ndarray:
    return vectors @ T_world_lidar(frame)[:3, :3].T


def drifting(frame: int) -> np.ndarray:
    """10 times 1.5, -0.5, 0.1 m/s."""
    return poses.exp(np.array([0, 0, 0, 1.5, -0.5, 0.1]) * (frame - KEY))


def turning(frame: int) -> np.ndarray:
    """A rigid object: drives a bend and turns by 0.3 rad from sweep to sweep."""
    t = frame - KEY
    return poses.exp(np.array([0, 0, 0.3 * t, 8 + 1.1 * t, 2 - 0.1 * t * t, 0.02 * t]))


def scene(body=turning, sizes=None, frames=FRAMES) -> ChainedMotion:
    """Static points and one object, sampled anew in every sweep; the exact flow of every step."""
    rng = np.random.default_rng(0)
    sizes = sizes or dict.fromkeys(FRAMES, NUM_MOVING)
    still = {f: rng.uniform(-20, 20, (NUM_STATIC, 3)) for f in FRAMES}
    shape = {f: rng.uniform(-2, 2, (sizes[f], 3)) for f in FRAMES}

    def moved(frame: int, target: int) -> np.ndarray:
        here, there = (poses.transform(body(f), shape[frame]) for f in (frame, target))
        return np.vstack([np.zeros((NUM_STATIC, 3)), there - here])

    points = {f: np.vstack([still[f], poses.transform(body(f), shape[f])]) for f in frames}
    instance = {f: np.repeat([-2, CAR], [NUM_STATIC, sizes[f]]) for f in frames}
    return chained(points, moved, instance)


def true_flow(motion: ChainedMotion, frame: int, target: int, body=turning) -> np.ndarray:
    """Of the object's points, world."""
    here = poses.transform(T_world_lidar(frame), motion.stretch[frame].sweep.points)[NUM_STATIC:]
    return poses.transform(body(target) @ poses.inverse(body(frame)), here) - here
