# SPDX-License-Identifier: MIT
"""Train a network on drawn samples with the loss of a teacher, by Adam.

The same seed gives the same bytes on CPUs of one kind: it fixes samples, and torch has one thread.

A teacher is a source of supervision. ``objective`` is the published objective in m² per point
(Pontes, Hays, Lucey, 3DV 2020, sections 3 and 4), with alpha = 4 (10 without learning) and a graph
of 50 neighbours. It needs no labels. ``engine`` and ``truth`` compare with a known flow. A plain
mean over points, nearly all static, teaches a network to predict no motion. Therefore the loss, in
metres, is a sum of means over static points, points slower than 1 m/s, and faster points (DeFlow,
Zhang et al., ICRA 2024, eq. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from densify.config.errors import ComputationError, InputError
from densify.flow.objective.energy import energy, on_one_thread
from densify.flow.objective.graph import knn_graph, laplacian
from densify.geometry.types import Progress
from densify.learning.network import NUM_SWEEPS, Model, Sweeps, build, write_model
from densify.learning.samples import ClipMaker, Sample, samples

ALPHA, NUM_NEIGHBORS = 4.0, 50
_FAST_M_S = 1.0
_LEARNING_RATE = 2e-3
_LARGEST_GRADIENT = 1.0
_WARM_UP, _COOL_DOWN = 0.05, 0.5  # shares of the training's steps
_NUM_AVERAGED = 50  # number of losses
Predict = Callable[[Sweeps], Tensor]


@dataclass(frozen=True)
class Training:
    """The settings of a training."""

    data: tuple[str, ...]  # specifications of recordings
    steps: int  # number of training steps, each with one pair of sweeps
    teacher: str = "objective"  # source of supervision: "objective", "engine" or "truth"
    seed: int = 0
    device: str = "auto"  # device to train on, "auto", "cpu" or "cuda"


def train(training: Training, out: Path, progress: Progress | None = None) -> float:
    """Train a network, write the model to ``out``, and return the mean of its last 50 losses."""
    loss_of, device = TEACHERS[training.teacher], _device(training.device)
    if training.steps < 1:
        raise InputError(f"--steps {training.steps}: expected 1 or more")
    network = build(training.seed).to(device).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    drawn = samples(ClipMaker(training.data, training.seed, training.teacher), NUM_SWEEPS)
    losses: list[float] = []
    with on_one_thread():
        while len(losses) < training.steps:
            sample = _on_device(next(drawn), device)
            optimizer.param_groups[0]["lr"] = _learning_rate(len(losses) / training.steps)
            optimizer.zero_grad()
            loss = loss_of(network, sample)
            if not torch.isfinite(loss):
                raise ComputationError(
                    f"the loss of step {len(losses)} is {loss.item()}; try another --seed"
                )
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
            optimizer.step()
            losses.append(loss.item())
            if progress is not None:
                mean = float(np.mean(losses[-_NUM_AVERAGED:]))
                progress(f"train, loss {mean:.3g}", len(losses), training.steps)
    provenance = {name: getattr(training, name) for name in ("teacher", "seed", "steps")}
    write_model(out, Model(network, {"data": list(training.data), **provenance}))
    return float(np.mean(losses[-_NUM_AVERAGED:]))


def _device(name: str) -> torch.device:
    """Return the torch device for "cpu", "cuda", or "auto" (CUDA if available)."""
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def _on_device(value: Any, device: torch.device) -> Any:
    """Move a tensor, or all tensors of a tuple, to a device; other values stay the same."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        moved = [_on_device(element, device) for element in value]
        return type(value)(*moved) if hasattr(value, "_fields") else tuple(moved)
    return value


def _learning_rate(done: float) -> float:
    """Return the learning rate at a share of the training: a rise, a plateau, half a cosine."""
    rate = min(1.0, (done + 0.002) / _WARM_UP)
    if done > 1 - _COOL_DOWN:
        rate = 0.5 + 0.5 * np.cos(np.pi * (done - 1 + _COOL_DOWN) / _COOL_DOWN)
    return _LEARNING_RATE * max(float(rate), 0.01)


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the published objective for the drawn points of a sample, m² per point, 0-d."""
    source: Tensor = sample.sweeps[0].points[sample.drawn]  # type: ignore[union-attr]
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    flow = predict(sample.sweeps)[sample.drawn]
    loss = energy(flow, source, sample.drawn_target, laplacian(graph), ALPHA)
    return loss.total / len(source)


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the sum of the mean errors over static, slow and fast points, metres, 0-d."""
    flow, true, moving = predict(sample.sweeps), sample.flow, sample.moving
    fast = true.norm(dim=1) >= _FAST_M_S * sample.duration_s
    # The gradient of the norm itself is not a number at 0.
    error_m = ((flow - true) ** 2).sum(dim=1).add(1e-8).sqrt()
    sets = (~moving, moving & ~fast, moving & fast)
    counted = [sample.in_reach & each for each in sets]
    means = [error_m[mask].mean() for mask in counted if bool(mask.any())]
    return torch.stack(means).sum() if means else (flow * 0).sum()


TEACHERS = {"objective": objective_loss, "engine": supervised_loss, "truth": supervised_loss}
"""Loss function by teacher; it takes a network and a sample and returns a 0-d tensor."""
