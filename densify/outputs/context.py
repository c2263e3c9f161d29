# SPDX-License-Identifier: MIT
"""The facts that an output gets beside the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from densify.outputs.png import Picture


@dataclass(frozen=True)
class Context:
    """images: map -> (H,W,3) RGB of its image, some or none. config: the merged configuration as
    plain mappings, by section. data: the recording, as the user named it."""

    images: Mapping[str, Picture]
    config: Mapping[str, Any]
    data: str

    def image(self, camera: str, shape: tuple[int, ...]) -> Picture:
        """(H,W,3) the camera's image, black where there is none."""
        image = self.images.get(camera)
        return np.zeros((*shape, 3), np.uint8) if image is None else image
