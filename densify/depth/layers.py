# SPDX-License-Identifier: MIT
"""A depth map in the making: what the stages of `densify.depth.project` hand on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float32


@dataclass(frozen=True)
class Layers:
    """One camera's map with all that is known of its pixels; (H,W) everywhere, depths in m, 0 none.

    depth_m: accepted as measured. rim_m: measured so close to a depth discontinuity that the pixel
    may show what lies beyond; it stays when the pixel is accepted. veiled: this boundary pixel is
    measured behind the patch of a nearer point. filled_m: accepted and interpolated pixels.
    confidence: 0 to 1. point: row of the cloud that measured the pixel, -1 none. tilt: (H,W,2)
    slope of the surface's inverse depth to the right and down, 1/m per px. spacing_px: (H,W,2)
    between neighbouring rays of one sweep, across and down, everywhere. lab: (H,W,3) the image in
    L*a*b*, if there is one. warnings: what could not be done as asked. solid: closed car windows,
    and moving bodies. glass: where a measured pixel was taken out of a window. key_only: only the
    key sweep has returns of the surface.
    """

    depth_m: Float32
    rim_m: Float32
    veiled: Bool
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
        """(H,W) between neighbouring rays, whichever way."""
        return np.sqrt(self.spacing_px[..., 0] * self.spacing_px[..., 1])

    def part(self, box: tuple[slice, slice]) -> Layers:
        """Return the layers of a box of the image, as views: a change there changes these."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        images = {n: v[box] for n, v in values.items() if isinstance(v, np.ndarray)}
        return Layers(**values | images)

    def without(self, dropped: Bool) -> Layers:
        """Take out the pixels ``dropped`` (H,W) of the filled map; what was measured there becomes
        a boundary pixel that is not accepted."""
        dropped = dropped & (self.filled_m > 0)
        rim_m = np.where(dropped & (self.depth_m > 0), self.depth_m, self.rim_m)
        depth_m, filled_m, confidence = (
            np.where(dropped, np.float32(0), values)
            for values in (self.depth_m, self.filled_m, self.confidence)
        )
        return replace(self, rim_m=rim_m, depth_m=depth_m, filled_m=filled_m, confidence=confidence)
