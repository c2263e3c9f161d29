# SPDX-License-Identifier: MIT
"""Nearest neighbours and anchored cycles ("Just Go with the Flow", Mittal et al., CVPR 2020)::

    p'  = p + f_p,  q(p') the target point nearest to p'
    NN  = 1/n Σ_p |p' - q(p')|²                                            eq. 3
    p̄   = ½ p' + ½ q(p')                                                   eq. 5, the anchor
    C   = 1/n Σ_p |p̄ + g(p̄) - p|²                                          eq. 6
    loss = NN + C, in m²

g is the same network's flow from the anchored points back to the source. Alone, the cycle is
content with no motion and the nearest neighbours with any that ends on some point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from densify.flow.objective.neighbors import NeighborIndex
from densify.learning.clouds import NetworkCloud

if TYPE_CHECKING:
    from densify.learning.losses import Predict
    from densify.learning.samples import Sample

ANCHOR = 0.5
"""Weight of the nearest neighbour in the anchor; 0 starts the way back where the network went."""


def cycle_loss(predict: Predict, sample: Sample) -> Tensor:
    """See the module. The network is asked twice."""
    source, target = sample.drawn_source, sample.drawn_target
    moved = source.points + predict(sample.sweeps)[sample.drawn]
    nearest = target.points[NeighborIndex(target.points).nearest(moved).row[:, 0]]
    anchored = (1 - ANCHOR) * moved + ANCHOR * nearest
    back = predict([NetworkCloud(anchored, source.height_m), source])
    nearest_m2 = ((moved - nearest) ** 2).sum(dim=1).mean()
    cycle_m2 = ((anchored + back - source.points) ** 2).sum(dim=1).mean()
    return nearest_m2 + cycle_m2
