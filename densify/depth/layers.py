# SPDX-License-Identifier: MIT
"""A depth map while it is being made: what the stages of `densify.depth.project` pass on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float32


@dataclass(frozen=True)
class Layers:
    """One camera's map with all that is known of its pixels; (H,W) everywhere.

    depth_m: float32, accepted as measured, 0 none. rim_m: float32, measured so near to a depth edge
    that the pixel may show what lies beyond, 0 where not; it stays when the pixel is accepted.
    veiled: (H,W) such a pixel is measured behind the patch of a nearer point, and not at all else.
    refused: (H,W) such a pixel is never accepted: on a mover, where the key sweep saw past it, or
    behind the patch of one, seen at another time.
    filled_m: float32, the accepted ones plus interpolated ones. confidence: float32 0 to 1, of
    every pixel in any of the three. point: int32 row of the cloud that measured the pixel, -1 none.
    tilt: (H,W,2) float32 slope of the measured surface's inverse depth to the right and down, 1/m
    per px. spacing_px: (H,W,2) float32 between neighbouring rays of one sweep, across and along
    elevation, everywhere. lab: (H,W,3) float32 the image as `densify.depth.picture` makes it, None
    without one. warnings: what could not be done as asked. window: (H,W) True inside the windows of
    vehicles, and glass: where a measured pixel was taken out of one; None before they are closed.
    alone: (H,W) measured by the key sweep alone, where others should have met the surface; moving:
    of what moves; unsure: an accepted rim that the image gives too few votes to count as measured;
    None for nowhere.
    """

    depth_m: Float32
    rim_m: Float32
    veiled: Bool
    refused: Bool
    filled_m: Float32
    confidence: Float32
    point: NDArray[np.int32]
    tilt: Float32
    spacing_px: Float32
    lab: Float32 | None = None
    warnings: tuple[str, ...] = ()
    window: Bool | None = None
    glass: Bool | None = None
    alone: Bool | None = None
    moving: Bool | None = None
    unsure: Bool | None = None

    @property
    def gap_px(self) -> Float32:
        """(H,W) between neighbouring rays, whichever way."""
        return np.sqrt(self.spacing_px[..., 0] * self.spacing_px[..., 1])

    @property
    def strict(self) -> Bool:
        """(H,W) measured, and no depth edge near."""
        return (self.depth_m > 0) & (self.rim_m == 0)

    def without(self, dropped: Bool) -> Layers:
        """Take out the pixels ``dropped`` (H,W) of the filled map; what was measured there becomes
        a rim that is not accepted."""
        dropped = dropped & (self.filled_m > 0)
        rim_m = np.where(dropped & (self.depth_m > 0), self.depth_m, self.rim_m)
        depth_m, filled_m, confidence = (
            np.where(dropped, np.float32(0), values)
            for values in (self.depth_m, self.filled_m, self.confidence)
        )
        return replace(self, rim_m=rim_m, depth_m=depth_m, filled_m=filled_m, confidence=confidence)
