# SPDX-License-Identifier: MIT
"""Train a network on drawn samples with the loss of a teacher, by Adam.

The same seed gives the same bytes on CPUs of one kind: it fixes samples, and torch has one thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from densify.config.errors import ComputationError, InputError
from densify.flow.energy import on_one_thread
from densify.geometry.types import Progress
from densify.learning.clips import ClipMaker
from densify.learning.network import NUM_SWEEPS, Model, build, write_model
from densify.learning.samples import TEACHERS, on_device, samples

_LEARNING_RATE = 2e-3
_LARGEST_GRADIENT = 1.0
_WARM_UP, _COOL_DOWN = 0.05, 0.5  # shares of the training's steps
_NUM_AVERAGED = 50  # number of losses


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
    loss_of, device = TEACHERS[training.teacher], chosen_device(training.device)
    if training.steps < 1:
        raise InputError(f"--steps {training.steps}: expected 1 or more")
    network = build(training.seed)
    losses: list[float] = []
    network.to(device).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    maker = ClipMaker(training.data, training.seed, training.teacher)
    drawn = samples(maker, NUM_SWEEPS)
    with on_one_thread():
        while len(losses) < training.steps:
            sample = on_device(next(drawn), device)
            for group in optimizer.param_groups:
                group["lr"] = _learning_rate(len(losses) / training.steps)
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


def chosen_device(name: str) -> torch.device:
    """Return the torch device for "cpu", "cuda", or "auto" (CUDA if available)."""
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def _learning_rate(done: float) -> float:
    """Return the learning rate at a share of the training: a rise, a plateau, half a cosine."""
    rate = min(1.0, (done + 0.002) / _WARM_UP)
    if done > 1 - _COOL_DOWN:
        rate = 0.5 + 0.5 * np.cos(np.pi * (done - 1 + _COOL_DOWN) / _COOL_DOWN)
    return _LEARNING_RATE * max(float(rate), 0.01)
