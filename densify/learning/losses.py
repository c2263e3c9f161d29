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
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from densify.flow.objective.energy import energy
from densify.flow.objective.graph import knn_graph, laplacian
from densify.learning.clouds import Sweeps

if TYPE_CHECKING:
    from densify.learning.samples import Sample

Predict = Callable[[Sweeps], Tensor]
ALPHA, NUM_NEIGHBORS = 4.0, 50
FAST_M_S = 1.0


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the published objective of a sample's drawn points, m² per point."""
    source: Tensor = sample.sweeps[0].points[sample.drawn]  # type: ignore[union-attr]
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    flow = predict(sample.sweeps)[sample.drawn]
    found = energy(flow, source, sample.drawn_target, laplacian(graph), ALPHA)
    return found.total / len(source)


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the sum of the mean errors over static, slow and fast points of a sample with labels,
    metres."""
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
"""The loss of a network and a sample, a 0-d tensor."""
