# SPDX-License-Identifier: MIT
"""A camera's image as depth maps look at it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.types import Float32

_BLUR_PX = 0.6  # standard deviation; noise and the colour filter's pattern


def lab(image: NDArray[np.uint8]) -> Float32:
    """(H,W,3) RGB -> (H,W,3) float32 CIE L*a*b*, L from 0 to 100, slightly blurred: distances tell
    about how different two colours look."""
    blurred = cv2.GaussianBlur(image.astype(np.float32) / 255, (0, 0), _BLUR_PX)
    return cv2.cvtColor(blurred, cv2.COLOR_RGB2LAB).astype(np.float32, copy=False)
