# SPDX-License-Identifier: MIT
"""Which of the pixels that are measured close to a depth edge are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import ProjectSettings
from densify.depth.layers import Layers


def decide(layers: Layers, settings: ProjectSettings) -> Layers:
    """Accept rims as ``project.rims`` says; ``strict`` accepts none, ``keep`` all."""
    if settings.rims != "keep":
        return layers
    depth_m = np.where(layers.rim_m > 0, layers.rim_m, layers.depth_m)
    return replace(layers, depth_m=depth_m, filled_m=depth_m)
