# SPDX-License-Identifier: MIT
"""The published objective as a loss (Pontes, Hays, Lucey, 3DV 2020, sections 3 and 4)::

    E(F) / n = ( Σ_p min_q |p + f_p - q|² + Σ_q min_p |p + f_p - q|² + α tr(Fᵀ L F) ) / n

with α = 4 (10 without learning) and the symmetric normalised Laplacian L of the graph of 50
neighbours. The same code as without learning, `densify.flow.objective.energy`. In m².
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from densify.flow.objective.energy import energy
from densify.flow.objective.graph import knn_graph, laplacian, sparse_tensor

if TYPE_CHECKING:
    from densify.learning.losses import Predict
    from densify.learning.samples import Sample

ALPHA = 4.0
NUM_NEIGHBORS = 50


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Mean energy of a drawn point."""
    source = sample.drawn_source.points
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    smooth = sparse_tensor(laplacian(graph), source.dtype, source.device)
    flow = predict(sample.sweeps)[sample.drawn]
    return energy(flow, source, sample.drawn_target.points, smooth, ALPHA).total / len(source)
