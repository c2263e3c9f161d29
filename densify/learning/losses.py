# SPDX-License-Identifier: MIT
"""The losses that teach a network, by the name of the teacher.

``objective`` is the published objective as a loss (Pontes, Hays, Lucey, 3DV 2020, sections 3 and
4), in m² per point, with alpha = 4 (10 without learning) and a graph of 50 neighbours. It is the
same code as without learning and needs no labels::

    E(F) / n = ( Σ_p min_q |p + f_p - q|² + Σ_q min_p |p + f_p - q|² + α tr(Fᵀ L F) ) / n

``engine`` and ``truth`` compare with a known flow f*: that of this package's engine, or the truth.
Nearly all points are static, and a plain mean teaches a network to be static. As in DeFlow (Zhang
et al., ICRA 2024, eq. 5) the loss, in metres, is a sum over the sets b of static points, points
slower than 1 m/s, and faster points::

    loss = Σ_b 1/|b| Σ_{p in b} |f_p - f*_p|
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from densify.config.errors import InputError
from densify.flow.objective.energy import energy
from densify.flow.objective.graph import knn_graph, laplacian
from densify.learning.clouds import Sweeps

if TYPE_CHECKING:
    from densify.learning.samples import Sample

Predict = Callable[[Sweeps], Tensor]
ALPHA, NUM_NEIGHBORS = 4.0, 50
FAST_M_S = 1.0


class Teacher(NamedTuple):
    """loss: of a network and a sample, a 0-d tensor. labels: which the samples need, "" for none,
    else "engine" or "truth"."""

    loss: Callable[[Predict, Sample], Tensor]
    labels: str


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the published objective of a sample's drawn points, m² per point."""
    source = sample.drawn_source.points
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    flow = predict(sample.sweeps)[sample.drawn]
    return energy(flow, source, sample.drawn_target.points, laplacian(graph), ALPHA).total / len(
        source
    )


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the balanced error of a sample with labels, metres."""
    if sample.flow is None or sample.moving is None:
        raise ValueError("expected a sample with labels")
    flow = predict(sample.sweeps)
    fast = sample.flow.norm(dim=1) >= FAST_M_S * sample.duration_s
    return balanced_error(flow, sample.flow, sample.moving, fast, sample.in_reach)


def balanced_error(
    flow: Tensor, true: Tensor, moving: Tensor, fast: Tensor, counted: Tensor
) -> Tensor:
    """Return the sum of the mean errors over static, slow and fast points, metres.

    flow, true: (n,3). moving, fast, counted: (n,) bool; points that are not counted are left out.
    """
    # The gradient of the norm itself is not a number at 0.
    error_m = ((flow - true) ** 2).sum(dim=1).add(1e-8).sqrt()
    sets = (~moving, moving & ~fast, moving & fast)
    means = [error_m[counted & each].mean() for each in sets if bool((counted & each).any())]
    return torch.stack(means).sum() if means else (flow * 0).sum()


TEACHERS = {
    "objective": Teacher(objective_loss, ""),
    "engine": Teacher(supervised_loss, "engine"),
    "truth": Teacher(supervised_loss, "truth"),
}


def teacher(name: str) -> Teacher:
    """Return a teacher by name. Raises InputError for another name."""
    if name not in TEACHERS:
        raise InputError(f"--teacher {name}: expected one of {', '.join(TEACHERS)}")
    return TEACHERS[name]
