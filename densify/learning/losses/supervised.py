# SPDX-License-Identifier: MIT
"""Known flow f* as a loss: of the truth, or of this package's engine, which is a label without
labels. Where nearly everything stands, a plain mean teaches to stand still; so, as DeFlow does
(Zhang et al., ICRA 2024, eq. 5), ::

    loss = Σ_b 1/|b| Σ_{p in b} |f_p - f*_p|,  in m

over the sets b of points that stand, that move by less than 1 m/s, and by more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from densify.learning.losses import Predict
    from densify.learning.samples import Sample

FAST_M_S = 1.0


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """See the module."""
    if sample.flow is None or sample.moving is None:
        raise ValueError("expected a sample with labels")
    flow = predict(sample.sweeps)
    fast = sample.flow.norm(dim=1) >= FAST_M_S * sample.duration_s
    return weighted_error(flow, sample.flow, sample.moving, fast, sample.in_reach)


def weighted_error(
    flow: Tensor, true: Tensor, moving: Tensor, fast: Tensor, counted: Tensor
) -> Tensor:
    """flow, true: (n,3). moving, fast, counted: (n,) bool; only what is counted counts."""
    # Not the norm itself: its gradient at 0 is not a number.
    error_m = ((flow - true) ** 2).sum(dim=1).add(1e-8).sqrt()
    sets = (~moving, moving & ~fast, moving & fast)
    means = [error_m[counted & each].mean() for each in sets if bool((counted & each).any())]
    return torch.stack(means).sum() if means else (flow * 0).sum()
