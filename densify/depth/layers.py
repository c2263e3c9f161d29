# SPDX-License-Identifier: MIT
"""Hold a depth map in the making, which the stages of `densify.depth.project` hand on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float32


@dataclass(frozen=True)
class Layers:
    """The map of one camera with all properties of its pixels; (H,W) each, depths in m, 0 none.

    Attributes:
        depth_m: Accepted as measured.
        rim_m: Boundary pixels: measured so close to a depth discontinuity that they may show
            the background. A pixel stays here when it is accepted.
        behind_patch: This boundary pixel is measured behind the patch of a nearer point.
        filled_m: Accepted and interpolated pixels.
        confidence: 0 to 1.
        point: Row of the cloud that measured the pixel, -1 none.
        tilt: (H,W,2) slope of the surface's inverse depth to the right and down, 1/m per px.
        spacing_px: (H,W,2) between neighbouring rays of one sweep, across and down, everywhere.
        lab: (H,W,3) the image in L*a*b*, None without one.
        warnings: What could not be done as asked.
        solid: Closed car windows, and moving bodies.
        glass: A measured pixel was removed from a car window.
        key_only: Only the key sweep has returns of the surface.
    """

    depth_m: Float32
    rim_m: Float32
    behind_patch: Bool
    filled_m: Float32
    confidence: Float32
    point: NDArray[np.int32]
    tilt: Float32
    spacing_px: Float32
    lab: Float32 | None = None
    warnings: tuple[str, ...] = ()
    solid: Bool | None = None
    glass: Bool | None = None
    key_only: Bool | None = None

    @property
    def gap_px(self) -> Float32:
        """The (H,W) distance between neighbouring rays, in the wider direction."""
        return np.sqrt(self.spacing_px[..., 0] * self.spacing_px[..., 1])

    def part(self, box: tuple[slice, slice]) -> Layers:
        """Return the layers of a box of the image, as views: a change there changes these."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        images = {n: v[box] for n, v in values.items() if isinstance(v, np.ndarray)}
        return Layers(**values | images)

    def without(self, dropped: Bool) -> Layers:
        """Remove the pixels ``dropped`` (H,W) from the filled map.

        Measured ones become boundary pixels that are not accepted.
        """
        dropped = dropped & (self.filled_m > 0)
        rim_m = np.where(dropped & (self.depth_m > 0), self.depth_m, self.rim_m)
        depth_m, filled_m, confidence = (
            np.where(dropped, np.float32(0), values)
            for values in (self.depth_m, self.filled_m, self.confidence)
        )
        return replace(self, rim_m=rim_m, depth_m=depth_m, filled_m=filled_m, confidence=confidence)
