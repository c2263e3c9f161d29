# SPDX-License-Identifier: MIT
"""The training loop: samples, a teacher's loss, Adam, and checkpoints to resume from.

The same seed gives the same weights, byte for byte, on CPUs of one kind, resumed or not. Every
sample follows from the seed and its number, and torch computes on one thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from densify.config.errors import ComputationError, InputError
from densify.flow.objective.energy import on_one_thread
from densify.geometry.types import Progress
from densify.learning.clips import ClipMaker
from densify.learning.losses import TEACHERS
from densify.learning.model_file import Model, read_model, write_model
from densify.learning.network import NUM_SWEEPS, Voxels, build
from densify.learning.samples import on_device, samples
from densify.outputs.plots import draw_losses, write_plot

_LEARNING_RATE = 2e-3
_LARGEST_GRADIENT = 1.0
_WARM_UP, _COOL_DOWN = 0.05, 0.5  # shares of the training
_NUM_AVERAGED = 50  # losses


@dataclass(frozen=True)
class Training:
    """The settings of a training.

    data: specifications of recordings. steps: pairs of sweeps to train on. checkpoint_steps: steps
    between two checkpoints.
    """

    data: tuple[str, ...]
    steps: int
    teacher: str = "objective"
    seed: int = 0
    device: str = "auto"
    checkpoint_steps: int = 50

    def identity(self) -> dict[str, Any]:
        """Return what must be the same when a training is resumed."""
        told = {"data": list(self.data), "teacher": self.teacher}
        return {**told, "seed": self.seed, "steps": self.steps}


class Trained(NamedTuple):
    """files: the model and the picture of its loss. loss: mean of the last 50 steps."""

    files: list[Path]
    loss: float


_State = tuple[Voxels, list[float], dict[int, dict[str, torch.Tensor]] | None]
"""A network, the loss of each step so far, and Adam's state, None before the first."""


def train(
    training: Training, out: Path, resume: bool = False, progress: Progress | None = None
) -> Trained:
    """Train a network and write the model, and beside it a picture of its loss (``.png``).

    During the training there is a checkpoint ``OUT.checkpoint``. resume: continue from it.
    Raises InputError for settings or recordings that cannot be used, ComputationError if the loss
    is not a number.
    """
    loss_of, device = TEACHERS[training.teacher], chosen_device(training.device)
    if training.steps < 1:
        raise InputError(f"--steps {training.steps}: expected 1 or more")
    checkpoint = out.with_name(out.name + ".checkpoint")
    begun: _State = (build(training.seed), [], None)
    network, losses, moments = _resumed(training, checkpoint) if resume else begun
    network.to(device).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    if moments is not None:
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})
    maker = ClipMaker(training.data, training.seed, training.teacher)
    drawn = samples(maker, NUM_SWEEPS, len(losses))
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
            if len(losses) % training.checkpoint_steps == 0:
                write_model(checkpoint, _checkpoint(training, network, losses, optimizer))
    write_model(out, Model(network, training.identity()))
    picture = out.with_name(out.name + ".png")
    title = f"teacher {training.teacher}, {', '.join(training.data)}"
    write_plot(picture, draw_losses(np.array(losses), title))
    checkpoint.unlink(missing_ok=True)
    return Trained([out, picture], float(np.mean(losses[-_NUM_AVERAGED:])))


def chosen_device(name: str) -> torch.device:
    """Return the device to train on; auto: CUDA if there is one.

    Raises InputError for CUDA where there is none.
    """
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def _learning_rate(done: float) -> float:
    """Return the rate at a share of the training: it rises, stays, and falls as half a cosine."""
    rate = min(1.0, (done + 0.002) / _WARM_UP)
    if done > 1 - _COOL_DOWN:
        rate = 0.5 + 0.5 * np.cos(np.pi * (done - 1 + _COOL_DOWN) / _COOL_DOWN)
    return _LEARNING_RATE * max(float(rate), 0.01)


def _checkpoint(
    training: Training, network: Voxels, losses: list[float], optimizer: torch.optim.Adam
) -> Model:
    """Return the model with all that is needed to resume: the losses, and Adam's state, arrays
    ``PARAMETER.NAME``."""
    beside: dict[str, NDArray[Any]] = {"losses": np.array(losses)}
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            beside[f"{index}.{name}"] = value.detach().cpu().numpy()
    return Model(network, training.identity(), beside)


def _resumed(training: Training, checkpoint: Path) -> _State:
    if not checkpoint.is_file():
        raise InputError(f"--resume: no {checkpoint}; leave --resume out to begin")
    model = read_model(checkpoint)
    for key, value in training.identity().items():
        if model.made.get(key) != value:
            raise InputError(
                f"--resume: {checkpoint} was begun with {key} {model.made.get(key)}, got {value}; "
                f"resume with the same, or begin without --resume"
            )
    state: dict[int, dict[str, torch.Tensor]] = {}
    try:
        losses = model.beside["losses"].tolist()
        for name in model.beside.keys() - {"losses"}:
            index, _, moment = name.partition(".")
            state.setdefault(int(index), {})[moment] = torch.from_numpy(model.beside[name])
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{checkpoint}: no checkpoint, or damaged; begin anew") from error
    return model.network, losses, state
