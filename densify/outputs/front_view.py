# SPDX-License-Identifier: MIT
"""Find the depth map that pictures and pages of a run show first."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from densify.geometry.types import CameraView, Float

_LEAST_WAY_M = 1.0
"""A shorter way may be noise of the registration, of a vehicle at rest."""
_SIDE = re.compile(r"left|right|side|rear|back", re.IGNORECASE)


def front_first(
    names: Sequence[str],
    views: Mapping[str, CameraView],
    T_key_lidar: Mapping[int, Float],
) -> list[str]:
    """Return the names of maps, that of the camera which looks ahead first, the others as given.

    Ahead is where the vehicle goes in the window. At rest it is the camera called front.
    ``T_key_lidar`` has (4,4) lidar poses in the key frame by frame number. ``views`` may lack maps.
    """
    frames = sorted(T_key_lidar)
    way_m = np.zeros(3)
    if frames:
        way_m = T_key_lidar[frames[-1]][:3, 3] - T_key_lidar[frames[0]][:3, 3]
    if np.linalg.norm(way_m) >= _LEAST_WAY_M:
        # Row z of a camera's rotation is its optical axis in the key frame.
        ahead = [float(views[n].T_cam_key[2, :3] @ way_m) if n in views else -np.inf for n in names]
    else:
        ahead = [float("front" in n.lower()) - 0.5 * bool(_SIDE.search(n)) for n in names]
    first = int(np.argmax(ahead)) if len(names) else 0
    return [*names[first : first + 1], *names[:first], *names[first + 1 :]]
