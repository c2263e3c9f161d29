# SPDX-License-Identifier: MIT
"""Draw pairs of sweeps to train on, in an order that follows from a seed alone.

The pairs of several clips are mixed, in both directions of time, and drawn several times, each time
turned about the vertical, mirrored and scaled at random.

The losses of the teachers (sources of supervision) are here too. ``objective`` is the published
objective in m² per point (Pontes, Hays, Lucey, 3DV 2020, sections 3 and 4), with alpha = 4 (10
without learning) and a graph of 50 neighbours. It needs no labels. ``engine`` and ``truth`` compare
with a known flow. A plain mean over points, nearly all static, teaches a network to predict no
motion. Therefore the loss, in metres, is a sum of means over static points, points slower than 1
m/s, and faster points (DeFlow, Zhang et al., ICRA 2024, eq. 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from densify.flow.energy import energy
from densify.flow.objective import knn_graph, laplacian
from densify.geometry.types import Float32
from densify.learning.clips import Clip, ClipMaker
from densify.learning.network import REACH_M, NetworkCloud, Sweeps, order_for

NUM_DRAWN = 4096
"""Greatest number of points of source, and of target, in the objective."""
_NUM_MIXED = 4  # number of clips
_PAIRS_OF_CLIP = 48
_SCALES = (0.95, 1.05)


class Sample(NamedTuple):
    """One pair of sweeps to train on; the source has n points."""

    sweeps: Sweeps  # source, target, and sweeps before the source; augmented coordinates
    drawn: Tensor  # (d,) rows of the source points that the objective uses
    drawn_target: Tensor  # (e,3) target points that the objective uses
    # (n,) mask of the source points within the network's grid, which count in the loss
    in_reach: Tensor
    duration_s: float
    flow: Any = None  # (n,3) known flow to the target, m, without ego-motion; None without labels
    moving: Any = None  # (n,) bool tensor, None without labels


def on_device(value: Any, device: torch.device) -> Any:
    """Move a tensor, or all tensors of a tuple, to a device; other values stay the same."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        moved = [on_device(element, device) for element in value]
        return type(value)(*moved) if hasattr(value, "_fields") else tuple(moved)
    return value


def samples(make: ClipMaker, num_wanted: int) -> Iterator[Sample]:
    """Yield samples without end, of clips from ``make``, for a network of ``num_wanted`` sweeps."""
    for group in count():
        mixed = [make(group * _NUM_MIXED + n) for n in range(_NUM_MIXED)]
        rng = np.random.default_rng([make.seed, group, 1])
        pairs = [pair for c, clip in enumerate(mixed) for pair in _pairs(c, clip, rng)]
        for row in rng.permutation(len(pairs)):
            pair_rng = np.random.default_rng([make.seed, group, 2, int(row)])
            c, source, target = pairs[row]
            yield sample_of(mixed[c], source, target, num_wanted, pair_rng)


def _pairs(c: int, clip: Clip, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Return 48 triples (c, source, target) of a clip, in random rounds of all its pairs."""
    indices = range(len(clip))
    pairs = [(c, i, j) for i in indices for j in (i - 1, i + 1) if j in indices]
    num_rounds = -(-_PAIRS_OF_CLIP // len(pairs))
    order = [row for _ in range(num_rounds) for row in rng.permutation(len(pairs))]
    return [pairs[row] for row in order[:_PAIRS_OF_CLIP]]


def sample_of(
    clip: Clip,
    source: int,
    target: int,
    num_wanted: int,
    rng: np.random.Generator | None = None,
) -> Sample:
    """Return the sample of two neighbouring sweeps (indices), random where ``rng`` is given."""
    source_sweep, target_sweep = clip[source], clip[target]
    augmentation = np.eye(3, dtype=np.float32) if rng is None else _random_change(rng)
    scale = np.float32(np.linalg.norm(augmentation[2]))

    def cloud(number: int) -> NetworkCloud:
        sweep = clip[number]
        points = torch.from_numpy((sweep.points - source_sweep.origin_m) @ augmentation.T)
        return NetworkCloud(points, torch.from_numpy(sweep.height_m * scale))

    numbers = order_for(source, target, len(clip), num_wanted)
    sweeps = tuple(None if n is None else cloud(n) for n in numbers)
    points = cloud(source).points, cloud(target).points
    in_reach = [(xyz[:, :2].abs() < REACH_M).all(dim=1) for xyz in points]
    drawn = [_draw(is_within.numpy(), rng) for is_within in in_reach]
    flow = moving = None
    if source_sweep.flow is not None:
        flow = torch.from_numpy(source_sweep.flow[int(target > source)] @ augmentation.T)
        moving = torch.from_numpy(source_sweep.moving)
    duration_s = abs(target_sweep.time_s - source_sweep.time_s)
    return Sample(sweeps, drawn[0], points[1][drawn[1]], in_reach[0], duration_s, flow, moving)


def _random_change(rng: np.random.Generator) -> Float32:
    """Return a (3,3) matrix that turns about z, mirrors half the time, and scales."""
    angle = rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    mirror = np.diag([1.0, -1.0 if rng.random() < 0.5 else 1.0, 1.0])
    return (rng.uniform(*_SCALES) * turn @ mirror).astype(np.float32)


def _draw(within: np.ndarray, rng: np.random.Generator | None) -> Tensor:
    """Return at most `NUM_DRAWN` rows where the mask is True, at random or (without rng) evenly."""
    rows = np.flatnonzero(within)
    if len(rows) > NUM_DRAWN:
        every = np.arange(NUM_DRAWN) * len(rows) // NUM_DRAWN
        rows = rows[every] if rng is None else np.sort(rng.choice(rows, NUM_DRAWN, replace=False))
    return torch.from_numpy(rows)


# Losses

Predict = Callable[[Sweeps], Tensor]
ALPHA, NUM_NEIGHBORS = 4.0, 50
FAST_M_S = 1.0


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the published objective for the drawn points of a sample, m² per point, 0-d."""
    source: Tensor = sample.sweeps[0].points[sample.drawn]  # type: ignore[union-attr]
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    flow = predict(sample.sweeps)[sample.drawn]
    loss = energy(flow, source, sample.drawn_target, laplacian(graph), ALPHA)
    return loss.total / len(source)


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the sum of the mean errors over static, slow and fast points, metres, 0-d."""
    flow, true, moving, counted = (
        predict(sample.sweeps),
        sample.flow,
        sample.moving,
        sample.in_reach,
    )
    fast = true.norm(dim=1) >= FAST_M_S * sample.duration_s
    # The gradient of the norm itself is not a number at 0.
    error_m = ((flow - true) ** 2).sum(dim=1).add(1e-8).sqrt()
    sets = (~moving, moving & ~fast, moving & fast)
    means = [error_m[counted & each].mean() for each in sets if bool((counted & each).any())]
    return torch.stack(means).sum() if means else (flow * 0).sum()


TEACHERS = {"objective": objective_loss, "engine": supervised_loss, "truth": supervised_loss}
"""Loss function by teacher; it takes a network and a sample and returns a 0-d tensor."""
