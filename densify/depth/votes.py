# SPDX-License-Identifier: MIT
"""Votes of the pixels whose depth is known for the depth that another pixel is thought to have.

Every known pixel that is seen first in one of 16 directions votes, for it as far as its surface
goes on to there, and against it otherwise (`densify.kernels.voting.vote`): the less the more the
image's colour changes on the way. The idea is that of a bilateral grid or a geodesic matting:
without an edge of the image between them, two pixels show the same surface.
"""

from __future__ import annotations

import numpy as np

from densify.depth.layers import Layers
from densify.kernels import voting
from densify.kernels.marching import DIRECTIONS, first_known
from densify.types import Float32, Int

RULES = voting.Rules(
    reach=6.0,
    decay=1.2,
    same_m=0.2,
    same_fraction=0.05,
    colours=6.0,
    through=0.001,
    doubt=0.04,
    aside=0.6,
)


def voters(layers: Layers, known_m: Float32) -> voting.Seeds:
    """The pixels of ``known_m`` (H,W), 0 none, each with a whole vote."""
    inverse = np.divide(1, known_m, out=np.zeros_like(known_m), where=known_m > 0)
    steps = first_known(known_m > 0)
    return voting.Seeds(steps, DIRECTIONS, inverse, layers.tilt, np.ones_like(inverse))


def shares(
    layers: Layers, seeds: voting.Seeds, pixel: Int, depth_m: Float32, rules: voting.Rules
) -> Float32:
    """(P,) share of the votes for ``depth_m`` (P,) of the pixels ``pixel`` (P,). Without an image
    that fits the seeds tell by distance alone."""
    lab = layers.lab
    if lab is None:
        lab = np.zeros((*layers.depth_m.shape, 3), np.float32)
    share = np.ones(len(pixel), np.float32)
    voting.vote.over_rows(len(pixel), pixel, 1 / depth_m, seeds, lab, layers.gap_px, rules, share)
    return share
