# SPDX-License-Identifier: MIT
"""PointPWC-Net's self-supervised loss (Wu et al., ECCV 2020, section 5), at the finest level::

    C  = 1/n Σ_p min_q |p + f_p - q|² + 1/m Σ_q min_p |p + f_p - q|²       Chamfer, eq. 5
    S  = 1/n Σ_p 1/|N(p)| Σ_{j in N(p)} |f_j - f_p|²                       smoothness, eq. 6
    δ(x_p) = 1/|N(p)| Σ_{j in N(p)} (x_j - x_p)                            Laplacian coordinate
    L  = 1/n Σ_p |δ(p + f_p) - δ_Q(p + f_p)|²                              curvature, eq. 7 and 8
    loss = C + S + 0.3 L, in m²

N: 9 neighbours in the source for S and 10 for δ; δ_Q is that of the target, of the 5 nearest
target points by inverse squared distance. Those, and the weights, are of the authors' code.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from densify.flow.objective.energy import take
from densify.flow.objective.neighbors import NeighborIndex
from densify.geometry.types import Float

if TYPE_CHECKING:
    from densify.learning.losses import Predict
    from densify.learning.samples import Sample

CHAMFER, SMOOTHNESS, CURVATURE = 1.0, 1.0, 0.3
_SMOOTH_K, _CURVED_K, _CARRIED_K = 9, 10, 5
_ADAM_STEPS, _ADAM_RATE = 1500, 0.1


def pointpwc_loss(predict: Predict, sample: Sample) -> Tensor:
    """See the module."""
    source, target = sample.drawn_source.points, sample.drawn_target.points
    return pointpwc_energy(predict(sample.sweeps)[sample.drawn], source, target)


def pointpwc_energy(flow: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """The loss of a flow (n,3) of source (n,3) to target (m,3)."""
    moved, index = source + flow, NeighborIndex(target)
    own = NeighborIndex(source)
    forward = moved - target[index.nearest(moved).row[:, 0]]
    back = take(moved, NeighborIndex(moved).nearest(target).row[:, 0]) - target
    chamfer = (forward**2).sum() / len(source) + (back**2).sum() / len(target)

    near = _others(own, source, _SMOOTH_K)
    differences = take(flow, near.reshape(-1)).view(*near.shape, 3) - flow[:, None]
    smoothness = (differences**2).sum(dim=2).mean(dim=1).mean()

    beside = _others(own, source, _CURVED_K)
    curved = (take(moved, beside.reshape(-1)).view(*beside.shape, 3) - moved[:, None]).mean(dim=1)
    with torch.no_grad():
        beside_target = _others(index, target, _CURVED_K)
        of_target = (target[beside_target] - target[:, None]).mean(dim=1)
        carried = index.nearest(moved, min(_CARRIED_K, len(target))).row
    weight = 1 / (((moved[:, None] - target[carried]) ** 2).sum(dim=2) + 1e-8)
    weight = weight / weight.sum(dim=1, keepdim=True)
    expected = (weight[:, :, None] * of_target[carried]).sum(dim=1)
    curvature = ((curved - expected) ** 2).sum(dim=1).mean()
    return CHAMFER * chamfer + SMOOTHNESS * smoothness + CURVATURE * curvature


def without_learning(source: Float, target: Float) -> Float:
    """(n,3), (m,3) metres -> (n,3): the flow itself is what is optimised, by the published
    objective's protocol (Adam, 1,500 steps of 0.1 m), and the best of all steps is kept."""
    points, goal = (torch.from_numpy(x - source.mean(0)).float() for x in (source, target))
    flow = torch.zeros_like(points, requires_grad=True)
    optimizer = torch.optim.Adam([flow], lr=_ADAM_RATE)
    lowest, best = torch.inf, flow.detach().clone()
    for _ in range(_ADAM_STEPS):
        optimizer.zero_grad()
        loss = pointpwc_energy(flow, points, goal)
        if float(loss.detach()) < lowest:
            lowest, best = float(loss.detach()), flow.detach().clone()
        loss.backward()
        optimizer.step()
    found: Float = best.double().numpy()
    return found


def _others(index: NeighborIndex, points: Tensor, k: int) -> Tensor:
    """(n,k) rows of the nearest, the point itself among them, as in the authors' code."""
    return index.nearest(points, min(k, len(index))).row
