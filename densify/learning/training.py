# SPDX-License-Identifier: MIT
"""The loop: samples, a teacher's loss, Adam; a checkpoint now and then, from which to go on.

The same seed gives the same weights, byte for byte, on CPUs of one kind, stopped and resumed or
not: every sample follows from the seed and its number, and torch computes on one
thread. CUDA adds in any order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from densify.config.errors import ComputationError, InputError
from densify.learning.clips import ClipMaker
from densify.learning.losses import teacher
from densify.learning.model_file import Model, read_model, write_model
from densify.learning.networks import build
from densify.learning.samples import samples
from densify.learning.threads import on_one_thread
from densify.outputs.loss_curve import draw_losses
from densify.outputs.png import write_picture

_LEARNING_RATE = 2e-3
_LARGEST_GRADIENT = 1.0
_WARM_UP, _COOL_DOWN = 0.05, 0.5  # shares of the training
_CHECKPOINT_S = 60.0
_LAST = 50
_OPTIMIZER = "optimizer/"

Report = Callable[[int, float, float], None]
"""Called with the number of steps done, the share of the training done, and the last loss."""


@dataclass(frozen=True)
class Training:
    """What is trained on what. steps, minutes: one of them, the other None. start: weights to begin
    with, those of the seed if None. num_workers: processes that make samples. checkpoint_steps: a
    checkpoint after so many, besides one a minute; 0 for none."""

    data: tuple[str, ...]
    teacher: str = "objective"
    model: str = "voxels"
    seed: int = 0
    steps: int | None = None
    minutes: float | None = None
    device: str = "auto"
    start: Path | None = None
    keep: Path | None = None
    num_workers: int = 1
    checkpoint_steps: int = 0

    def identity(self) -> dict[str, Any]:
        """What must be the same to go on."""
        told = asdict(self)
        told["data"] = list(self.data)
        told["start"] = None if self.start is None else str(self.start)
        return {k: told[k] for k in ("data", "teacher", "model", "seed", "start")}


class Trained(NamedTuple):
    """files: the model and the picture. loss: mean of the last steps, at most 50."""

    files: list[Path]
    num_steps: int
    loss: float


@dataclass
class _State:
    """How far it is. losses: one a step."""

    network: nn.Module
    optimizer: torch.optim.Adam
    losses: list[float]
    seconds: float = 0.0


def train(
    training: Training, out: Path, resume: bool = False, report: Report | None = None
) -> Trained:
    """Train, and write the model, and beside it a picture of its loss (``.png``).

    While it lasts there is a checkpoint ``OUT.checkpoint``; resume: go on from it. Raises
    InputError for what cannot be trained on or resumed, ComputationError if the loss is no number.
    """
    if (training.steps is None) == (training.minutes is None):
        raise InputError("--steps, --minutes: expected one of them")
    taught = teacher(training.teacher)
    device = chosen_device(training.device)
    checkpoint = out.with_name(out.name + ".checkpoint")
    state = _resumed(training, checkpoint) if resume else _begun(training)
    state.network.to(device).train()
    maker = ClipMaker(training.data, training.seed, taught.labels, training.keep)
    num_sweeps = int(state.network.num_sweeps)  # type: ignore[arg-type]
    drawn = samples(maker, num_sweeps, training.num_workers, len(state.losses))
    begun_s, kept_s, before_s = time.monotonic(), time.monotonic(), state.seconds
    done = _share_done(training, state)
    try:
        with on_one_thread():
            while done < 1.0:
                sample = next(drawn).to(device)
                _set_rate(state.optimizer, done)
                state.optimizer.zero_grad()
                loss = taught.loss(state.network, sample)
                value = float(loss.detach())
                if not np.isfinite(value):
                    raise ComputationError(
                        f"the loss of step {len(state.losses)} is {value}; try another --seed"
                    )
                loss.backward()
                nn.utils.clip_grad_norm_(state.network.parameters(), _LARGEST_GRADIENT)
                state.optimizer.step()
                state.losses.append(value)
                now_s = time.monotonic()
                state.seconds = before_s + now_s - begun_s
                done = _share_done(training, state)
                if report is not None:
                    report(len(state.losses), done, value)
                every = training.checkpoint_steps
                if now_s > kept_s + _CHECKPOINT_S or (every and len(state.losses) % every == 0):
                    write_model(checkpoint, _kept(training, state))
                    kept_s = now_s
    finally:
        drawn.close()
    made = {**training.identity(), "steps": len(state.losses)}
    write_model(out, Model(training.model, state.network, made))
    picture = out.with_name(out.name + ".png")
    title = f"{training.model}, teacher {training.teacher}, {', '.join(training.data)}"
    write_picture(picture, draw_losses(np.array(state.losses), title))
    checkpoint.unlink(missing_ok=True)
    return Trained([out, picture], len(state.losses), float(np.mean(state.losses[-_LAST:])))


def chosen_device(name: str) -> torch.device:
    """auto: CUDA where there is one. Raises InputError for another name, or CUDA that is absent."""
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {name}: expected auto, cpu or cuda")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise InputError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if there and name != "cpu" else "cpu")


def _begun(training: Training) -> _State:
    network = build(training.model, training.seed)
    if training.start is not None:
        found = read_model(training.start)
        if found.name != training.model:
            raise InputError(
                f"--start {training.start}: a network {found.name}, expected {training.model}; "
                f"give --model {found.name}"
            )
        network = found.network
    return _State(network, _optimizer(network), [])


def _optimizer(network: nn.Module) -> torch.optim.Adam:
    return torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)


def _share_done(training: Training, state: _State) -> float:
    if training.steps is not None:
        return len(state.losses) / training.steps
    return state.seconds / (60 * (training.minutes or 1.0))


def _set_rate(optimizer: torch.optim.Adam, done: float) -> None:
    """Rises, stays, and falls along half a cosine."""
    rate = min(1.0, (done + 0.002) / _WARM_UP)
    if done > 1 - _COOL_DOWN:
        rate = 0.5 + 0.5 * np.cos(np.pi * (done - 1 + _COOL_DOWN) / _COOL_DOWN)
    for group in optimizer.param_groups:
        group["lr"] = _LEARNING_RATE * max(float(rate), 0.01)


def _kept(training: Training, state: _State) -> Model:
    """A checkpoint: the model, and all that is needed to go on."""
    beside: dict[str, NDArray[Any]] = {
        "losses": np.array(state.losses),
        "seconds": np.array(state.seconds),
    }
    for index, moments in state.optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            beside[f"{_OPTIMIZER}{index}.{name}"] = value.detach().cpu().numpy()
    return Model(training.model, state.network, training.identity(), beside)


def _resumed(training: Training, checkpoint: Path) -> _State:
    if not checkpoint.is_file():
        raise InputError(f"--resume: no {checkpoint}; leave --resume out to begin")
    model = read_model(checkpoint)
    for key, value in training.identity().items():
        if model.made.get(key) != value:
            raise InputError(
                f"--resume: {checkpoint} was begun with {key} {model.made.get(key)}, got {value}; "
                f"go on with the same, or begin without --resume"
            )
    optimizer = _optimizer(model.network)
    try:
        losses, seconds = model.beside["losses"].tolist(), float(model.beside["seconds"])
        whole = optimizer.state_dict()
        whole["state"] = _moments(model.beside)
        optimizer.load_state_dict(whole)
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{checkpoint}: no checkpoint, or damaged; begin anew") from error
    return _State(model.network, optimizer, losses, seconds)


def _moments(beside: Mapping[str, NDArray[Any]]) -> dict[int, dict[str, torch.Tensor]]:
    found: dict[int, dict[str, torch.Tensor]] = {}
    for name, array in beside.items():
        if name.startswith(_OPTIMIZER):
            index, _, moment = name.removeprefix(_OPTIMIZER).partition(".")
            found.setdefault(int(index), {})[moment] = torch.from_numpy(array)
    return found
