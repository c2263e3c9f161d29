# SPDX-License-Identifier: MIT
"""Tell when a spinning scanner fired from the azimuths of its points."""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float


def share_of_turn(points: Float, middle_rad: float = 0.0, clockwise: bool = True) -> Float:
    """Return the (N,) shares of a turn, -0.5 to 0.5, from facing ``middle_rad`` to each firing.

    Args:
        points: (N,3) points relative to the scanner, as fired, with z along its spin axis.
        middle_rad: Azimuth that the scanner faces in the middle of a sweep, anticlockwise from x.
        clockwise: True if the scanner turns clockwise, seen from above.
    """
    azimuth_rad = np.arctan2(points[:, 1], points[:, 0])
    share = (middle_rad - azimuth_rad) / (2 * np.pi)
    share = share if clockwise else -share
    return np.asarray(share - np.rint(share), np.float64)
