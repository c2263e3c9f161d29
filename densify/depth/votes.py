# SPDX-License-Identifier: MIT
"""Votes of the pixels whose depth is known for the depth that another pixel is thought to have.

Every known pixel that is seen first in one of 16 directions votes, for it as far as its surface
goes on to there, and against it otherwise (`densify.depth.voting`): the less the more the
image's colour changes on the way. The idea is that of a bilateral grid or a geodesic matting:
without an edge of the image between them, two pixels show the same surface.
"""

from __future__ import annotations

import numpy as np

from densify.depth import voting
from densify.depth.layers import Layers
from densify.depth.marching import DIRECTIONS, first_known
from densify.geometry.types import Bool, Float32, Int

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
    """The pixels of ``known_m`` (H,W), 0 none."""
    inverse = np.divide(1, known_m, out=np.zeros_like(known_m), where=known_m > 0)
    return voting.Seeds(first_known(known_m > 0), DIRECTIONS, inverse, layers.tilt)


class Canvass:
    """Who votes for the depths of pixels, so that votes can be counted again once they weigh
    less."""

    def __init__(self, layers: Layers, seeds: voting.Seeds, pixel: Int, depth_m: Float32) -> None:
        """depth_m: (P,) of the pixels ``pixel`` (P,)."""
        num, sides = len(pixel), (len(pixel), len(DIRECTIONS))
        self._seed, self._agrees = np.zeros(sides, np.int32), np.zeros(sides, bool)
        self._tie = np.zeros((num, voting.NUM_PLACES, len(DIRECTIONS)), np.float32)
        voting.canvass.over_rows(
            num,
            pixel,
            1 / depth_m,
            seeds,
            _image(layers),
            layers.gap_px,
            RULES,
            self._seed,
            self._agrees,
            self._tie,
        )

    def shares(self, weight: Float32) -> Float32:
        """(P,) share of the votes for each pixel. weight: (H,W) of each seed's vote."""
        share = np.ones(len(self._seed), np.float32)
        voting.count.over_rows(
            len(share), self._seed, self._agrees, self._tie, weight.ravel(), RULES.doubt, share
        )
        return share


def elected(
    layers: Layers, seeds: voting.Seeds, pixel: Int, depth_m: Float32, share: float
) -> Bool:
    """(P,) whether ``share`` of the votes, or more, is for ``depth_m`` (P,) of the pixels ``pixel``
    (P,), without doubt and with the image in its place."""
    found = np.zeros(len(pixel), bool)
    voting.elect.over_rows(
        len(pixel),
        pixel,
        1 / depth_m,
        seeds,
        _image(layers),
        layers.gap_px,
        RULES,
        share,
        found,
    )
    return found


def _image(layers: Layers) -> Float32:
    """The image; where none fits, an empty one: seeds then tell by distance alone."""
    return np.zeros((0, 0, 3), np.float32) if layers.lab is None else layers.lab
