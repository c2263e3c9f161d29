# SPDX-License-Identifier: MIT
"""Which of the pixels that are measured close to a depth edge are kept: those of which the image
says that they lie on the surface that was measured, not on what is behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import ProjectSettings
from densify.depth.layers import Layers
from densify.depth.picture import laid_over
from densify.depth.votes import Canvass, voters
from densify.geometry.types import Float32, Int

MOST_CONFIDENCE = 0.2
"""A rim has no more, what is no rim no less."""
_NUM_ROUNDS = 2
_RIM_WEIGHT = 0.5  # of a rim's own vote, at most
_LEAST_SHARE = 0.97  # of the votes for a pixel that is kept
# Of what moves most rims of fewer votes are right too, since what the key sweep saw past is refused
# anyway; not as many as of what is measured elsewhere.
_LEAST_OF_MOVERS = 0.7
_FEW = 100  # rims, of which nothing can be told
_SUREST = 2.5  # -log10 of the share against
_MISFIT = (
    "image edges do not lie where depth has edges (calibration, clock, blur?): pixels at depth "
    "edges are left out as with project.rims=strict"
)
_MOVED = (
    "image edges lie {laid} of where depth has edges: the image is moved for "
    "project.rims; are calibration and clock right?"
)


def decide(layers: Layers, settings: ProjectSettings) -> Layers:
    """Accept rims as ``project.rims`` says: ``image`` those that the image puts on the measured
    surface, ``keep`` all that are not veiled too, ``strict`` none. Veiled ones are what is measured
    right beside a nearer surface, whose patches are larger than itself.

    Known pixels vote for or against them (`densify.depth.votes`); rims vote too, by half, in a
    second round less the less they are believed. Kept is what has 97 % of the votes, of
    what moves 70 %, but nothing that is ``refused``. What has less than 97 % is ``unsure``.

    An image that lies up to 3 steps aside is moved, with a warning that says how far. To one that
    does not belong to the depth or is blurred (`densify.depth.picture.laid_over`) nobody listens:
    as ``strict``, with a warning; without an image as ``strict``. ``lab`` goes on only if it was
    listened to.

    The ``confidence`` of rims becomes 0 to 0.2, by the share of the votes against.
    """
    rims = np.flatnonzero(layers.rim_m)
    share, lab, warnings = np.full(len(rims), np.float32(0.5)), None, layers.warnings
    if layers.lab is not None and settings.rims != "strict" and len(rims) >= _FEW:
        laid = laid_over(layers)
        if laid is None:
            warnings = (*warnings, _MISFIT)
        else:
            lab = laid.lab
            share = shares(replace(layers, lab=lab), rims)
            if laid.right_px or laid.down_px:
                warnings = (*warnings, _MOVED.format(laid=laid))
    believed = share >= _LEAST_SHARE
    if layers.moving is not None:
        believed |= layers.moving.flat[rims] & (share >= _LEAST_OF_MOVERS)
    if settings.rims == "strict":
        believed[:] = False
    elif settings.rims == "keep":
        believed |= ~layers.veiled.flat[rims]
    believed &= ~layers.refused.flat[rims]
    kept = rims[believed]
    unsure = np.zeros(layers.rim_m.shape, bool)
    if settings.rims == "image":
        unsure.flat[kept] = share[believed] < _LEAST_SHARE
    depth_m = layers.depth_m.copy()
    depth_m.flat[kept] = layers.rim_m.flat[kept]
    confidence = layers.confidence.copy()
    sure = np.clip(-np.log10(np.maximum(1 - share, 1e-9)) / _SUREST, 0, 1)
    confidence.flat[rims] = sure * np.float32(MOST_CONFIDENCE)
    confidence = np.where(depth_m > 0, confidence, np.float32(0))
    return replace(
        layers,
        depth_m=depth_m,
        filled_m=depth_m,
        confidence=confidence,
        lab=lab,
        warnings=warnings,
        unsure=unsure,
    )


def shares(layers: Layers, rims: Int) -> Float32:
    """(R,) share of the votes for each of the pixels ``rims`` (R,)."""
    seeds = voters(layers, np.maximum(layers.depth_m, layers.rim_m))
    canvass = Canvass(layers, seeds, rims, layers.rim_m.flat[rims])
    share, weight = np.ones(len(rims), np.float32), np.ones_like(layers.depth_m)
    for _ in range(_NUM_ROUNDS):
        weight.flat[rims] = _RIM_WEIGHT * share**2
        share = canvass.shares(weight)
    return share
