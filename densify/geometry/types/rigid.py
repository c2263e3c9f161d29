# SPDX-License-Identifier: MIT
"""What the types themselves have to know of poses; the rest is `densify.geometry.poses`."""

from __future__ import annotations

import numpy as np

from densify.geometry.arrays import Float


def inverse(T_a_b: Float) -> Float:
    """(4,4) -> (4,4) ``T_b_a``."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a
