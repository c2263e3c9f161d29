# SPDX-License-Identifier: MIT
"""The scanner's own motion within a sweep, undone point by point, compiled: see
`densify.registration.deskew`."""

from __future__ import annotations

import numpy as np

from densify.geometry.compiled import Kernel

_SMALL_RAD = 1e-3  # below it the sine's series is exact


@Kernel
def move(begin, end, points, offset_s, twists, moved):  # type: ignore[no-untyped-def]
    """moved: (N,3), filled with ``exp(offset · twist) @ point``; sums are in the order of SciPy's
    Rotation, for the same bits.

    points: (N,3). offset_s: (N,). twists: (2,6) for offsets below 0 and the others. All float64.
    """
    for i in range(begin, end):
        time_s = offset_s[i]
        which = 0 if time_s < 0 else 1
        twist = twists[which]
        rx, ry, rz = time_s * twist[0], time_s * twist[1], time_s * twist[2]
        angle = np.sqrt(rx * rx + ry * ry + rz * rz)
        if angle <= _SMALL_RAD:
            square = angle * angle
            scale = 0.5 - square / 48 + square * square / 3840
        else:
            scale = np.sin(angle / 2) / angle
        x, y, z, w = scale * rx, scale * ry, scale * rz, np.cos(angle / 2)
        xx, yy, zz, ww = x * x, y * y, z * z, w * w
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        ahead = (xx - yy - zz + ww) * a + 2 * (x * z + y * w) * c + 2 * (x * y - z * w) * b
        left = 2 * (x * y + z * w) * a + 2 * (y * z - x * w) * c + (-xx + yy - zz + ww) * b
        up = 2 * (x * z - y * w) * a + (-xx - yy + zz + ww) * c + 2 * (y * z + x * w) * b
        moved[i, 0] = ahead + time_s * twist[3]
        moved[i, 1] = left + time_s * twist[4]
        moved[i, 2] = up + time_s * twist[5]
