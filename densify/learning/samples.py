# SPDX-License-Identifier: MIT
"""Pairs of sweeps to train on, in an order that follows from a seed alone.

The pairs of several clips come mixed, in both directions of time, and several times. Each time they
are turned about the vertical, mirrored and scaled at random.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from densify.geometry.types import Float32
from densify.learning.clips import Clip, ClipMaker
from densify.learning.clouds import NetworkCloud, Sweeps, order_for
from densify.learning.network import REACH_M

NUM_DRAWN = 4096
"""Points of source and target that the objective is computed for."""
_NUM_MIXED = 4  # clips
_PAIRS_OF_CLIP = 48
_SCALES = (0.95, 1.05)


@dataclass(frozen=True)
class Sample:
    """One pair of sweeps.

    sweeps: source, target, and those before the source. drawn: (d,) rows of the source that the
    objective is computed for; drawn_source, drawn_target: the drawn points. in_reach: (n,) mask of
    the source's points that count. flow: (n,3), moving: (n,), None without labels.
    """

    sweeps: Sweeps
    drawn: Tensor
    drawn_source: NetworkCloud
    drawn_target: NetworkCloud
    in_reach: Tensor
    duration_s: float
    flow: Tensor | None = None
    moving: Tensor | None = None

    def to(self, device: torch.device) -> Sample:
        """Return the sample on another device."""
        return Sample(
            tuple(None if s is None else s.to(device) for s in self.sweeps),
            self.drawn.to(device),
            self.drawn_source.to(device),
            self.drawn_target.to(device),
            self.in_reach.to(device),
            self.duration_s,
            None if self.flow is None else self.flow.to(device),
            None if self.moving is None else self.moving.to(device),
        )


def samples(make: ClipMaker, num_wanted: int, first: int = 0) -> Iterator[Sample]:
    """Yield samples from number ``first`` on, without end.

    num_wanted: sweeps that the network takes.
    """
    group, skip = divmod(first, _NUM_MIXED * _PAIRS_OF_CLIP)
    while True:
        mixed = [make(group * _NUM_MIXED + n) for n in range(_NUM_MIXED)]
        rng = np.random.default_rng([make.seed, group, 1])
        pairs = [pair for c, clip in enumerate(mixed) for pair in _pairs(c, clip, rng)]
        for place in rng.permutation(len(pairs))[skip:]:
            own = np.random.default_rng([make.seed, group, 2, int(place)])
            c, source, target = pairs[place]
            yield sample_of(mixed[c], source, target, num_wanted, make.labels, own)
        group, skip = group + 1, 0


def _pairs(c: int, clip: Clip, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Return as many (clip, source, target) of every clip, in rounds of all its pairs."""
    count = len(clip.sweeps)
    found = [(c, i, j) for i in range(count) for j in (i - 1, i + 1) if 0 <= j < count]
    num_rounds = -(-_PAIRS_OF_CLIP // len(found))
    order = [place for _ in range(num_rounds) for place in rng.permutation(len(found))]
    return [found[place] for place in order[:_PAIRS_OF_CLIP]]


def sample_of(
    clip: Clip,
    source: int,
    target: int,
    num_wanted: int,
    labels: str,
    rng: np.random.Generator | None = None,
) -> Sample:
    """Return the sample of two neighbouring sweeps of a clip, by their numbers in it.

    labels: as of `ClipMaker`. rng: turns, mirrors, scales and draws at random; None leaves the
    clouds as they are and draws evenly.
    """
    here, there = clip.sweeps[source], clip.sweeps[target]
    change = np.eye(3, dtype=np.float32) if rng is None else _random_change(rng)
    scale = np.float32(np.linalg.norm(change[2]))

    def cloud(number: int) -> NetworkCloud:
        sweep = clip.sweeps[number]
        points = torch.from_numpy((sweep.points - here.origin_m) @ change.T)
        return NetworkCloud(points, torch.from_numpy(sweep.height_m * scale))

    numbers = order_for(source, target, len(clip.sweeps), num_wanted)
    sweeps = [None if n is None else cloud(n) for n in numbers]
    first, second = cloud(source), cloud(target)
    in_reach = [(c.points[:, :2].abs() < REACH_M).all(dim=1) for c in (first, second)]
    drawn = [_draw(within.numpy(), rng) for within in in_reach]
    flow = moving = None
    if labels:
        found = getattr(here, labels)
        flow = torch.from_numpy(found.flow[int(target > source)] @ change.T)
        moving = torch.from_numpy(found.moving)
    return Sample(
        tuple(sweeps),
        drawn[0],
        first.rows(drawn[0]),
        second.rows(drawn[1]),
        in_reach[0],
        abs(there.time_s - here.time_s),
        flow,
        moving,
    )


def _random_change(rng: np.random.Generator) -> Float32:
    """Return a (3,3) matrix that turns about z, mirrors half the time, and scales."""
    angle = rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    mirror = np.diag([1.0, -1.0 if rng.random() < 0.5 else 1.0, 1.0])
    return (rng.uniform(*_SCALES) * turn @ mirror).astype(np.float32)


def _draw(within: np.ndarray, rng: np.random.Generator | None) -> Tensor:
    """Return at most `NUM_DRAWN` rows of a mask, at random or evenly spaced."""
    rows = np.flatnonzero(within)
    if len(rows) > NUM_DRAWN:
        every = np.arange(NUM_DRAWN) * len(rows) // NUM_DRAWN
        rows = rows[every] if rng is None else np.sort(rng.choice(rows, NUM_DRAWN, replace=False))
    return torch.from_numpy(rows)
