# SPDX-License-Identifier: MIT
"""Hold a depth map in the making, which the stages of `densify.depth.project` pass on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float32


@dataclass(frozen=True)
class Layers:
    """One depth map in the making: images (H,W) with depths in metres, 0 for no depth."""

    depth_m: Float32  # depth of pixels that are accepted as measured
    # Depth of boundary pixels, measured so close to a depth discontinuity that they may show the
    # background. Accepted boundary pixels stay in this layer too.
    rim_m: Float32
    filled_m: Float32  # depth of accepted and of interpolated pixels
    point: NDArray[np.int32]  # index, in the cloud, of the point that measured the pixel; -1 none
    tilt: Float32  # (H,W,2) slope of the surface's inverse depth to the right and down, 1/m per px
    # (H,W,2) spacing of neighbouring rays of one sweep, across and down, at all pixels
    spacing_px: Float32
    # (H,W) share of the image's votes for the depth of a boundary pixel, a filled or a rejected
    # pixel; 1 without a vote
    votes: Float32
    edge: Float32  # (H,W) distance of measured pixels from a discontinuity, in radii of a spot
    rejected_m: Float32  # depth of pixels that rules rejected
    lab: Float32 | None = None  # (H,W,3) camera image in L*a*b*, None if there is no image
    solid: Bool | None = None  # true on bodies of moving objects (`MovingBody`)

    @property
    def gap_px(self) -> Float32:
        """The (H,W) spacing of neighbouring rays, geometric mean of both directions."""
        return np.sqrt(self.spacing_px[..., 0] * self.spacing_px[..., 1])

    def part(self, box: tuple[slice, slice]) -> Layers:
        """Return a box of rows and columns as views: writing to the box changes these layers."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        images = {n: v[box] for n, v in values.items() if isinstance(v, np.ndarray)}
        return Layers(**values | images)

    def without(self, dropped: Bool) -> Layers:
        """Return the layers with the pixels ``dropped`` (H,W) removed from the filled map.

        Measured pixels among them become boundary pixels that are not accepted.
        """
        dropped = dropped & (self.filled_m > 0)
        rim_m = np.where(dropped & (self.depth_m > 0), self.depth_m, self.rim_m)
        rejected_m = np.where(dropped, self.filled_m, self.rejected_m)
        depth_m, filled_m = (
            np.where(dropped, np.float32(0), values) for values in (self.depth_m, self.filled_m)
        )
        return replace(self, rim_m=rim_m, depth_m=depth_m, filled_m=filled_m, rejected_m=rejected_m)
