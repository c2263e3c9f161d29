# SPDX-License-Identifier: MIT
"""Clips so small that training on them takes seconds: posts that stand, one block that moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import densify.learning.training
from densify.learning.clips import Clip, ClipMaker, ClipSweep

NUM_SWEEPS = 4
PERIOD_S = 0.1


def clip(number: int, seed: int = 0, num_points: int = 300) -> Clip:
    """The block moves at 10 m/s along x, everything is measured anew in each sweep."""
    rng = np.random.default_rng([seed, number])
    posts = rng.uniform(-20, 20, (12, 2))
    block, speed = rng.uniform(-8, 8, 2), np.array([10.0, 0.0])
    sweeps = []
    for i in range(NUM_SWEEPS):
        own = rng.integers(len(posts), size=num_points)
        standing = posts[own] + rng.uniform(-0.3, 0.3, (num_points, 2))
        moving = block + speed * i * PERIOD_S + rng.uniform([-2, -0.9], [2, 0.9], (num_points, 2))
        height_m = rng.uniform(0.3, 2.0, 2 * num_points)
        points = np.column_stack([np.concatenate([standing, moving]), height_m - 1.7])
        moves = np.arange(2 * num_points) >= num_points
        step = np.array([*speed, 0.0]) * PERIOD_S
        flow = np.stack([-step * moves[:, None] * (i > 0), step * moves[:, None]])
        flow[1] *= i < NUM_SWEEPS - 1
        sweeps.append(
            ClipSweep(
                points.astype(np.float32),
                height_m.astype(np.float32),
                np.zeros(3, np.float32),
                i * PERIOD_S,
                flow.astype(np.float32),
                moves,
            )
        )
    return tuple(sweeps)


@dataclass(frozen=True)
class SmallClips(ClipMaker):
    """In the place of clips of recordings."""

    def __call__(self, number: int) -> Clip:
        return clip(number, self.seed)


def train_small(out: str, **options) -> Path:
    """`train` on small clips in this process."""
    training = densify.learning.training
    before, training.ClipMaker = training.ClipMaker, SmallClips
    try:
        settings = training.Training(("streets",), **{"teacher": "truth", **options})
        training.train(settings, Path(out))
        return Path(out)
    finally:
        training.ClipMaker = before
