# SPDX-License-Identifier: MIT
"""The teachers by name: each turns a network's flow of one sample into a loss.

A loss is a function of ``predict``, the network, and a `densify.learning.samples.Sample`; it gives
a 0-d tensor in the unit that its module says. Self-supervised losses look at the drawn points of
the sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from densify.config.errors import InputError
from densify.learning.clouds import Sweeps
from densify.learning.losses.cycle import cycle_loss
from densify.learning.losses.objective import objective_loss
from densify.learning.losses.pointpwc import pointpwc_loss
from densify.learning.losses.supervised import supervised_loss

if TYPE_CHECKING:
    from densify.learning.samples import Sample

Predict = Callable[[Sweeps], Tensor]
Loss = Callable[[Predict, "Sample"], Tensor]


@dataclass(frozen=True)
class Teacher:
    """labels: of the samples, "" for none, else what makes them: engine or truth."""

    loss: Loss
    about: str
    labels: str = ""


TEACHERS = {
    "objective": Teacher(objective_loss, "the published objective; needs no labels"),
    "pointpwc": Teacher(pointpwc_loss, "PointPWC-Net's self-supervised loss; needs no labels"),
    "cycle": Teacher(cycle_loss, "nearest neighbours and anchored cycles; needs no labels"),
    "engine": Teacher(supervised_loss, "this package's engine; needs no labels", "engine"),
    "truth": Teacher(supervised_loss, "the truth, where the recording has one", "truth"),
}


def teacher(name: str) -> Teacher:
    """Raises InputError for another name."""
    if name not in TEACHERS:
        raise InputError(f"--teacher {name}: expected one of {', '.join(TEACHERS)}")
    return TEACHERS[name]
