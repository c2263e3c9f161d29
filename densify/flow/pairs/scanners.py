# SPDX-License-Identifier: MIT
"""Which of two scanners measured a point, told by when it was measured where."""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float, Int

_NEAR_M = 3.0  # of the middle, where the direction is not that from a scanner
_MIN_AGREEMENT, _MAX_SINGLE = 0.8, 0.3


def scanners_told(clouds: tuple[Float, Float], lag: tuple[Float, Float]) -> tuple[Int, Int] | None:
    """(N,) and (M,) 0 or 1, of two scanners that spin half a turn apart about the vertical near the
    clouds' origin; None where the times do not tell of such.

    lag: of the points, in times between the clouds, which is a whole number of turns.

    Time plus or minus azimuth is one number for all points of a spinning scanner, its phase. Where
    the phases of two are half a turn apart, those doubled agree and the phases themselves do not.
    """
    both = np.concatenate(clouds)
    far = np.hypot(both[:, 0], both[:, 1]) > _NEAR_M
    share = max(float(np.ptp(late)) for late in lag)  # of a sweep in the time between the clouds
    if not far.any() or share <= 0:
        return None
    turned = np.concatenate(lag) * (2 * np.pi * max(1, round(1 / share)))
    azimuth = np.arctan2(both[:, 1], both[:, 0])
    for phase in (turned + azimuth, turned - azimuth):
        doubled = np.exp(2j * phase[far]).mean()
        if abs(doubled) < _MIN_AGREEMENT or abs(np.exp(1j * phase[far]).mean()) > _MAX_SINGLE:
            continue
        lidar = (np.cos(phase - np.angle(doubled) / 2) < 0).astype(np.int64)
        return lidar[: len(clouds[0])], lidar[len(clouds[0]) :]
    return None
