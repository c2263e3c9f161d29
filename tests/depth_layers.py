# SPDX-License-Identifier: MIT
"""Depth maps in the making, for the tests of their stages."""

from __future__ import annotations

import numpy as np

from densify.depth.boundary_pixels import lab
from densify.depth.layers import Layers
from densify.depth.measured_pixels import ALL_ROUND


def layers_of(
    filled_m,
    measured=None,
    rim_m=None,
    spacing_px=(3.0, 3.0),
    tilt=(0.0, 0.0),
    image=None,
):
    """As after a fill. measured: (H,W) bool, all that is filled if None."""
    filled_m = np.ascontiguousarray(filled_m, np.float32)
    shape, known = filled_m.shape, filled_m > 0
    depth_m = np.where(known if measured is None else known & measured, filled_m, 0)
    rim_m = np.zeros(shape) if rim_m is None else rim_m
    two = (*shape, 2)
    return Layers(
        depth_m=depth_m.astype(np.float32),
        rim_m=np.asarray(rim_m, np.float32),
        filled_m=filled_m,
        point=np.where(depth_m > 0, np.arange(known.size).reshape(shape), -1).astype(np.int32),
        tilt=np.broadcast_to(np.float32(tilt), two).copy(),
        spacing_px=np.broadcast_to(np.float32(spacing_px), two).copy(),
        votes=np.ones(shape, np.float32),
        edge=np.full(shape, np.float32(ALL_ROUND)),
        rejected_m=np.zeros(shape, np.float32),
        lab=None if image is None else lab(image),
    )
